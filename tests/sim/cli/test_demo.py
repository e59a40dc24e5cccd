"""batchpid demo: a run, its report and its picture."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from robots import load_bundled

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim.cli.run import start_poses

ROBOTS = {name: load_bundled(name) for name in ("panda", "jaco2")}


@pytest.mark.usefixtures("undrawn")
def test_demo_reports_every_joint(batchpid, tmp_path):
    flags = ("--num-envs", 2, "--workers", 0, "--seconds", 0.02, "--picture", tmp_path / "demo.png")
    status, said, _ = batchpid("demo", "panda", *flags)
    assert status == 0
    assert "NOT SETTLED" in said
    for joint in ROBOTS["panda"].joint_names:
        assert f"\n{joint} " in said


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_demo_reports_every_joint_and_draws(name, batchpid, tmp_path):
    path = tmp_path / "new" / "demo.png"
    flags = ("--num-envs", 3, "--workers", 1 if name == "panda" else 0, "--seconds", 0.02, "--picture", path)
    status, said, _ = batchpid("demo", name, *flags)
    assert status == 0
    for line in (
        "env-steps/s",
        "real-time factor",
        "Setpoints out of limits: none.",
        "NOT SETTLED",
        str(path),
    ):
        assert line in said
    for joint in ROBOTS[name].joint_names:
        assert f"\n{joint} " in said
    with Image.open(path) as picture:
        assert picture.width > 1000
        assert len(np.unique(np.asarray(picture))) > 20


@pytest.mark.usefixtures("undrawn")
def test_demo_notes_where_it_differs_from_the_tutorial(batchpid, tmp_path):
    args = ("--num-envs", 1, "--workers", 0, "--seconds", 0.02, "--picture", tmp_path / "x.svg")
    assert "panda_joint4 goes to -1 rad" in batchpid("demo", *args)[1]


@pytest.mark.usefixtures("undrawn")
def test_demo_depends_on_nothing_but_its_flags(batchpid, tmp_path):
    def table(*flags):
        args = ("--num-envs", 3, "--workers", 0, "--seconds", 0.02, "--picture", tmp_path / "x.png")
        return batchpid("demo", *args, *flags)[1].partition("\n\n")[2]

    assert table() == table("--seed", 0)
    assert table() != table("--seed", 1)


def test_a_picture_that_cannot_be_written_is_refused_first(batchpid):
    status, said, err = batchpid("demo", "--picture", "demo.jpg")
    assert (status, said) == (2, "")
    assert ".png or .svg" in err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("pander",), "no robot 'pander'"),
        (("--num-envs", "0"), "num_envs: out of range (got 0)"),
        (("--workers", "-1"), "workers: out of range (got -1)"),
        (("--seconds", "nan"), "seconds: out of range (got nan)"),
        (("--seed", "-1"), "seed: out of range (got -1)"),
    ],
)
def test_bad_flags_are_named(flags, message, batchpid):
    status, said, err = batchpid("demo", *flags)
    assert (status, said) == (2, "")
    assert err.startswith(f"batchpid: {message}")
    assert err.count("\n") == 1


def test_a_robot_without_tutorial_settings_is_sent_to_rollout(batchpid, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ROBOTS["panda"].path.read_text())
    status, _, err = batchpid("demo", path)
    assert status == 2
    assert f"batchpid rollout {path}" in err


@pytest.mark.usefixtures("undrawn")
def test_demo_runs_with_gains_by_name_or_from_a_file(batchpid, tmp_path):
    robot = ROBOTS["panda"]
    bp.save_params(tmp_path / "mine.yaml", robot.params(kp=7.0), robot.joint_names)
    flags = ("--num-envs", 1, "--workers", 0, "--seconds", 0.02, "--picture", tmp_path / "x.svg")
    assert "pid at 2000 Hz, gains tuned" in batchpid("demo", *flags)[1]
    assert "pid at 2000 Hz, gains mine.yaml" in batchpid("demo", *flags, "--gains", tmp_path / "mine.yaml")[1]
    assert "drive at 2000 Hz, gains drive (30, 6)" in batchpid("demo", *flags, "--gains", "drive:30,6")[1]


@settings(max_examples=30)
@given(
    name=st.sampled_from(list(ROBOTS)),
    num_envs=st.integers(1, 40),
    spread=st.floats(0, 10),
    seed=st.integers(0, 2**63 - 1),
)
def test_start_poses_are_near_and_within_limits_and_do_not_depend_on_their_number(name, num_envs, spread, seed):
    robot = ROBOTS[name]
    poses = start_poses(robot, num_envs, spread, seed)
    assert poses.shape == (num_envs, robot.dof)
    np.testing.assert_array_equal(poses[0], robot.start)
    assert not robot.limit_violations(poses)
    assert np.abs(poses - robot.start).max() <= spread + 1e-12
    np.testing.assert_array_equal(poses, start_poses(robot, num_envs + 3, spread, seed)[:num_envs])


def test_start_poses_differ():
    poses = start_poses(ROBOTS["panda"], 64, 0.3, 0)
    assert len(np.unique(poses[:, 0])) == 64


def test_spread_is_checked():
    with pytest.raises(InvalidArgumentError, match="spread"):
        start_poses(ROBOTS["panda"], 4, -0.1, 0)
