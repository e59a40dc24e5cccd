"""batchpid rollout: the flags reach the runner, and the file holds its rollout."""

from __future__ import annotations

import json
import re

import h5py
import numpy as np
import pytest

import batchpid as bp
from batchpid.sim import Robot, Runner, read_recording
from batchpid.sim.cli import main
from batchpid.trajectories import Trajectory, minimum_jerk
from tests.sim.tiny_urdf import LIMIT, joint, link, one_joint, robot, write

SHORT = ("--num-envs", 3, "--workers", 0, "--seconds", 0.05)


def contents(path):
    """Return the arrays and attributes of a recording."""
    with h5py.File(path) as file:
        return {name: dataset[:] for name, dataset in file.items()} | dict(file.attrs)


def saved(batchpid, path, *flags):
    status, _, err = batchpid("rollout", *SHORT, "--force", "--out", path, *flags)
    assert status in (0, 3), err  # 3: so short a run does not settle
    return contents(path)


def test_the_file_holds_the_rollout_of_a_runner_with_tuned_gains(batchpid, tmp_path, panda):
    file = saved(batchpid, tmp_path / "run.h5", "--spread", 0, "--substeps", 10)
    with Runner(panda, 3, params=panda.tuned(), workers=0, substeps=10) as runner:
        expected = runner.rollout(np.broadcast_to(panda.settings.target, (10, panda.dof)))
    for name, value in expected.arrays().items():
        np.testing.assert_array_equal(file[name], value)
    np.testing.assert_array_equal(file["start"], np.tile(panda.start.astype(np.float32), (3, 1)))
    assert tuple(file["joint_names"]) == panda.joint_names
    assert list(file["units"]) == [joint.unit for joint in panda.joints]
    np.testing.assert_array_equal(file["effort_limit"], panda.effort_limit)


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_start_poses_are_near_and_within_limits_and_do_not_depend_on_their_number(name, batchpid, tmp_path):
    robot, path = Robot.load(name), tmp_path / "run.h5"
    short = ("--engine", "mujoco", "--seconds", 0.01)
    poses, more, other = (
        saved(batchpid, path, name, *short, "--num-envs", envs, "--seed", seed)["start"]
        for envs, seed in ((8, 0), (12, 0), (8, 1))
    )
    np.testing.assert_array_equal(more[:8], poses)
    np.testing.assert_allclose(poses[0], robot.start, atol=1e-6)
    assert not robot.limit_violations(poses)
    assert 0.05 < np.abs(poses - robot.start).max() <= 0.3 + 1e-6
    assert len(np.unique(np.concatenate([poses, other[1:]])[:, 0])) == 15
    assert "spread: out of range" in batchpid("rollout", name, "--spread", -0.1)[2]


@pytest.fixture(scope="module")
def default_motion(tmp_path_factory):
    """File of the short rollout without further flags."""
    path = tmp_path_factory.mktemp("rollout") / "run.h5"
    assert main(["rollout", *map(str, SHORT), "--out", str(path)]) == 0
    return contents(path)


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
    other = saved(batchpid, tmp_path / "b.h5", *flags)
    assert np.abs(default_motion["qpos"][-1] - other["qpos"][-1]).max() > 1e-6


def test_gains_from_a_file(batchpid, tmp_path, panda):
    params = panda.params(kp=7.0, ki=0.0, kd=1.0)
    bp.save_params(tmp_path / "gains.yaml", params, panda.joint_names)
    file = saved(batchpid, tmp_path / "run.h5", "--gains", tmp_path / "gains.yaml", "--spread", 0)
    with Runner(panda, 3, workers=0, params=params) as runner:
        expected = runner.rollout(np.broadcast_to(panda.settings.target, (5, panda.dof)))
    np.testing.assert_array_equal(file["qpos"], expected.qpos)


