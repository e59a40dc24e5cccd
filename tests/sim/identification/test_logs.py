"""Logs from files: columns, checks and recordings."""

import numpy as np
import pytest
from arms import gains, load, motion, run
from pages import ROOT, blocks

import batchpid as bp
from batchpid.sim import Randomization, RecordingError, Rollout, Runner, Uniform, write_recording
from batchpid.sim.identification import logs_of_rollout, read_logs
from batchpid.sim.identification.log import checked

JOINTS = ("shoulder", "elbow")
TIME = 0.005 * np.arange(200)


@pytest.fixture
def robot(tmp_path):
    return load(tmp_path)


def table(kind="setpoint", **changes):
    """Return the columns of a log, the joints in another order than the robot's."""
    columns = {"time": TIME}
    for number, joint in enumerate(reversed(JOINTS)):
        columns[f"{kind}:{joint}"] = 0.5 * np.sin(3 * TIME) + number
        columns[f"qpos:{joint}"] = 0.5 * np.sin(3 * TIME - 0.1) + number
    return columns | changes


def write(path, columns, delimiter=","):
    rows = zip(*columns.values(), strict=True)
    lines = [delimiter.join(map(str, row)) for row in (columns, *rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def read(robot, folder, values, kind=None):
    return read_logs(robot, [write(folder / "log.csv", values)], kind)


def test_columns_are_found_by_name_in_the_order_of_the_robot(robot, tmp_path):
    others = {"mode": ["idle"] * 200, "setpoint_rate:elbow": TIME}
    (log,) = read(robot, tmp_path, table(**others))
    assert (log.joints, log.kind, log.held) == ((0, 1), "setpoint", False)
    np.testing.assert_allclose(
        log.qpos, np.stack([table()[f"qpos:{joint}"] for joint in JOINTS], axis=1)
    )
    path = write(tmp_path / "log.txt", table(), ";")
    (other,) = read_logs(robot, [path], hold=True)
    np.testing.assert_array_equal(other.command, log.command)
    np.testing.assert_array_equal(other.time, log.time)
    assert other.held
    both = table("effort") | {f"measured_effort:{joint}": TIME for joint in JOINTS}
    assert not read(robot, tmp_path, both)[0].measured
    (log,) = read(robot, tmp_path, table("measured_effort"))
    assert (log.kind, log.measured) == ("effort", True)


def test_a_quotation_mark_that_is_not_closed_ends_with_its_line(robot, tmp_path):
    (log,) = read(robot, tmp_path, table(mode=["idle"] * 3 + ['"stop'] + ["idle"] * 196))
    assert len(log.time) == len(TIME)


def changed(name, row, value, kind="setpoint"):
    columns = {key: values.astype(object) for key, values in table(kind).items()}
    columns[name][row] = value
    return columns


FAULTS = {
    r"column time.* is missing.*time, qpos:JOINT": {"a": TIME},
    r"column qpos:elbow.* is missing": {"time": TIME, "effort:elbow": TIME},
    r"column qpos:JOINT.* is missing": {"time": TIME},
    r"column setpoint:elbow.* is missing": {"time": TIME, "qpos:elbow": TIME},
    r"knee": {"time": TIME, "qpos:knee": TIME},
    r"line 12, column 'qpos:elbow' is empty or not finite": changed("qpos:elbow", 10, ""),
    r"line 12, column 'qpos:elbow' is not a number": changed("qpos:elbow", 10, "1 rad"),
    r"line 12: time does not increase": changed("time", 10, TIME[9]),
    r"far beyond the joint's limits.*in rad or m": {
        name: 60 * v if name[0] == "q" else v for name, v in table().items()
    },
    r"one row per 5 s": table(time=1e3 * TIME),
    r"has 40 rows": {name: values[:40] for name, values in table().items()},
    r"has a feedforward": (table("effort") | {f"feedforward:{joint}": TIME for joint in JOINTS}),
}


@pytest.mark.parametrize("problem", FAULTS)
def test_faults_name_the_column_and_the_line(robot, tmp_path, problem):
    with pytest.raises(bp.InvalidArgumentError, match=problem):
        read(robot, tmp_path, FAULTS[problem])


def test_a_log_is_divided_at_gaps(robot, tmp_path):
    def picked(*parts):
        rows = np.sort(np.concatenate(parts))
        return read(robot, tmp_path, {name: values[rows] for name, values in table().items()})

    first, second = picked(np.arange(80), np.arange(120, 200))
    assert (len(first.time), len(second.time)) == (80, 80)
    assert second.time[0] == second.command_time[0] == TIME[120]
    (only,) = picked(np.arange(20), np.arange(120, 200))
    assert "too short, left out: line 2 to line 21" in str(only.remarks)
    assert len(only.time) == 80


def test_wrapped_positions_become_continuous_once(robot, tmp_path):
    """A log that was checked is not checked again."""
    turning = 3.0 + np.sin(3 * TIME)
    wrapped = (turning + np.pi) % (2 * np.pi) - np.pi
    columns = table(**{"qpos:elbow": wrapped, "setpoint:elbow": wrapped})
    (log,) = read(robot, tmp_path, columns)
    np.testing.assert_allclose(log.qpos[:, 1], turning, atol=1e-12)
    np.testing.assert_allclose(log.command[:, 1], turning, atol=1e-12)
    assert checked(robot, log) == [log]
    with pytest.raises(bp.InvalidArgumentError, match="jumps by"):
        read(robot, tmp_path, table(**{"qpos:elbow": np.where(TIME < 0.5, 0.0, 4.5)}))


NONE = 0 * motion(0.5)
DRIVEN = dict.fromkeys(("strength", "command_delay"))
REFUSED = {
    "guard changed": lambda robot: {"guard": robot.guard(rate=np.full(2, 0.1))},
    "randomization": lambda _: {"randomization": Randomization(payload=Uniform(0.1, 0.2))},
    "under control 'drive'": lambda _: {"control": "drive", "actuators": DRIVEN},
    "setpoint rates": lambda _: {"commands": {"setpoint_rates": NONE}},
    "a feedforward": lambda _: {"commands": {"feedforwards": NONE}},
}
CHANGES = {
    "params": lambda runner: setattr(runner, "params", gains().replace(kp=1.0)),
    "snapshot": lambda runner: runner.restore(runner.snapshot()),
    "reset": lambda runner: runner.reset(np.full(2, 0.3), mask=[True, False]),
}


@pytest.mark.parametrize("problem", REFUSED)
def test_runs_that_a_fit_cannot_simulate_are_refused(robot, problem):
    rollout = run(robot, motion(0.5), **REFUSED[problem](robot))
    with pytest.raises(bp.InvalidArgumentError, match=problem):
        logs_of_rollout(robot, rollout)


@pytest.mark.parametrize("change", CHANGES)
def test_a_recording_is_refused_or_divided_at_a_change(robot, tmp_path, change):
    """Params have no effect under control "effort", and a reset begins another stretch."""
    with Runner(robot, 2, params=gains(), workers=0, engine="mujoco") as runner:
        first = runner.rollout(motion(1.0))
        CHANGES[change](runner)
        second = runner.rollout(motion(1.0))
    rows = len(second.time)
    path = write_recording(Rollout.join([first, second]), tmp_path / "run.h5")
    if change == "reset":
        logs = read_logs(robot, [path])
        assert [len(log.time) for log in logs] == [rows, rows, 2 * rows]
        assert all(np.abs(np.diff(log.qpos, axis=0)).max() < 0.1 for log in logs)
        return
    with pytest.raises(bp.InvalidArgumentError, match=f"has .*{change} that w"):
        read_logs(robot, [path])


def test_the_program_of_the_page_makes_a_log_of_a_bag(robot, tmp_path, monkeypatch):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.LATEST)
    names = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "sensor_msgs/msg/JointState")
    header, stamp, state = (types.types[name] for name in names)
    monkeypatch.chdir(tmp_path)
    storage = rosbag2.StoragePlugin.MCAP
    with rosbag2.Writer("bag", version=9, storage_plugin=storage) as writer:
        line = writer.add_connection("/joint_states", names[-1], typestore=types)
        for time in TIME:
            seconds, part = 1_700_000_000 + int(time), round(1e9 * (time % 1))
            values = np.array([np.sin(time), np.cos(time)])
            message = state(header(stamp(seconds, part), ""), [*JOINTS], values, 0 * values, values)
            writer.write(line, 0, types.serialize_cdr(message, names[-1]))
    exec(blocks(ROOT / "docs/sim-to-real.md", "text")[0]["code"], {})
    (log,) = read_logs(robot, ["log.csv"])
    np.testing.assert_allclose(log.time - log.time[0], TIME, atol=1e-6)
    np.testing.assert_allclose(log.qpos, np.stack([np.sin(TIME), np.cos(TIME)], axis=1))
    assert log.measured


def test_files_that_are_no_logs_say_what_a_log_is(robot, tmp_path):
    pytest.importorskip("h5py").File(tmp_path / "other.h5", "w").close()
    for name, words in {
        "bag.mcap": r"unknown file format.*\.csv",
        "other.h5": r"format is not .*a log is a \.csv file with",
    }.items():
        with pytest.raises((bp.InvalidArgumentError, RecordingError), match=words):
            read_logs(robot, [tmp_path / name])
