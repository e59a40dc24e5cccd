"""Logs from files: CSV and HDF5 with a column for each quantity and joint, recordings of a runner,
and ROS bags.

Columns are ``time`` [s] (or ``time_ms``, ``time_us``, ``time_ns``), ``qpos:JOINT``, and
``setpoint:JOINT``, ``effort:JOINT`` or ``measured_effort:JOINT``, optionally ``feedforward:JOINT``;
others are ignored. A bag is a bag of ROS 1 or ROS 2 or an MCAP file with messages
``sensor_msgs/JointState``, which hold values of joints by name, in any order. In the topic of
measurements efforts are measured efforts. In the topic of commands positions are setpoints, and
efforts are commanded efforts.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import file_path
from batchpid.checks.warn import warn
from batchpid.errors import MissingDependencyError
from batchpid.sim.identification.log import CommandKind, Log, LogWarning, checked, interpolated
from batchpid.sim.recording.recording_files import RecordingError, read_recording
from batchpid.sim.recording.setpoint_files import columns_by_joint, error, read_csv
from batchpid.sim.robot.robot import Robot
from batchpid.sim.signals.rollout import Rollout

QUANTITIES = ("setpoint", "effort", "feedforward", "measured_effort", "qpos")
BAGS = (".bag", ".mcap", ".db3")
HDF5 = (".h5", ".hdf5")
SECONDS = {None: 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
JOINT_STATE = "sensor_msgs/msg/JointState"
_MEASURED = {"position": "qpos", "effort": "measured_effort"}
_COMMANDED = {"position": "setpoint", "effort": "effort"}
_TIME = re.compile(r"time[\s_]*[\[(]?(s|ms|us|ns)?[\])]?")


class Reading(NamedTuple):
    """Meaning of the columns of log files; recordings say it themselves."""

    hold: bool = False
    """True if commands hold from row to row, False to interpolate between rows."""
    degrees: bool = False
    """True if positions of revolute joints, setpoints included, are in degrees."""
    topic: str = "/joint_states"
    """Topic of the measurements in a ROS bag."""
    command_topic: str | None = None
    """Topic of the commands in a ROS bag; None: the measured efforts are used."""
    prefix: str = ""
    """Prefix of the joints' names in a file, which the robot's do not have."""


def read_logs(
    robot: Robot,
    paths: Iterable[str | os.PathLike[str]],
    kind: CommandKind | None = None,
    *,
    reading: Reading | None = None,
) -> list[Log]:
    """Return the logs in files, one for each stretch without gaps in time.

    Parameters
    ----------
    kind
        Command to read where a file has both: "setpoint" or "effort"; default the one that it has,
        else "effort".
    reading
        Units and names in the files; default SI units and the robot's names.

    Raises
    ------
    InvalidArgumentError
        A file holds no log of this robot; the message names the file, line and column.
    RecordingError
        A recording cannot be read.
    MissingDependencyError
        rosbags is not installed, which ROS bags need.
    FileNotFoundError
        There is no such file.
    """
    logs = list[Log]()
    for path in map(Path, paths):
        if not path.exists():
            raise FileNotFoundError(2, "there is no such file", str(path))
        logs += _read(robot, path, kind, reading or Reading())
    return logs


def _read(robot: Robot, path: Path, kind: CommandKind | None, reading: Reading) -> list[Log]:
    lines = None
    if path.suffix.lower() in BAGS or path.is_dir():
        columns = _read_bag(robot, path, reading)
    elif file_path("log", path, (".csv", ".txt", *HDF5, *BAGS)).suffix.lower() in HDF5:
        named = _read_hdf5(path)
        if named is None:
            return logs_of_rollout(robot, read_recording(path), kind, source=str(path))
        columns = named
    else:
        columns, lines = read_csv(path, (*QUANTITIES, "time"))
    return checked(robot, _build(robot, str(path), columns, kind, reading), lines)


def logs_of_rollout(
    robot: Robot, rollout: Rollout, kind: CommandKind | None = None, source: str = "rollout"
) -> list[Log]:
    """Return one log for each env of ``rollout``, whose setpoints are efforts under control
    "effort".

    Raises InvalidArgumentError if the simulation of a fit lacks an effect of the run.
    """
    info = rollout.info
    recorded: CommandKind = "effort" if info.control == "effort" else "setpoint"
    changes = np.abs(np.diff(rollout.time) - rollout.tick)
    obstacles = {
        f"is of the joints {', '.join(info.joint_names)}": info.joint_names != robot.joint_names,
        "was made with setpoints that are not of joints": info.own_command is not None,
        f"was made under control {info.control!r}": info.control not in (None, "pid", "effort"),
        f"holds {recorded}s": kind not in (None, recorded),
        "was made with setpoint rates": bool(info.rates) and recorded == "setpoint",
        "has setpoints that a guard changed": bool(np.any(rollout.guarded)),
        "was made with a randomization": bool(info.randomization),
        "has params that were changed": info.params_changed and recorded == "setpoint",
        "has ticks of varied length": bool((changes > 1e-9 + 1e-6 * rollout.tick).any()),
        "has failed": not rollout.ok.all(),
    }
    for problem, holds in obstacles.items():
        if holds:
            raise error(
                source,
                f"{problem}, which a fit cannot use",
                "record another run under control pid or effort",
            )
    joints = tuple(np.flatnonzero(robot.independent).tolist())
    forwards = rollout.feedforward
    logs = []
    for env in range(rollout.num_envs):
        setpoint, qpos = (
            np.asarray(table, float)[:, env, joints] for table in (rollout.setpoint, rollout.qpos)
        )
        name = source if rollout.num_envs == 1 else f"{source}, env {env}"
        log = Log(
            name,
            joints,
            recorded,
            rollout.time,
            qpos,
            rollout.time - rollout.tick,
            setpoint,
            True,
            info.timestep,
            info.compensate,
            feedforward=None if forwards is None else np.asarray(forwards, float)[:, env, joints],
            params=(
                None
                if info.params is None or recorded == "effort"
                else info.params.for_envs(slice(env, env + 1))
            ),
        )
        logs += checked(robot, log)
    return logs


def _build(
    robot: Robot,
    source: str,
    columns: dict[str, Float64],
    kind: CommandKind | None,
    reading: Reading,
) -> Log:
    """Return the log that the columns of a file hold."""
    times = {name: match[1] for name in columns if (match := _TIME.fullmatch(name))}
    if not times:
        problem = f"has no column 'time', but {', '.join(list(columns)[:6])}"
        raise error(
            source, problem, "begin the header with time, in seconds, or time_ms, time_us, time_ns"
        )
    name, unit = next(iter(times.items()))
    time = SECONDS[unit] * columns[name]
    by = columns_by_joint(robot, source, columns, QUANTITIES, reading.prefix)
    if not by["qpos"]:
        remedy = f"measured positions are needed, e.g. qpos:{robot.joint_names[0]}"
        raise error(source, "has no column qpos:JOINT", remedy)
    measured = bool(by["measured_effort"]) and not by["effort"]
    by["effort"] = by["effort"] or by["measured_effort"]
    kind = kind or ("effort" if by["effort"] else "setpoint")
    if not by[kind]:
        remedy = f"commands are needed, e.g. {kind}:{robot.joint_names[0]}"
        raise error(source, f"has no column {kind}:JOINT", remedy)
    if kind == "effort" and by["feedforward"]:
        raise error(
            source,
            "has a feedforward, which efforts include",
            "give the gains of the law, or leave it out",
        )
    used = ("qpos", kind, *(("feedforward",) if by["feedforward"] else ()))
    names = [name for name, free in zip(robot.joint_names, robot.independent, strict=True) if free]
    names = [name for name in names if any(name in by[quantity] for quantity in used)]
    tables = {}
    for quantity in used:
        for joint in names:
            if joint not in by[quantity]:
                remedy = (
                    "give all columns of a joint or none; a joint that is left out rests at the"
                    " robot's start pose"
                )
                raise error(f"{source}: column {quantity}:{joint}", "is missing", remedy)
        tables[quantity] = np.stack([by[quantity][joint] for joint in names], axis=1)
        if reading.degrees and quantity in ("qpos", "setpoint"):
            turns = [robot.units[robot.joint_names.index(joint)] == "rad" for joint in names]
            tables[quantity] *= np.where(turns, np.pi / 180, 1.0)
    joints = tuple(robot.joint_names.index(joint) for joint in names)
    forward = tables.get("feedforward")
    return Log(
        source,
        joints,
        kind,
        time,
        tables["qpos"],
        time,
        tables[kind],
        reading.hold,
        feedforward=forward,
        measured=measured and kind == "effort",
    )


def _read_hdf5(path: Path) -> dict[str, Float64] | None:
    """Return the datasets of an HDF5 file by the last part of their names; None for a recording of
    a runner.
    """
    import h5py

    datasets = dict[str, Any]()

    def note(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset):
            datasets[name] = node

    try:
        with h5py.File(path, "r", locking=False) as file:
            if "joint_names" in file.attrs:
                return None
            file.visititems(note)
            columns = {
                name: table
                for name, table in datasets.items()
                if table.ndim == 1 and table.dtype.kind in "iuf"
            }
            if not columns:
                problem = (
                    f"has no column 'time' and no qpos:JOINT, but {', '.join(list(datasets)[:6])}"
                )
                raise error(
                    str(path), problem, "give one dataset of one number per row for each column"
                )
            return {
                name.rpartition("/")[2].strip(): np.asarray(table, float)
                for name, table in columns.items()
            }
    except (OSError, RuntimeError) as bad:
        raise RecordingError(f"{path}: cannot be read as a log: {bad}") from bad


def _read_bag(robot: Robot, path: Path, reading: Reading) -> dict[str, Float64]:
    """Return the columns of a bag by name, of the joints of ``robot``, in seconds since the first
    row.

    Messages are merged by the names of joints: each joint has the samples of all messages that name
    it. Rows are at the stamps of the joint with most of them, as long as all joints are measured.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingDependencyError("rosbags", "a log in a ROS bag", "tune") from None
    topics = {reading.topic: _MEASURED} | (
        {reading.command_topic: _COMMANDED} if reading.command_topic else {}
    )
    samples = {topic: defaultdict[str, list[tuple[int, float]]](list) for topic in topics}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            chosen = [
                connection
                for connection in reader.connections
                if connection.topic in topics and connection.msgtype == JOINT_STATE
            ]
            present = sorted(
                connection.topic
                for connection in reader.connections
                if connection.msgtype == JOINT_STATE
            )
            for connection, received, raw in reader.messages(connections=chosen) if chosen else ():
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec or received
                for field, quantity in topics[connection.topic].items():
                    # A driver without such a value leaves the list empty.
                    for joint, value in zip(message.name, getattr(message, field), strict=False):
                        samples[connection.topic][f"{quantity}:{joint}"].append(
                            (stamp, float(value))
                        )
    except Exception as bad:  # a damaged file can make the library raise anything
        raise error(str(path), f"cannot be read: {bad}", "correct or record it again") from None
    for topic, columns in samples.items():
        if not columns:
            remedy = (
                f"use one of its topics of {JOINT_STATE}: {', '.join(present) or 'there are none'}"
            )
            raise error(str(path), f"has no values in the topic {topic!r} of {JOINT_STATE}", remedy)
    names = {f"{reading.prefix}{joint}" for joint in robot.joint_names}
    joints = {name.partition(":")[2] for columns in samples.values() for name in columns}
    others = ", ".join(joint.removeprefix(reading.prefix) for joint in sorted(joints - names))
    stamps = [
        [stamp for stamp, _ in rows]
        for name, rows in samples[reading.topic].items()
        if name in {f"qpos:{joint}" for joint in names}
    ]
    if not stamps:
        remedy = (
            f"the robot has {', '.join(robot.joint_names)}: give the prefix of the names, or"
            " another topic"
        )
        raise error(
            str(path),
            f"has no positions of the robot's joints, but {others or 'other values'}",
            remedy,
        )
    if others:
        warn(f"{path}: {others}: no joint of the robot, left out", LogWarning)
    first, last = max(map(min, stamps)), min(map(max, stamps))
    merged = {
        "time": (
            np.unique([stamp - first for stamp in max(stamps, key=len) if first <= stamp <= last])
            / 1e9
        )
    }
    for columns in samples.values():
        for name, rows in columns.items():
            if name.partition(":")[2] in names:
                table = np.array(sorted((stamp - first, value) for stamp, value in rows))
                merged[name] = interpolated(merged["time"], table[:, 0] / 1e9, table[:, 1:])[:, 0]
    return merged