@pytest.mark.slow
def test_tuned_gains_run_as_they_were_tuned(batchpid, tmp_path, panda):
    """By name, or from the params file with its gain units and measurement rate."""
    path = panda.path.with_name("panda.tuned.yaml")
    at_start = ("--spread", 0, "--gains")
    by_name, by_file = (saved(batchpid, tmp_path / "run.h5", *at_start, each) for each in ("tuned", path))
    with Runner(panda, 3, workers=0, params=panda.tuned()) as runner:
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
    file = saved(batchpid, tmp_path / "run.h5", path, "--gains", tmp_path / "gains.json")
    # Without settings it holds its start pose: zero, moved inside the limits.
    np.testing.assert_allclose(file["setpoint"][0, 0], np.clip(np.zeros(9), panda.lower, panda.upper))


def test_a_setpoint_out_of_limits_is_reported_once(batchpid):
    flags = ("--setpoint", *([0, 0, 0, 1] + [0] * 5))
    _, said, err = batchpid("rollout", *SHORT, *flags)
    assert said.count("the setpoint is outside the joint limits") == 1
    assert "WHY: the setpoint is outside the joint limits, and that error remains: joint 'panda_joint4' (1 rad" in said
    assert said.count("out of limits / out of limits") >= 1  # in the table
    assert "warning" not in err


@pytest.mark.parametrize(("seconds", "status"), [(0.9, 0), (1.0, 3)])
def test_the_status_is_3_if_no_env_settles_in_a_second(batchpid, seconds, status):
    flags = ("--num-envs", 2, "--workers", 0, "--engine", "mujoco", "--seconds", seconds)
    assert batchpid("rollout", "panda", *flags, "--setpoint", *([0, 0, 0, 1] + [0] * 5))[0] == status


def test_a_tool_is_moved_to_a_pose(batchpid, tmp_path):
    goal = [0.4, 0.1, 0.5, 0.0, 1.0, 0.0, 0.0]
    flags = "--control", "osc", "--tool", "panda_hand", "--setpoint", *goal
    status, said, err = batchpid("rollout", *SHORT, "--force", "--out", tmp_path / "run.h5", *flags)
    assert status == 0, err
    assert "Tool: panda_hand" in said
    assert "still approaches the setpoint" in said
    file = contents(tmp_path / "run.h5")
    np.testing.assert_array_equal(file["setpoint"], np.broadcast_to(goal, (5, 3, 7)))
    error = 1e3 * np.linalg.norm(file["tool_pose"][..., :3] - goal[:3], axis=-1)
    line = next(line for line in said.splitlines() if line.startswith("position [mm]"))
    assert line.split()[-1] == f"{error[-1].max():.3g}"


@pytest.mark.slow
def test_picture(batchpid, tmp_path):
    path = tmp_path / "run.svg"
    assert batchpid("rollout", *SHORT, "--picture", path)[0] == 0
    assert "panda_joint7" in path.read_text()


# -- trajectories ------------------------------------------------------------------------------------------------------

ONE = ("--num-envs", 1, "--workers", 0)


@pytest.fixture(scope="module")
def motion(panda):
    """Motion of the panda from rest at its start pose, in ticks of 5 ms."""
    there = panda.start + 0.2 * (panda.settings.target - panda.start)
    return minimum_jerk(panda.start, there, 0.005, duration=0.4)


OF_TRAJECTORY = {"setpoint": "position", "setpoint_rate": "velocity", "setpoint_acceleration": "acceleration"}


def csv(robot, motion, *further, start=True, delimiter=",", end="\n", header="{}"):
    """Return setpoints and ``further`` quantities of a motion as CSV, with a row at time 0 for ``robot.start``."""
    tables = [getattr(motion, OF_TRAJECTORY[name]) for name in ("setpoint", *further)]
    names = [header.format(f"{key}:{name}") for key in ("setpoint", *further) for name in robot.joint_names]
    rows = np.hstack([motion.time[:, None], *tables])
    if start:
        rows = np.vstack([np.concatenate([[0], robot.start, np.zeros(robot.dof * len(further))]), rows])
    cells = [[header.format("time"), *names], *([f"{cell:.9g}" for cell in row] for row in rows)]
    return "".join(delimiter.join(row) + end for row in cells)


