"""batchpid rollout: the flags reach the runner, and the file holds its rollout."""

from __future__ import annotations

import re

import numpy as np
import pytest

import batchpid as bp
from batchpid.sim import Runner, read_recording
from batchpid.sim.cli import main
from batchpid.sim.cli.run import start_poses
from batchpid.trajectories import minimum_jerk

SHORT = ("--num-envs", 3, "--workers", 0, "--seconds", 0.05)


def saved(batchpid, path, *flags):
    status, _, err = batchpid("rollout", *SHORT, "--force", "--out", path, *flags)
    assert status == 0, err
    with np.load(path) as file:
        return dict(file)


def test_the_file_holds_the_rollout_of_a_runner_with_tuned_gains(batchpid, tmp_path, panda):
    file = saved(batchpid, tmp_path / "new" / "run.npz", "--workers", 1, "--seed", 7, "--substeps", 10)
    start = start_poses(panda, 3, 0.3, 7)
    with Runner(panda, 3, params=panda.tuned(), workers=0, substeps=10) as runner:
        runner.reset(qpos=start)
        expected = runner.rollout(np.broadcast_to(panda.settings.target, (10, panda.dof)))
    for name, value in expected.arrays().items():
        np.testing.assert_array_equal(file[name], value)
    np.testing.assert_array_equal(file["start"], start.astype(np.float32))
    assert tuple(file["joint_names"]) == panda.joint_names
    assert list(file["units"]) == [joint.unit for joint in panda.joints]
    np.testing.assert_array_equal(file["effort_limit"], panda.effort_limit)


@pytest.fixture(scope="module")
def default_motion(tmp_path_factory):
    """File of the short rollout without further flags."""
    path = tmp_path_factory.mktemp("rollout") / "run.npz"
    assert main(["rollout", *map(str, SHORT), "--out", str(path)]) == 0
    with np.load(path) as file:
        return dict(file)


@pytest.mark.quick_rows(4)
@pytest.mark.parametrize(
    "flags",
    [
        ("--control", "drive"),
        ("--compensate", "none"),
        ("--physics", "fast"),
        ("--dissipation", "sapien"),
        ("--timestep", "0.001"),
        ("--spread", "0.1"),
        ("--randomize", "payload"),
        ("--setpoint", "0", "-0.5", "0", "-1", "0", "1", "0", "0", "0"),
    ],
    ids=lambda flags: flags[0],
)
def test_every_flag_changes_the_motion(flags, batchpid, default_motion, tmp_path):
    other = saved(batchpid, tmp_path / "b.npz", *flags)
    assert np.abs(default_motion["qpos"][-1] - other["qpos"][-1]).max() > 1e-6


def test_gains_from_a_file(batchpid, tmp_path, panda):
    params = panda.params(kp=7.0, ki=0.0, kd=1.0)
    bp.save_params(tmp_path / "gains.yaml", params, panda.joint_names)
    file = saved(batchpid, tmp_path / "run.npz", "--gains", tmp_path / "gains.yaml", "--spread", 0)
    with Runner(panda, 3, workers=0, params=params) as runner:
        expected = runner.rollout(np.broadcast_to(panda.settings.target, (5, panda.dof)))
    np.testing.assert_array_equal(file["qpos"], expected.qpos)


@pytest.mark.slow
def test_tuned_gains_run_as_they_were_tuned(batchpid, tmp_path, panda):
    """By name, or from the params file with its gain units and measurement rate."""
    path = panda.path.with_name("panda.tuned.yaml")
    by_name, by_file = (saved(batchpid, tmp_path / "run.npz", "--gains", each) for each in ("tuned", path))
    with Runner(panda, 3, workers=0, params=panda.tuned()) as runner:
        runner.reset(start_poses(panda, 3, 0.3, 0))
        expected = runner.rollout(np.broadcast_to(panda.settings.target, (5, panda.dof)))
    np.testing.assert_array_equal(by_name["qpos"], expected.qpos)
    np.testing.assert_array_equal(by_file["qpos"], expected.qpos)


