"""Logs from files: columns, units, checks, recordings and bags."""

import numpy as np
import pytest
from arms import gains, load, motion, run

import batchpid as bp
from batchpid.sim import Randomization, Recorder, RecordingError, Runner, Uniform
from batchpid.sim.identification import Reading, logs_of_rollout, read_logs
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


def read(robot, folder, values, kind=None, **reading):
    return read_logs(robot, [write(folder / "log.csv", values)], kind, reading=Reading(**reading))


def test_columns_are_found_by_name_in_the_order_of_the_robot(robot, tmp_path):
    others = {"mode": ["idle"] * 200, "setpoint_rate:elbow": TIME}
    (log,) = read(robot, tmp_path, table(**others))
    assert (log.joints, log.kind, log.held) == ((0, 1), "setpoint", False)
    np.testing.assert_allclose(
        log.qpos, np.stack([table()[f"qpos:{joint}"] for joint in JOINTS], axis=1)
    )
    columns = table()
    columns = {"time_ms": 1e3 * columns.pop("time")} | columns
    path = write(tmp_path / "log.txt", columns, ";")
    (other,) = read_logs(robot, [path], reading=Reading(hold=True))
    np.testing.assert_array_equal(other.command, log.command)
    np.testing.assert_allclose(other.time, log.time)
    assert other.held