def through(poses):
    """Return a motion in ticks of 10 ms through poses, whose first is at time 0."""
    poses = np.array(poses)
    return Trajectory(0.01 * np.arange(len(poses)), poses, 0 * poses, 0 * poses)


def following_errors(report):
    """Return the largest and the last following errors of env 0 (joints,), as the report prints them."""
    rows = [line.split() for line in report.splitlines() if line.startswith("panda_")]
    assert len(rows) == 9
    return np.array([[float(row[1]), float(row[5])] for row in rows]).T


def test_a_trajectory_is_followed_as_by_a_runner_with_its_rates(batchpid, tmp_path, panda, motion):
    path = tmp_path / "motion.csv"
    path.write_text(csv(panda, motion, "setpoint_rate"))
    flags = ("--num-envs", 3, "--workers", 0, "--spread", 0, "--out", tmp_path / "run.h5")
    status, said, error = batchpid("rollout", "--trajectory", path, *flags)
    assert status == 0, error
    assert "Rates of the setpoints: from the file." in said
    rows = np.loadtxt(path, delimiter=",", skiprows=1)[1:, 1:]
    with Runner(panda, 3, workers=0, params=panda.tuned(), substeps=10) as runner:
        expected = runner.rollout(rows[:, :9], setpoint_rates=rows[:, 9:])
    file = contents(tmp_path / "run.h5")
    for name, value in expected.arrays().items():
        np.testing.assert_array_equal(file[name], value)
    error = np.abs(expected.qpos - expected.setpoint)[:, 0].max(0)
    assert error.max() < 2e-3
    np.testing.assert_allclose(following_errors(said)[0], error, rtol=0.06)


def test_rates_that_a_file_lacks_are_central_differences(batchpid, tmp_path, panda, motion):
    path = tmp_path / "motion.csv"
    path.write_text(csv(panda, motion))
    status, said, error = batchpid("rollout", "--trajectory", path, *ONE, "--out", tmp_path / "run.h5")
    assert status == 0, error
    assert "Rates of the setpoints: central differences of the rows.\n" in said
    setpoints = np.loadtxt(path, delimiter=",", skiprows=1)[:, 1:]
    with Runner(panda, 1, workers=0, params=panda.tuned(), substeps=10) as runner:
        expected = runner.rollout(setpoints[1:], setpoint_rates=np.gradient(setpoints, 0.005, axis=0)[1:])
    file = contents(tmp_path / "run.h5")
    np.testing.assert_allclose(file["qpos"], expected.qpos, atol=1e-6)
    assert following_errors(said)[0].max() < 2e-3


def test_a_file_without_a_row_at_time_0_begins_at_the_start_pose(batchpid, tmp_path, panda, motion):
    path = tmp_path / "motion.csv"
    path.write_text(csv(panda, motion, start=False))
    status, said, error = batchpid("rollout", "--trajectory", path, *ONE, "--out", tmp_path / "run.h5")
    assert status == 0, error
    file = contents(tmp_path / "run.h5")
    np.testing.assert_array_equal(file["start"][0], panda.start.astype(np.float32))
    np.testing.assert_allclose(file["time"], motion.time)
    assert following_errors(said)[0].max() < 2e-3


def test_the_first_row_is_the_start_of_env_0_and_others_spread_around_it(batchpid, tmp_path, panda):
    path = tmp_path / "motion.csv"
    path.write_text(csv(panda, through([panda.settings.target] * 2), start=False))
    status, _, error = batchpid("rollout", "--trajectory", path, *SHORT[:4], "--out", tmp_path / "run.h5")
    assert status == 0, error
    file = contents(tmp_path / "run.h5")
    away = np.abs(file["start"] - panda.settings.target).max(1)
    assert away[0] < 1e-6 < 0.01 < away[1:].min() <= away[1:].max() <= 0.3 + 1e-6
    assert len(file["time"]) == 1