def test_the_default_gains_settle_and_the_tutorial_s_do_not(batchpid):
    flags = ("--num-envs", 1, "--workers", 0, "--seconds", 1.2)
    assert "Every joint of every env settled" in batchpid("rollout", *flags)[1]
    assert "NOT SETTLED" in batchpid("rollout", *flags, "--gains", "tutorial")[1]


def test_the_efforts_of_a_drive_are_unknown(batchpid):
    lines = batchpid("rollout", *SHORT, "--gains", "drive")[1].splitlines()
    rows = [line for line in lines if line.startswith("panda_")]
    assert len(rows) == 9
    assert all(row.split()[-1] == "-" for row in rows)


def test_any_urdf_runs_with_gains_from_a_file(batchpid, tmp_path, panda):
    path = tmp_path / "arm.urdf"
    path.write_text(panda.path.read_text())
    assert batchpid("rollout", path, *SHORT)[0] == 0  # with designed gains
    bp.save_params(tmp_path / "gains.json", panda.params(), panda.joint_names)
    file = saved(batchpid, tmp_path / "run.npz", path, "--gains", tmp_path / "gains.json")
    # Without settings it holds its start pose: zero, moved inside the limits.
    np.testing.assert_allclose(file["setpoint"][0, 0], np.clip(np.zeros(9), panda.lower, panda.upper))


def test_a_setpoint_out_of_limits_is_reported_once(batchpid):
    flags = ("--setpoint", *([0, 0, 0, 1] + [0] * 5))
    _, said, err = batchpid("rollout", *SHORT, *flags)
    assert said.count("OUT OF LIMITS: setpoint 1 rad of panda_joint4") == 1
    assert "warning" not in err


def test_a_tool_is_moved_to_a_pose(batchpid, tmp_path):
    goal = [0.4, 0.1, 0.5, 0.0, 1.0, 0.0, 0.0]
    flags = "--control", "osc", "--tool", "panda_hand", "--setpoint", *goal
    status, said, err = batchpid("rollout", *SHORT, "--force", "--out", tmp_path / "run.npz", *flags)
    assert status == 0, err
    assert "Tool: panda_hand" in said
    with np.load(tmp_path / "run.npz") as file:
        np.testing.assert_array_equal(file["setpoint"], np.broadcast_to(goal, (5, 3, 7)))
        error = 1e3 * np.linalg.norm(file["tool_pose"][..., :3] - goal[:3], axis=-1)
    line = next(line for line in said.splitlines() if line.startswith("position [mm]"))
    assert line.split()[-1] == f"{error[-1].max():.3g}"


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--setpoint", "1", "2"), "setpoint: has shape (2,)"),
        (("--setpoint", *["nan"] * 9), "setpoint, joint 'panda_joint1'"),
        (("--out", "run.csv"), "out: unknown file format"),
        (("--picture", "run.bmp"), "picture: unknown file format"),
        (
            ("--gains", "/nowhere/gains.yaml"),
            "gains: is neither a name nor a file (got '/nowhere/gains.yaml')",
        ),
        (("--seconds", "-1"), "seconds: out of range"),
        (("--timestep", "0"), "timestep: out of range"),
        (("--substeps", "0"), "substeps: out of range"),
        (("--control", "osc", "--gains", "tuned"), "gains: is not a file, and --control osc has no gains by name"),
        (("--control", "osc", "--setpoint", "1", "2"), "setpoint: has shape (2,)"),
        (("--tool", "panda_hand"), "tool: is for control 'osc'"),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value[:2]),
)
def test_bad_flags_are_named(flags, message, batchpid):
    status, said, err = batchpid("rollout", *SHORT, *flags)
    assert (status, said) == (2, "")
    assert err.startswith(f"batchpid: {message}")


@pytest.mark.slow
def test_picture(batchpid, tmp_path):
    path = tmp_path / "run.svg"
    assert batchpid("rollout", *SHORT, "--picture", path)[0] == 0
    assert "panda_joint7" in path.read_text()


