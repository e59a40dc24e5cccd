"""batchpid rollout: the flags reach the runner, and the file holds its rollout."""

import re
from pathlib import Path

import numpy as np
import pytest
from tiny_urdf import gripper, joint, link, write

import batchpid as bp
from batchpid.sim import Robot, Runner, read_recording
from batchpid.trajectories import minimum_jerk

SHORT = ("--num-envs", 3, "--workers", 0, "--seconds", 0.05)
FILE = "run.h5"


@pytest.fixture
def saved(batchpid, tmp_path):
    """Function that returns the recording of a run, and its report."""

    def run(*words, short=SHORT):
        status, said, err = batchpid("rollout", *words, *short, "--force", "--out", tmp_path / FILE)
        assert status == 0, err
        return read_recording(tmp_path / FILE), said

    return run


@pytest.mark.parametrize("gains", ["tuned", "panda.tuned.yaml", "gains.yaml"])
def test_the_file_holds_the_rollout_of_a_runner_with_the_same_gains(saved, tmp_path, panda, gains):
    params, path = panda.tuned(), gains
    if gains == "panda.tuned.yaml":
        path = panda.path.with_name(gains)
    elif gains == "gains.yaml":
        params, path = panda.params(kp=7.0, ki=0.0, kd=1.0), tmp_path / gains
        bp.save_params(path, params, panda.joint_names)
    # Observations of a start are rounded, as SAPIEN's state is.
    run, _ = saved("--gains", path, "--engine", "sapien")
    with Runner(panda, 3, engine="sapien", params=params, workers=0, substeps=20) as runner:
        runner.reset(run.info.start)
        expected = runner.rollout(np.broadcast_to(panda.target, (5, panda.dof)))
    for name, value in expected.arrays().items():
        np.testing.assert_array_equal(run.arrays()[name], value)


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_start_poses_are_near_and_within_limits_and_do_not_depend_on_their_number(name, saved):
    robot, short = Robot.load(name), ("--workers", 0, "--engine", "mujoco", "--seconds", 0.01)
    poses, more = (saved(name, "--num-envs", envs, short=short)[0].info.start for envs in (8, 12))
    np.testing.assert_array_equal(more[:8], poses)
    np.testing.assert_allclose(poses[0], robot.start, atol=1e-6)
    np.testing.assert_allclose(np.clip(poses, robot.lower, robot.upper), poses, atol=1e-6)
    assert 0.05 < np.abs(poses - robot.start).max() <= 0.3 + 1e-6
    assert len(np.unique(more[:, 0])) == 12


@pytest.mark.parametrize(
    "flags",
    [
        ("--gains", "drive"),
        ("--timestep", "0.001"),
        ("--randomize", "payload.yaml"),
        ("--setpoint", "0", "-0.5", "0", "-1", "0", "1", "0", "0", "0"),
    ],
    ids=lambda flags: flags[0],
)
def test_every_flag_changes_the_motion(flags, saved):
    Path("payload.yaml").write_text("payload: {uniform: [0, 0.5]}")
    plain, other = saved()[0], saved(*flags)[0]
    assert np.abs(plain.qpos[-1] - other.qpos[-1]).max() > 1e-6


def test_the_cause_for_which_no_env_settles_is_named(batchpid):
    words = ("panda", *SHORT, "--engine", "mujoco", "--setpoint", *([0, 0, 0, 1] + [0] * 5))
    status, said, err = batchpid("rollout", *words)
    assert (status, err) == (0, "")
    assert said.count("WHY: joint 'panda_joint4': the setpoint or the start pose is outside") == 1


# -- trajectories
# --------------------------------------------------------------------------------------------------

ONE = ("--num-envs", 1, "--workers", 0)


@pytest.fixture(scope="module")
def motion(panda):
    """Motion of the panda from rest at its start pose, in ticks of 5 ms."""
    there = panda.start + 0.2 * (panda.settings.target - panda.start)
    return minimum_jerk(panda.start, there, 0.005, duration=0.4)


OF_TRAJECTORY = {
    "setpoint": "position",
    "setpoint_rate": "velocity",
    "setpoint_acceleration": "acceleration",
}