@pytest.mark.parametrize(
    "style",
    [
        {"delimiter": ";"},
        {"delimiter": "\t"},
        {"end": "\r\n"},
        {"header": '"{}"', "end": "\r\n"},
    ],
)
def test_files_of_other_programs_read_as_those_of_this_one(batchpid, tmp_path, panda, motion, style):
    runs = []
    for name, form in (("plain", {}), ("other", style)):
        path, out = tmp_path / f"{name}.csv", tmp_path / f"{name}.h5"
        path.write_bytes(csv(panda, motion, "setpoint_rate", "setpoint_acceleration", **form).encode("utf-8-sig"))
        status, said, error = batchpid("rollout", "--trajectory", path, *ONE, "--engine", "mujoco", "--out", out)
        assert status == 0, error
        assert "Rates of the setpoints: from the file." in said
        runs.append(read_recording(out))
    for name, rows in runs[0].arrays().items():
        np.testing.assert_array_equal(rows, runs[1].arrays()[name])


def test_the_motion_of_excite_is_followed(batchpid, tmp_path):
    path = tmp_path / "x.csv"
    assert batchpid("excite", "panda", "--seconds", 2, "--rate", 200, "--out", path)[0] == 0
    status, said, error = batchpid("rollout", "--trajectory", path, *ONE)
    assert status == 0, error
    assert "real-time" in said
    assert following_errors(said)[0].max() < 5e-3


def test_changes_beyond_the_velocity_limits_are_steps(batchpid, tmp_path, panda):
    path = tmp_path / "step.csv"
    poses = [panda.start, panda.start, panda.settings.target, panda.settings.target]
    path.write_text(csv(panda, through(poses), start=False))
    steps = np.count_nonzero(panda.settings.target != panda.start)
    assert f"{steps} changes are too fast" in batchpid("rollout", "--trajectory", path, *ONE)[1]


def test_rates_take_the_short_way_round_and_followers_need_no_column(batchpid, tmp_path):
    follower = joint("right", "base", "r", inner=LIMIT + '<mimic joint="left" multiplier="-0.5"/>', origin="0 -1 1")
    turning = joint("turn", "base", "t", "continuous", '<limit effort="50" velocity="9"/>', origin="0 3 1")
    parts = (*map(link, ("base", "l", "r", "t")), follower, joint("left", "base", "l", origin="0 1 1"), turning)
    arm, path, out = write(tmp_path, robot(*parts)), tmp_path / "motion.csv", tmp_path / "run.h5"
    path.write_text("time,setpoint:left,setpoint:turn\n0,0.1,3.13\n0.01,0.12,-3.13\n0.02,0.14,-3.11\n")
    status, said, error = batchpid("rollout", arm, "--trajectory", path, *ONE, "--out", out)
    assert status == 0, error
    assert "too fast" not in said
    run = read_recording(out)
    right, turn = (run.info.joint_names.index(name) for name in ("right", "turn"))
    np.testing.assert_allclose(run.setpoint[:, 0, right], [-0.06, -0.07])
    assert 0 < run.qvel[-1, 0, turn] < 5


def cut(change):
    """Return a function that changes the lines of a file, each a list of cells."""

    def changed(text):
        lines = [line.split(",") for line in text.splitlines()]
        change(lines)
        return "\n".join(map(",".join, lines))

    return changed


