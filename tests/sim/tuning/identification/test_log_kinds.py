"""Logs as people have them: units, names, ROS bags, and settings of each log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import batchpid as bp
from batchpid.sim.identification import Log, LogWarning, Reading, read_logs

JOINTS = [f"panda_joint{number}" for number in range(1, 8)]


def table(panda, rows: int = 400) -> dict[str, np.ndarray]:
    """Return the columns of a log of seven joints at 500 Hz, whose motion is slow compared with the limits."""
    stamps = 2_000_000 * np.arange(rows)
    columns = {"time": stamps / 1e9}
    for number, joint in enumerate(JOINTS):
        columns[f"qpos:{joint}"] = panda.start[number] + 0.1 * np.sin(3 * columns["time"] + number)
        columns[f"effort:{joint}"] = 2.0 * np.sin(5 * columns["time"] + number)
        columns[f"measured_effort:{joint}"] = 1.9 * columns[f"effort:{joint}"]
    return columns


def write(path: Path, columns: dict[str, np.ndarray]) -> Path:
    rows = [",".join(columns), *(",".join(map(repr, row)) for row in np.column_stack([*columns.values()]).tolist())]
    path.write_text("\n".join(rows))
    return path


def assert_equal(a: Log, b: Log) -> None:
    assert (a.joints, a.kind, a.sensor) == (b.joints, b.kind, b.sensor)
    for name in ("time", "qpos", "command_time", "command", "measured"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=1e-12)


def test_units_prefixes_signs_and_scales_are_converted(panda, tmp_path):
    columns = table(panda)
    (plain,) = read_logs(panda, [write(tmp_path / "plain.csv", columns)])
    assert (plain.kind, plain.sensor, plain.is_measured) == ("effort", "motor", False)
    other = {name.replace(":", ":arm_"): np.degrees(v) if "qpos" in name else v for name, v in columns.items()}
    other = {name: {"qpos": -v}.get(name[:4], -10 * v) if JOINTS[0] in name else v for name, v in other.items()}
    other["time_ms"] = 1000 * other.pop("time")
    reading = Reading(degrees=True, prefix="arm_", sign={JOINTS[0]: -1}, scale={JOINTS[0]: 0.1})
    path = write(tmp_path / "other.csv", other)
    assert_equal(read_logs(panda, [path], reading=reading)[0], plain)
    with pytest.raises(bp.InvalidArgumentError, match="has the column 'time_ms', not in ns"):
        read_logs(panda, [path], reading=reading._replace(time_unit="ns"))
    nanoseconds = write(tmp_path / "ns.csv", columns | {"time": 1e9 * columns["time"]})
    assert_equal(read_logs(panda, [nanoseconds], reading=Reading(time_unit="ns"))[0], plain)
    small = columns | {f"qpos:{JOINTS[1]}": 1.5 * np.sin(12 * columns["time"])}  # degrees, within the limits in rad
    with pytest.warns(LogWarning, match=r": panda_joint2 moves 4 times.* look like degrees"):
        read_logs(panda, [write(tmp_path / "small.csv", small)])


def bag(path: Path, columns: dict[str, np.ndarray], version: int, storage: str = "SQLITE3") -> None:
    """Write states and commands as rosbags does; joints have a prefix and another order, and a gripper is with them."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.LATEST)
    header, stamp, state = (
        types.types[f"{name}"]
        for name in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "sensor_msgs/msg/JointState")
    )
    sequence = {"seq": 0} if version == 1 else {}
    serialize = types.serialize_ros1 if version == 1 else types.serialize_cdr
    plugin = getattr(rosbag2.StoragePlugin, storage)
    opened = rosbag1.Writer(path) if version == 1 else rosbag2.Writer(path, version=9, storage_plugin=plugin)
    joints, none = [*reversed(JOINTS)], np.zeros(0)
    with opened as writer:
        places = [
            writer.add_connection(topic, state.__msgtype__, typestore=types) for topic in ("/states", "/commands")
        ]
        for row, time in enumerate(columns["time"]):
            nanoseconds = 1_700_000_000_000_000_000 + round(1e9 * time)
            head = header(**sequence, stamp=stamp(*divmod(nanoseconds, 10**9)), frame_id="")
            qpos, measured, effort = (
                np.array([columns[f"{kind}:{joint}"][row] for joint in joints])
                for kind in ("qpos", "measured_effort", "effort")
            )
            names = [f"arm/{joint}" for joint in joints]
            with_gripper = state(head, [*names, "gripper"], np.r_[qpos, 0.0], none, np.r_[measured, 0.0])
            for place, message in zip(places, (with_gripper, state(head, names, none, none, effort)), strict=True):
                writer.write(place, nanoseconds + 5_000_000, serialize(message, state.__msgtype__))


