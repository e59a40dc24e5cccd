"""Rollouts read back from their files, and as labelled data."""

import numpy as np
import pytest

from batchpid.errors import InvalidArgumentError
from sim import Robot, Runner
from sim.cli import main
from sim.recording.dataset import open_dataset, read_rollout, to_dataset


@pytest.fixture(scope="module")
def panda():
    robot = Robot.load("panda")
    with Runner(robot, 3, workers=0) as runner:
        return robot, runner.rollout(np.broadcast_to(robot.settings.target, (4, robot.dof)))


def test_dimensions_units_and_names(panda):
    pytest.importorskip("xarray")
    robot, rollout = panda
    data = to_dataset(rollout, robot)
    assert dict(data.sizes) == {"time": 4, "env": 3, "joint": 9}
    assert list(data.joint.values) == list(robot.joint_names)
    assert data.qpos.attrs == {"long_name": "joint position", "units": "rad|m"}
    assert data.unit.sel(joint="panda_finger_joint1").item() == "m"
    assert data.time.attrs["units"] == "s"
    assert data.attrs["robot"] == "panda"
    np.testing.assert_allclose(data.time, [0.01, 0.02, 0.03, 0.04])
    chosen = data.qpos.sel(joint="panda_joint2", env=1).isel(time=-1)
    assert chosen.item() == rollout.qpos[-1, 1, 1]
    assert data.ok.all()
    assert np.shares_memory(data.effort.values, rollout.effort)


def test_a_file_opens_as_it_was_written(tmp_path):
    path = tmp_path / "run.npz"
    assert main(["rollout", "--num-envs", "2", "--workers", "0", "--seconds", "0.05", "--out", str(path)]) == 0
    recorded = read_rollout(path)
    assert recorded.robot == "panda"
    assert recorded.rollout.qpos.shape[1:] == (2, 9)
    assert recorded.joint_names == Robot.load("panda").joint_names
    pytest.importorskip("xarray")
    data = open_dataset(path)
    np.testing.assert_array_equal(data.qpos, recorded.rollout.qpos)
    assert data.unit.values.tolist() == ["rad"] * 7 + ["m"] * 2


def test_what_is_no_rollout_is_named(tmp_path):
    with pytest.raises(InvalidArgumentError, match="is no file"):
        read_rollout(tmp_path / "nothing.npz")
    text = tmp_path / "text.npz"
    text.write_text("hello")
    with pytest.raises(InvalidArgumentError, match="cannot be read as a rollout"):
        read_rollout(text)
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(InvalidArgumentError, match="cannot be read as a rollout"):
        read_rollout(tmp_path / "other.npz")


def test_a_recording_opens_too(tmp_path, panda):
    pytest.importorskip("h5py")
    pytest.importorskip("xarray")
    from sim import Recorder

    robot, _ = panda
    path = tmp_path / "run.h5"
    with Runner(robot, 2, workers=0) as runner, Recorder(path, runner):
        for _ in range(3):
            obs = runner.step(robot.settings.target)
    data = open_dataset(path)
    assert dict(data.sizes) == {"time": 3, "env": 2, "joint": 9}
    np.testing.assert_array_equal(data.qpos[-1], obs.qpos)
    assert data.attrs["robot"] == "panda"
