"""Rollouts as labelled data."""

import numpy as np
import pytest

pytest.importorskip("xarray")

from batchpid.sim import Runner, write_recording
from batchpid.sim.recording import open_dataset, to_dataset


@pytest.fixture(scope="module")
def rollout(panda):
    with Runner(panda, 3, params=panda.params(), workers=0) as runner:
        return runner.rollout(np.broadcast_to(panda.settings.target, (4, panda.dof)))


def test_dimensions_units_and_names(rollout, panda):
    data = to_dataset(rollout)
    assert dict(data.sizes) == {"time": 4, "env": 3, "joint": 9}
    assert list(data.joint.values) == list(panda.joint_names)
    assert data.qpos.attrs == {"long_name": "joint position", "units": "rad|m"}
    assert data.setpoint.attrs["units"] == "rad|m"
    assert data.unit.sel(joint="panda_finger_joint1").item() == "m"
    assert data.time.attrs["units"] == "s"
    assert data.attrs["robot"] == "panda"
    np.testing.assert_allclose(data.time, [0.01, 0.02, 0.03, 0.04])
    chosen = data.qpos.sel(joint="panda_joint2", env=1).isel(time=-1)
    assert chosen.item() == rollout.qpos[-1, 1, 1]
    assert data.ok.all()
    assert np.shares_memory(data.effort.values, rollout.effort)


def test_setpoints_under_control_by_effort_are_efforts(panda):
    with Runner(panda, 1, workers=0, control="effort") as runner:
        data = to_dataset(runner.rollout(np.zeros((2, panda.dof))))
    assert data.setpoint.attrs["units"] == "N m|N"


def test_the_pose_of_a_tool_has_a_dimension(panda):
    with Runner(panda, 2, workers=0, control="osc", tool="panda_hand") as runner:
        data = to_dataset(runner.rollout(np.broadcast_to(runner.command.neutral, (3, 7))))
    assert data.tool_pose.dims == ("time", "env", "pose")
    assert data.pose.values.tolist() == data.entry.values.tolist()
    assert data.tool_pose.sel(pose="z").shape == (3, 2)


def test_a_file_opens_as_a_dataset(tmp_path, rollout):
    data = open_dataset(write_recording(rollout, tmp_path / "run.npz"))
    np.testing.assert_array_equal(data.qpos, rollout.qpos)
    assert data.unit.values.tolist() == ["rad"] * 7 + ["m"] * 2
    assert data.attrs["robot"] == "panda"