@pytest.mark.parametrize(
    ("name", "version", "storage"), [("a.bag", 1, "SQLITE3"), ("folder", 2, "SQLITE3"), ("folder", 2, "MCAP")]
)
def test_a_bag_is_read_as_the_csv_file(panda, tmp_path, name, version, storage):
    pytest.importorskip("rosbags")
    columns = table(panda)
    bag(tmp_path / name, columns, version, storage)
    (plain,) = read_logs(panda, [write(tmp_path / "log.csv", columns)])
    paths = [tmp_path / name, *(tmp_path / name).glob("*.mcap")]
    reading = Reading(topic="/states", command_topic="/commands", prefix="arm/")
    for path in paths:
        with pytest.warns(LogWarning, match="gripper: no joint of the robot, left out"):
            (log,) = read_logs(panda, [path], reading=reading)
        assert_equal(log, plain)
        assert np.array_equal(log.qpos, plain.qpos)  # the same bits, so that a fit has the same result
        assert np.array_equal(log.time, plain.time)
    with pytest.raises(bp.InvalidArgumentError, match=r"no topic '/joint_states'.*use one of .*/commands, /states"):
        read_logs(panda, paths)
    with pytest.raises(bp.InvalidArgumentError, match=r"none of the robot's joints, but arm/panda_joint7"):
        read_logs(panda, paths, reading=reading._replace(prefix=""))
    with pytest.warns(LogWarning, match="gripper"):
        (alone,) = read_logs(panda, paths[:1], reading=reading._replace(command_topic=None))
    assert alone.is_measured
    np.testing.assert_allclose(alone.command, plain.measured)


def test_topics_are_refused_where_there_are_none(panda, tmp_path):
    path = write(tmp_path / "log.csv", table(panda))
    for reading in (Reading(topic="/states"), Reading(command_topic="/commands")):
        with pytest.raises(bp.InvalidArgumentError, match=r"topic: is not for .*log.csv, which is no ROS bag"):
            read_logs(panda, [path], reading=reading)


def test_a_damaged_bag_is_refused(panda, tmp_path):
    pytest.importorskip("rosbags")
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"#ROSBAG V2.0\nnothing")
        with pytest.raises(bp.InvalidArgumentError, match="cannot be read"):
            read_logs(panda, [tmp_path / name])


def test_a_list_of_logs_has_settings_for_each(panda, tmp_path):
    columns = table(panda)
    write(tmp_path / "a.csv", columns)
    del columns["time"]
    setpoints = {
        name.replace("effort", "setpoint"): values for name, values in columns.items() if "measured" not in name
    }
    write(tmp_path / "b.csv", {"time_s": 0.002 * np.arange(400), **setpoints})
    bp.save_params(tmp_path / "stiff.yaml", panda.designed("effort"), panda.joint_names)
    (tmp_path / "runs.yaml").write_text(
        "gains: stiff.yaml\nlogs:\n- {log: b.csv, start: 0.1, end: 0.5, payload: 0.5}\n- {log: b.csv, held_out: true}\n"
    )
    first, second = read_logs(panda, [tmp_path / "runs.yaml"])
    assert (first.time[0], first.time[-1]) == pytest.approx((0.1, 0.5))
    assert (first.settings.payload, first.settings.held_out, second.settings.held_out) == (0.5, False, True)
    np.testing.assert_array_equal(first.settings.params.kp, panda.designed("effort").kp)
    for entry, message in (
        ("{log: a.csv, mass: 1}", r"logs\[0\]: key: unknown option"),
        ("{payload: 1}", r"logs\[0\]: names no log"),
        ("{log: a.csv, payload: -1}", r"logs\[0\]: payload: out of range"),
        ("{log: a.csv, sign: {panda_joint1: 2}}", r"sign: panda_joint1: is no such factor .*write 1 or -1"),
        ("{log: a.csv, scale: {elbow: 2}}", r"scale: unknown option"),
        ("{log: a.csv, start: 5}", r"wrong.yaml: logs\[0\]: .*a.csv.* has no rows from 5 to inf s"),
        ("{log: a.csv, gains: 3}", r"wrong.yaml: logs\[0\]: gains: must be a str"),
        ("{log: a.csv, gains: none}", r"wrong.yaml: logs\[0\]: gains: is neither a name nor a file"),
        ("{log: a.csv, urdf: 3}", r"wrong.yaml: logs\[0\]: urdf: must be a str"),
        ("{log: a.csv, gains: none.yaml}", "is neither a name nor a file of gains"),
    ):
        (tmp_path / "wrong.yaml").write_text(f"logs:\n- {entry}\n")
        with pytest.raises(bp.InvalidArgumentError, match=message):
            read_logs(panda, [tmp_path / "wrong.yaml"])