def csv(robot, motion, *further, start=True, delimiter=",", end="\n", header="{}"):
    """Return setpoints and ``further`` quantities of a motion as CSV, with a row at time 0 for
    ``robot.start``.
    """
    tables = [getattr(motion, OF_TRAJECTORY[name]) for name in ("setpoint", *further)]
    names = [
        header.format(f"{key}:{name}")
        for key in ("setpoint", *further)
        for name in robot.joint_names
    ]
    rows = np.hstack([motion.time[:, None], *tables])
    if start:
        rows = np.vstack(
            [np.concatenate([[0], robot.start, np.zeros(robot.dof * len(further))]), rows]
        )
    cells = [[header.format("time"), *names], *([f"{cell:.9g}" for cell in row] for row in rows)]
    return "".join(delimiter.join(row) + end for row in cells)


def following_errors(report):
    """Return the largest following errors of all envs (joints,), as the report prints them."""
    rows = [line.split() for line in report.splitlines() if line.startswith("panda_")]
    assert len(rows) == 9
    return np.array([float(row[4]) for row in rows])


@pytest.mark.parametrize("further", [["setpoint_rate"], []])
def test_a_trajectory_is_followed_as_by_a_runner_with_its_rates(
    saved, tmp_path, panda, motion, further
):
    path = tmp_path / "motion.csv"
    path.write_text(csv(panda, motion, *further))
    run, said = saved("--trajectory", path, short=ONE)
    rows = np.loadtxt(path, delimiter=",", skiprows=1)[:, 1:]
    rates = rows[:, 9:] if further else np.gradient(rows, 0.005, axis=0)
    with Runner(panda, 1, workers=0, params=panda.tuned(), substeps=10) as runner:
        expected = runner.rollout(rows[1:, :9], setpoint_rates=rates[1:])
    np.testing.assert_allclose(run.qpos, expected.qpos, atol=0 if further else 1e-6)
    error = np.abs(expected.qpos - expected.setpoint)[:, 0].max(0)
    assert error.max() < 2e-3
    np.testing.assert_allclose(following_errors(said), error, rtol=0.06, atol=1e-6)


@pytest.mark.parametrize("start", [False, True])
def test_every_env_begins_at_the_start_pose(saved, tmp_path, panda, motion, start):
    """A start elsewhere would count as an error of following."""
    path = tmp_path / "motion.csv"
    path.write_text(csv(panda, motion, start=start))
    run, said = saved("--trajectory", path, short=SHORT[:4])
    np.testing.assert_array_equal(run.info.start, np.tile(panda.start.astype(np.float32), (3, 1)))
    np.testing.assert_allclose(run.time, motion.time)
    assert following_errors(said).max() < 2e-3


@pytest.mark.parametrize(
    "style",
    [
        {"delimiter": ";"},
        {"delimiter": "\t"},
        {"end": "\r\n"},
        {"header": '"{}"', "end": "\r\n"},
    ],
)
def test_files_of_other_programs_read_as_those_of_this_one(saved, tmp_path, panda, motion, style):
    runs = []
    for form in ({}, style):
        path = tmp_path / "motion.csv"
        path.write_bytes(
            csv(panda, motion, "setpoint_rate", "setpoint_acceleration", **form).encode("utf-8-sig")
        )
        runs.append(saved("--trajectory", path, "--engine", "mujoco", short=ONE)[0].arrays())
    for name, rows in runs[0].items():
        np.testing.assert_array_equal(rows, runs[1][name])


def test_rates_take_the_short_way_round_and_followers_need_no_column(saved, tmp_path):
    turning = joint(
        "turn", "base", "t", "continuous", '<limit effort="50" velocity="9"/>', origin="0 3 1"
    )
    arm, path = write(tmp_path, gripper(link("t"), turning)), tmp_path / "motion.csv"
    path.write_text(
        "time,setpoint:left,setpoint:turn\n0,0.1,3.13\n0.01,0.12,-3.13\n0.02,0.14,-3.11\n"
    )
    run, said = saved(arm, "--trajectory", path, short=ONE)
    assert "too fast" not in said
    right, turn = (run.info.joint_names.index(name) for name in ("right", "turn"))
    np.testing.assert_allclose(run.setpoint[:, 0, right], [-0.06, -0.07])
    assert 0 < run.qvel[-1, 0, turn] < 5