def trajectory(path, robot, *, rates=True, ends="\n", quote='"', edit=None):
    """Write a move of the robot as a CSV with quoted names and these line ends."""
    move = minimum_jerk(robot.settings.start, robot.settings.target, 0.01, duration=1.5)
    kinds = {"setpoint": (robot.settings.start, move.position), "setpoint_rate": (0 * robot.start, move.velocity)}
    names, table = ["time"], [np.append(0.0, move.time)[:, None]]
    for kind, (first, rows) in list(kinds.items())[: 1 + rates]:
        names += [f"{kind}:{name}" for name in robot.joint_names]
        table.append(np.vstack([first, rows]))
    lines = [",".join(f"{quote}{name}{quote}" for name in names)]
    lines += [",".join(f"{number:.12g}" for number in row) for row in np.hstack(table)]
    if edit is not None:
        lines = edit(lines)
    path.write_bytes(ends.join([*lines, ""]).encode())
    return path


@pytest.mark.parametrize(("rates", "ends"), [(True, "\r\n"), (False, "\n")])
def test_a_trajectory_is_followed(batchpid, panda, tmp_path, rates, ends):
    path, out = trajectory(tmp_path / "move.csv", panda, rates=rates, ends=ends), tmp_path / "run.npz"
    status, said, error = batchpid("rollout", "--num-envs", 2, "--workers", 0, "--trajectory", path, "--out", out)
    assert status == 0, error
    assert ("Rates: those of the file." if rates else "Rates: differences of the rows.") in said
    rollout = read_recording(out)
    assert len(rollout.time) == 150
    assert rollout.info.rates
    assert np.abs(rollout.qpos - rollout.setpoint)[:, 0].max() < 0.002
    np.testing.assert_allclose(rollout.qpos[-1, 0], panda.settings.target, atol=0.002)


@pytest.mark.filterwarnings("ignore::batchpid.sim.MovingSetpointWarning")
def test_a_trajectory_without_rates_is_a_log(batchpid, panda, tmp_path):
    path, out = trajectory(tmp_path / "move.csv", panda), tmp_path / "run.npz"
    flags = ("--num-envs", 1, "--workers", 0, "--trajectory", path, "--no-rates", "--out", out)
    status, said, error = batchpid("rollout", *flags)
    assert status == 0, error
    assert "Rates: not given." in said
    assert read_recording(out).info.rates is False


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda lines: [lines[0].replace("setpoint:panda_joint3", "setpoint:elbow"), *lines[1:]], "'setpoint:elbow'"),
        (
            lambda lines: [line.rpartition(",")[0] for line in lines],
            "no column 'setpoint_rate:panda_finger_joint2'",
        ),
        (lambda lines: [*lines[:4], *lines[5:]], r"line 5: its time is not 0.01 s after"),
        (
            lambda lines: [*lines[:3], lines[3].replace(lines[3].split(",")[2], "nan", 1), *lines[4:]],
            "line 4.* finite",
        ),
        (lambda lines: [lines[0], *lines[4:]], "begins at 0.03 s"),
        (lambda lines: lines[:2], "has one row"),
    ],
)
def test_what_is_no_trajectory_is_named(batchpid, panda, tmp_path, edit, message):
    path = trajectory(tmp_path / "move.csv", panda, edit=edit)
    status, _, error = batchpid("rollout", "--num-envs", 1, "--workers", 0, "--trajectory", path)
    assert status != 0
    assert re.search(message, error.replace("\n", " ")), error


@pytest.mark.parametrize("flags", [("--seconds", 1), ("--substeps", 10), ("--control", "osc")])
def test_what_a_trajectory_replaces_is_refused(batchpid, panda, tmp_path, flags):
    path = trajectory(tmp_path / "move.csv", panda)
    status, _, error = batchpid("rollout", "--trajectory", path, *flags)
    assert status != 0
    assert error.startswith(f"batchpid: {flags[0][2:]}: "), error