def test_columns_of_other_names_units_and_signs_are_patterns(robot, tmp_path):
    """The error of a file without them proposes the patterns."""
    (plain,) = read(robot, tmp_path, table("measured_effort"))
    columns = {"stamp_ms": 1e3 * TIME, "mode": ["idle"] * 200}
    for joint in JOINTS:
        columns[f"{joint}.pos_deg"] = np.degrees(table("measured_effort")[f"qpos:{joint}"])
        columns[f"{joint}.tau_mNm"] = 1e3 * table("measured_effort")[f"measured_effort:{joint}"]
    patterns = ("time: stamp_ms ms", "qpos: {joint}.pos_deg deg")
    patterns += ("measured_effort: {joint}.tau_mNm mNm",)
    with pytest.raises(bp.InvalidArgumentError) as refusal:
        read(robot, tmp_path, columns)
    assert all(f'"{pattern}"' in str(refusal.value) for pattern in patterns)
    (log,) = read(robot, tmp_path, columns, columns=patterns)
    assert (log.kind, log.measured) == ("effort", True)
    both = table("effort") | {f"measured_effort:{joint}": TIME for joint in JOINTS}
    assert not read(robot, tmp_path, both)[0].measured
    for name in ("time", "qpos", "command"):
        np.testing.assert_allclose(getattr(log, name), getattr(plain, name), atol=1e-12)
    turned = (*patterns[:2], "measured_effort: -{joint}.tau_mNm -0.002")
    turned += ("measured_effort:elbow: elbow.tau_mNm -1",)
    (other,) = read(robot, tmp_path, columns, columns=turned)
    np.testing.assert_allclose(other.command, plain.command * [2.0, -1000.0], atol=1e-12)
    wrong = {"pattern": "qpos: {joint}_q", "unit": "qpos: {joint}.pos_deg ft"}
    for problem, pattern in wrong.items():
        with pytest.raises(bp.InvalidArgumentError, match=problem):
            read(robot, tmp_path, columns, columns=(pattern,))


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
    r"line 12: time decreases": changed("time", 10, 0.0),
    r"far beyond the joint's limits.*--columns": {
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


def test_repeated_rows_are_left_out_and_a_log_is_divided_at_gaps(robot, tmp_path):
    def picked(*parts):
        rows = np.sort(np.concatenate(parts))
        return read(robot, tmp_path, {name: values[rows] for name, values in table().items()})

    (log,) = picked(np.arange(200), [50, 120])
    assert "2 rows repeat a time, the first at line 53" in str(log.remarks)
    assert len(log.time) == len(log.command) == 200
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
    "actuators": lambda runner: setattr(runner, "actuators", bp.make_actuators(2, strength=2)),
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
    path = tmp_path / "run.h5"
    runner = Runner(robot, 2, params=gains(), workers=0, engine="mujoco")
    with runner, Recorder(path, runner):
        runner.rollout(motion(1.0))
        CHANGES[change](runner)
        rows = len(runner.rollout(motion(1.0)).time)
        CHANGES[change](runner)
    if change == "reset":
        logs = read_logs(robot, [path])
        assert [len(log.time) for log in logs] == [rows, rows, 2 * rows]
        assert all(np.abs(np.diff(log.qpos, axis=0)).max() < 0.1 for log in logs)
        return
    with pytest.raises(bp.InvalidArgumentError, match=f"has .*{change} that w"):
        read_logs(robot, [path])


EPOCH = 1_700_000_000_000_000_000


def bag(path, messages, stamp_of=lambda topic, time: time):
    """Write messages (topic, time [s], values by joint) of states, positions and efforts alike;
    their stamps are those of a function, None for none.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.LATEST)
    names = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "sensor_msgs/msg/JointState")
    header, stamp, state = (types.types[name] for name in names)
    places = {}
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, time, values in messages:
            if topic not in places:
                connection = writer.add_connection(topic, state.__msgtype__, typestore=types)
                places[topic] = connection
            moment = EPOCH + round(1e9 * time)
            stamped = stamp_of(topic, time)
            nanoseconds = 0 if stamped is None else EPOCH + round(1e9 * stamped)
            numbers, none = np.array([*values.values()], float), np.zeros(0)
            head = header(stamp(*divmod(nanoseconds, 10**9)), "")
            message = state(head, [*values], numbers, none, numbers)
            writer.write(places[topic], moment, types.serialize_cdr(message, state.__msgtype__))
    return path


def test_messages_of_a_bag_are_merged_by_joint(robot, tmp_path):
    """Joints come in any order, in messages of their own, and beside other devices."""
    pytest.importorskip("rosbags")
    messages = []
    for row, time in enumerate(TIME):
        states = [("elbow", np.sin(time)), ("shoulder", np.cos(time))]
        messages.append(("/joint_states", time, dict(states[:: 1 if row % 3 else -1])))
    # Another device has more rows, and begins and ends at other times.
    times = np.arange(-1, TIME[-1] + 1, 0.004)
    messages += [("/joint_states", time, {"finger": 0.0}) for time in times]
    (log,) = read_logs(robot, [bag(tmp_path / "bag", messages)])
    assert "finger: no joint of the robot" in str(log.remarks)
    np.testing.assert_allclose(log.qpos, np.stack([np.cos(TIME), np.sin(TIME)], axis=1), atol=1e-9)
    assert log.measured
    apart = []
    for time in TIME:
        apart.append(("/joint_states", time, {"shoulder": np.sin(time)}))
        apart.append(("/joint_states", time + 0.001, {"elbow": np.sin(time + 0.001)}))
        apart += [("/commands", time, {joint: np.sin(time)}) for joint in reversed(JOINTS)]
    path = bag(tmp_path / "apart", apart)
    reading = Reading(command_topic="/commands", columns=("setpoint: -setpoint:{joint} deg",))
    (log,) = read_logs(robot, [path], "setpoint", reading=reading)
    np.testing.assert_allclose(log.qpos, np.sin(TIME[1:, None]) * np.ones(2), atol=1e-5)
    np.testing.assert_allclose(log.command[0], -np.radians(np.sin(TIME[1])), atol=1e-4)
    words = r"in the topic '/states'.*: /commands, /joint_states"
    with pytest.raises(bp.InvalidArgumentError, match=words):
        read_logs(robot, [path], reading=Reading(topic="/states"))


@pytest.mark.parametrize("hold", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_commands_of_a_bag_act_from_their_own_stamps_on(tmp_path, hold, seed):
    """Held, the command at any time is the last one at or before it; there are no rows outside the
    times that all topics have, and none within a silence of one, which divides the log.
    """
    pytest.importorskip("rosbags")
    rng = np.random.default_rng(seed)
    stamps = {}
    for topic in ("/joint_states", "/commands"):
        period = rng.uniform(0.002, 0.02)
        steps = period * rng.uniform(0.7, 1.3, int(3 / period))
        stamps[topic] = np.round(rng.uniform(0, 0.3) + np.cumsum(steps), 9)
    silent = str(rng.choice(["/joint_states", "/commands"]))
    begin = rng.uniform(1, 1.5)
    kept = (stamps[silent] < begin) | (stamps[silent] > begin + rng.uniform(0.1, 0.5))
    stamps[silent] = stamps[silent][kept]
    values = {topic: rng.uniform(-1, 1, len(times)) for topic, times in stamps.items()}
    messages = []
    for topic, times in stamps.items():
        for time, value in zip(times.tolist(), values[topic].tolist(), strict=True):
            messages.append((topic, time, dict.fromkeys(JOINTS, value)))
    path = bag(tmp_path / "bag", sorted(messages, key=lambda message: message[1]))
    reading = Reading(command_topic="/commands", hold=hold)
    logs = read_logs(load(tmp_path), [path], "setpoint", reading=reading)
    assert all("the log is divided" in str(log.remarks) for log in logs)
    assert len(logs) == 2
    origin = max(times[0] for times in stamps.values())
    for log in logs:
        times = log.time + origin
        for known in stamps.values():
            assert known[0] - 1e-9 <= times[0]
            assert times[-1] <= known[-1] + 1e-9
            following = known[np.searchsorted(known, times - 1e-9)]
            assert (following - times < 0.05).all()
        moments = rng.uniform(log.time[0], log.time[-1], 200)
        moments = moments[(np.abs(moments[:, None] + origin - stamps["/commands"]) > 1e-6).all(1)]
        known, sent = stamps["/commands"], values["/commands"]
        expected = np.interp(moments + origin, known, sent)
        if hold:
            expected = sent[np.searchsorted(known, moments + origin) - 1]
        np.testing.assert_allclose(log.commands_at(moments)[:, 0], expected, atol=1e-6)


def test_topics_of_two_clocks_are_refused_by_name(robot, tmp_path):
    pytest.importorskip("rosbags")
    topics = ("/joint_states", "/commands")
    messages = [(topic, time, dict.fromkeys(JOINTS, 0.1)) for time in TIME for topic in topics]
    stamps = {
        "'/commands' without stamps": lambda topic, time: time if topic[1] == "j" else None,
        r"'/commands' 0\.300 s": lambda topic, time: time - 0.3 * (topic[1] == "c"),
    }
    for number, (problem, stamp) in enumerate(stamps.items()):
        path = bag(tmp_path / f"bag{number}", messages, stamp)
        with pytest.raises(bp.InvalidArgumentError, match=problem):
            read_logs(robot, [path], reading=Reading(command_topic="/commands"))


def test_files_that_are_no_logs_say_what_a_log_is(robot, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "run_0.db3").touch()
    (tmp_path / "damaged.mcap").write_bytes(b"nothing")
    pytest.importorskip("h5py").File(tmp_path / "other.h5", "w").close()
    for name, words in {
        "folder": r"without metadata\.yaml, with run_0\.db3",
        "damaged.mcap": "cannot be read",
        "other.h5": r"format is not .*a log is a \.csv file with",
    }.items():
        with pytest.raises((bp.InvalidArgumentError, RecordingError), match=words):
            read_logs(robot, [tmp_path / name])