LOOP = """<mujoco><worldbody>
  <body name="a"><joint name="a" axis="0 1 0"/><geom size=".1"/></body>
  <body name="b" pos="1 0 0"><joint name="b" axis="0 1 0"/><geom size=".1"/></body>
</worldbody><equality><connect body1="a" body2="b" anchor="0 0 .5"/></equality></mujoco>"""


@pytest.mark.parametrize("words", [("rollout", "--seconds", 0.01), ("view", "--time-limit", 0.1)])
def test_a_closed_loop_has_the_gains_of_a_runner(batchpid, words):
    Path("loop.xml").write_text(LOOP)
    status, _, error = batchpid(words[0], "loop.xml", *words[1:], "--engine", "mujoco", *ONE)
    assert (status, error) == (0, "")


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
        (
            lambda text: "\n".join(text.splitlines()[:2]),
            "line 2: the only row is at 0 s; give a row for",
        ),
        (cut(lambda lines: lines.pop(20)), "line 21: time is 0.1 s, and not 0.095 s; .*apart"),
        (in_column(0, lambda cell: str(1000 * float(cell))), "rows every 5 s; .*seconds"),
        (
            in_column(0, lambda cell: str(0.0033 + float(cell))),
            "line 2: time is 0.0033 s, and not .* begin at 0 or 0.005 s",
        ),
        (
            in_column(0, lambda cell: str(0.74 * float(cell))),
            "line 3: time is 0.0037 s, and not 0.0035 s; .*whole sim steps of 0.0005 s apart, or use"
            " --timestep 0.000528571",
        ),
        (
            in_column(3, lambda cell: "nan"),
            "line 2, column 'setpoint:panda_joint3' is empty or not finite",
        ),
        (
            in_column(12, lambda cell: "fast"),
            "line 2, column 'setpoint_rate:panda_joint3' is not a number",
        ),
        (
            cut(lambda lines: lines[0].__setitem__(3, "qpos:panda_joint3")),
            "unknown column 'qpos:panda_joint3'",
        ),
        (
            cut(lambda lines: lines[0].__setitem__(3, " setpoint: panda_joint1")),
            "with the same name",
        ),
        (
            cut(lambda lines: [line.pop(3) for line in lines]),
            "column setpoint:panda_joint3: is missing",
        ),
        (
            lambda text: text.replace(",", ";").replace(".", ","),
            "line 2, column 'time' is not a number .*decimal point",
        ),
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


def test_rows_at_30_hz_need_the_time_step_that_the_error_names(batchpid, tmp_path, panda, motion):
    path = tmp_path / "motion.csv"
    at_30_hz = in_column(0, lambda cell: f"{float(cell) * 20 / 3:.4f}")
    path.write_text(at_30_hz(csv(panda, motion, "setpoint_rate")))
    _, _, error = batchpid("rollout", "--trajectory", path, *ONE)
    timestep = re.search(r"--timestep ([\d.]+)", error)[1]
    status, _, error = batchpid("rollout", "--trajectory", path, "--timestep", timestep, *ONE)
    assert (status, error) == (0, "")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--seconds", 1), "seconds: is given by the trajectory"),
        (("--setpoint", 0, 0), "setpoint: is given by the trajectory"),
        (("--gains", "sapien-tutorial"), "setpoint_accelerations: needs gains in accelerations"),
        (("--gains", "drive"), "setpoint_accelerations: needs gains in accelerations"),
    ],
)
def test_flags_that_contradict_a_trajectory_are_refused(
    batchpid, tmp_path, panda, motion, flags, message
):
    path = tmp_path / "motion.csv"
    path.write_text(csv(panda, motion, "setpoint_rate", "setpoint_acceleration"))
    status, _, error = batchpid("rollout", "--trajectory", path, *ONE, *flags)
    assert (status, message in error) == (2, True), error


def test_a_trajectory_without_rates_is_a_log(saved, panda, tmp_path, motion):
    """It has no accelerations either, so that gains in efforts follow it."""
    path = tmp_path / "motion.csv"
    path.write_text(csv(panda, motion, "setpoint_rate", "setpoint_acceleration"))
    run, said = saved("--trajectory", path, "--no-rates", "--gains", "sapien-tutorial", short=ONE)
    assert "not given" in said
    assert run.info.rates is False