def in_column(column, function):
    """Return a change of all cells of a column but its name."""

    def change(lines):
        for line in lines[1:]:
            line[column] = function(line[column])

    return cut(change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (cut(lambda lines: lines.pop(20)), "line 21: time is 0.1 s, and not 0.095 s; .*resample"),
        (in_column(0, lambda cell: str(1000 * float(cell))), "rows every 5 s; .*seconds"),
        (in_column(0, lambda cell: str(0.0033 + float(cell))), "line 2: the first row is at 0.0033 s; begin at 0"),
        (in_column(0, lambda cell: str(0.74 * float(cell))), "rows every 0.0037 s, .*use --timestep 0.0005285714"),
        (in_column(4, lambda cell: str(57.3 * float(cell))), "panda_joint4' is outside .*got -.*within -3.07"),
        (in_column(3, lambda cell: "nan"), "line 2, column 'setpoint:panda_joint3' is empty or not finite"),
        (in_column(12, lambda cell: "fast"), "line 2, column 'setpoint_rate:panda_joint3' is not a number"),
        (cut(lambda lines: lines[0].__setitem__(3, "qpos:panda_joint3")), "unknown column 'qpos:panda_joint3'"),
        (cut(lambda lines: lines[0].__setitem__(3, " setpoint: panda_joint1")), "'setpoint:panda_joint1' twice"),
        (cut(lambda lines: [line.pop(3) for line in lines]), "column setpoint:panda_joint3: is missing"),
        (cut(lambda lines: lines.__delitem__(slice(2, None))), "line 2: the only row is at 0 s"),
        (
            lambda text: text.replace(",", ";").replace(".", ","),
            "line 2, column 'time' is not a number .*decimal point",
        ),
        (lambda text: text.replace("setpoint_rate", "setpoint_acceleration"), "accelerations need the rates"),
    ],
)
def test_a_wrong_trajectory_is_refused(batchpid, tmp_path, panda, motion, change, message):
    path = tmp_path / "motion.csv"
    path.write_text(change(csv(panda, motion, "setpoint_rate").replace("\n0,", "\n0.0,")))
    status, _, error = batchpid("rollout", "--trajectory", path, *ONE)
    assert status == 2
    assert error.startswith(f"batchpid: {path}: ")
    assert re.search(message, error), error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--seconds", 1), "trajectory: excludes --seconds"),
        (("--setpoint", 0, 0), "trajectory: excludes --setpoint"),
        (("--control", "osc"), "trajectory: excludes --control osc"),
        (("--substeps", 7), r"substeps: differs from the ticks .*use 10"),
        (("--gains", "tutorial"), "setpoint_acceleration: needs gains in accelerations; use --gains designed"),
        (("--control", "drive"), "setpoint_acceleration: needs gains in accelerations"),
    ],
)
def test_flags_that_contradict_a_trajectory_are_refused(batchpid, tmp_path, panda, motion, flags, message):
    path = tmp_path / "motion.csv"
    path.write_text(csv(panda, motion, "setpoint_rate", "setpoint_acceleration"))
    status, _, error = batchpid("rollout", "--trajectory", path, *ONE, *flags)
    assert status == 2
    assert re.search(message, error), error


@pytest.mark.filterwarnings("ignore::batchpid.sim.MovingSetpointWarning")
def test_a_trajectory_without_rates_is_a_log(batchpid, panda, tmp_path, motion):
    """It has no accelerations either, so that gains in efforts follow it."""
    path, out = tmp_path / "motion.csv", tmp_path / "run.h5"
    path.write_text(csv(panda, motion, "setpoint_rate", "setpoint_acceleration"))
    flags = ("--no-rates", "--gains", "tutorial", "--out", out)
    status, said, error = batchpid("rollout", "--trajectory", path, *ONE, *flags)
    assert status == 0, error
    assert "not given" in said
    assert read_recording(out).info.rates is False


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("command", ["rollout", "demo"])
def test_the_figures_are_those_of_the_table(command, batchpid, tmp_path):
    words = ("--num-envs", 2, "--workers", 0, "--seconds", 1.5, "--engine", "mujoco")
    status, said, err = batchpid(command, *words, "--json", tmp_path / "a.json")
    assert status == 0, err
    figures = json.loads((tmp_path / "a.json").read_text())
    assert (figures["robot"], figures["num_envs"], figures["failed"]) == ("panda", 2, [])
    row = next(line for line in said.splitlines() if line.startswith("panda_joint2"))
    assert f"{max(figures['joints']['panda_joint2']['settling_time']):.2f} s" in row
    assert f"{max(figures['joints']['panda_joint2']['steady_state_error']):.2g} rad" in row


def test_the_ground_is_on_or_off(batchpid, tmp_path):
    arm = write(tmp_path, one_joint())
    for word, expected in (("on", True), ("off", False)):
        assert bool(saved(batchpid, tmp_path / "a.h5", arm, "--ground", word)["ground"]) is expected
