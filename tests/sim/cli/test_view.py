"""batchpid view: its start and its end. The page is tested in tests/sim/view."""

from dataclasses import replace

import numpy as np
import pytest
from robots import load_bundled
from tiny_urdf import INERTIAL, joint, link, robot
from tiny_urdf import write as write_urdf

from batchpid.sim import (
    Observation,
    Robot,
    Rollout,
    RunInfo,
    read_recording,
    write_recording,
)
from batchpid.sim.robot.robot_options import content
from batchpid.sim.view.view_data import recorded_robot

pytest.importorskip("viser")
SHORT = ("--num-envs", 1, "--workers", 0, "--port", 0)


def write(path, robot=None, envs=1, name="panda"):
    """Write a rollout of two ticks at rest."""
    robot = load_bundled("panda") if robot is None else robot
    zeros = np.zeros((2, envs, robot.dof), np.float32)
    seen = Observation(zeros, zeros, zeros, zeros > 0, np.ones((2, envs), bool), zeros > 0)
    info = replace(RunInfo.of(robot), robot=name)
    return write_recording(
        Rollout(np.array([0.1, 0.2]), zeros.astype(float), seen, tick=0.1, info=info), path
    )


def test_ctrl_c_ends_it_with_status_0(batchpid, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("batchpid.sim.view.View.run", interrupted)
    status, said, err = batchpid("view", *SHORT)
    assert (status, err) == (0, "")
    assert "http://127.0.0.1:" in said


def test_gains_are_those_of_a_pid(batchpid):
    assert batchpid("view", *SHORT, "--gains", "sapien-tutorial", "--time-limit", 0.1)[0] == 0
    assert "gains: belong to a drive" in batchpid("view", *SHORT, "--gains", "drive")[2]


def test_the_first_64_of_many_recorded_robots_are_shown(batchpid, tmp_path):
    run = write(tmp_path / "run.h5", envs=70)
    status, said, _ = batchpid("view", *SHORT, "--play", run, "--time-limit", 0.2)
    assert status == 0
    assert "the first 64 of 70" in said


def test_a_mesh_that_cannot_be_read_is_named(batchpid, tmp_path):
    """And a robot without ground is drawn, over a grid."""
    (tmp_path / "<b>.stl").write_text("version https://git-lfs.github.com/spec/v1")
    seen = [
        f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
        for name in ("no.stl", "&lt;b>.stl")
    ]
    box = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    parts = (
        link("base", INERTIAL + seen[0]),
        link("arm", INERTIAL + seen[1] + box),
        joint("j", "base", "arm", origin="0 0 0"),
    )
    path = write_urdf(tmp_path, robot(*parts))
    assert not Robot.load(path).has_ground
    status, _, err = batchpid("view", path, *SHORT, "--time-limit", 0.1)
    assert status == 0
    missing, broken = err.splitlines()
    assert "link 'base' ('<visual>'): cannot be drawn ('no.stl' not found)" in missing
    assert "<b>.stl'): cannot be drawn" in broken


def test_the_robot_of_a_recording_is_shown(batchpid, tmp_path):
    """Also one that has the name of a bundled one, and whose file is gone."""
    text = '<collision><geometry><box size="1 2 3"/></geometry></collision>'
    path = write_urdf(
        tmp_path, robot(link("base"), link("arm", INERTIAL + text), joint("j", "base", "arm"))
    )
    arm = Robot.load(path)
    for name in ("panda", "my arm"):
        run = write(tmp_path / f"{name}.h5", arm, name=name)
        seen = recorded_robot(read_recording(run))
        assert (content(seen), seen.path.parent == tmp_path) == (content(arm), False)
    path.unlink()
    assert batchpid("view", *SHORT[2:], "--play", run, "--time-limit", 0.1)[0] == 0


def test_a_recording_without_robot_asks_for_its_file(batchpid, tmp_path):
    """A URDF cannot hold the mesh of an MJCF file."""
    path = tmp_path / "arm.xml"
    mesh = '<asset><mesh name="m" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset>'
    body = '<worldbody><body><joint/><geom type="mesh" mesh="m"/></body></worldbody>'
    path.write_text(f'<mujoco model="arm">{mesh}{body}</mujoco>')
    run = write(tmp_path / "run.h5", Robot.load(path), name="arm")
    problem = "robot: of the recording, 'arm', is unknown: a URDF cannot hold it; name its"
    assert problem in batchpid("view", "--play", run)[2]
    assert batchpid("view", path, *SHORT, "--play", run, "--time-limit", 0.1)[0] == 0
