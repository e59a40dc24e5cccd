"""Logs from files: CSV with a column for each quantity and joint, recordings of a runner, and ROS
bags.

Columns are ``time`` [s] (or ``time_ms``, ``time_us``, ``time_ns``), ``qpos:JOINT``, and
``setpoint:JOINT``, ``effort:JOINT`` or ``measured_effort:JOINT``. ``feedforward:JOINT`` is refused,
others are ignored. A bag is a bag of ROS 1 or ROS 2 or an MCAP file with messages
``sensor_msgs/JointState``, which hold values of joints by name, in any order. In the topic of
measurements efforts are measured efforts. In the topic of commands positions are setpoints, and
efforts are commanded efforts.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import file_path
from batchpid.errors import MissingDependencyError, warn
from batchpid.sim.identification.log import CommandKind, Log, LogWarning, checked
from batchpid.sim.recording.recording_files import read_recording
from batchpid.sim.recording.setpoint_files import columns_by_joint, error, read_csv
from batchpid.sim.robot.robot import Robot
from batchpid.sim.rollout import ACTUATORS, PARAMS, RESET, RESTORE, Rollout

QUANTITIES = ("setpoint", "effort", "feedforward", "measured_effort", "qpos")
BAGS = (".bag", ".mcap", ".db3")
HDF5 = (".h5", ".hdf5")
SECONDS = {"time": 1.0, "time_ms": 1e-3, "time_us": 1e-6, "time_ns": 1e-9}
JOINT_STATE = "sensor_msgs/msg/JointState"


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
        logs += _read(robot, path, kind, reading or Reading())
    return logs


def _read(
    robot: Robot,
    path: Path,
    kind: CommandKind | None,
    reading: Reading,
) -> list[Log]:
    suffix = path.suffix.lower()
    if suffix in HDF5:
        return logs_of_rollout(robot, read_recording(path), kind, source=str(path))
    lines = None
    if path.exists() and (suffix in BAGS or path.is_dir()):
        columns = _read_bag(robot, path, reading)
    else:
        file_path("log", path, (".csv", ".txt", *HDF5, *BAGS))
        columns, numbers = read_csv(path, (*QUANTITIES, "time"))
        lines = np.array(numbers)
    log = _build(robot, str(path), columns, kind, reading)
    return checked(robot, replace(log, lines=lines))


def logs_of_rollout(
    robot: Robot,
    rollout: Rollout,
    kind: CommandKind | None = None,
    source: str = "rollout",
) -> list[Log]:
    """Return a log for each env of ``rollout`` and each stretch between its resets. Setpoints are
    efforts under control "effort".

    Raises InvalidArgumentError if the simulation of a fit lacks an effect of the run.
    """
    info = rollout.info
    recorded: CommandKind = "effort" if info.control == "effort" else "setpoint"
    follows = recorded == "setpoint"
    lengths = np.abs(np.diff(rollout.time) - rollout.tick)
    # Changes before the first row are before the log.
    within = np.zeros((0, rollout.num_envs), np.uint8)
    if rollout.changes is not None:
        within = rollout.changes[1:]
    obstacles = {
        f"is of the joints {', '.join(info.joint_names)}": info.joint_names != robot.joint_names,
        "was made with a plan": info.plan is not None,
        "was made with setpoints that are not of joints": info.own_command is not None,
        f"was made under control {info.control!r}": info.control not in (None, "pid", "effort"),
        f"holds {recorded}s": kind not in (None, recorded),
        "was made with setpoint rates": bool(info.rates) and follows,
        "was made with a feedforward": rollout.feedforward is not None,
        "has setpoints that a guard changed": bool(np.any(rollout.guarded)),
        "was made with a randomization": bool(info.randomization),
        "has params that were changed": bool((within & PARAMS).any()) and follows,
        "has actuators that were changed": bool((within & ACTUATORS).any()),
        "has a snapshot that was restored": bool((within & RESTORE).any()),
        "has ticks of varied length": bool((lengths > 1e-9 + 1e-6 * rollout.tick).any()),
        "has failed": not rollout.ok.all(),
    }
    for problem, holds in obstacles.items():
        if holds:
            remedy = "record another run under control pid or effort"
            raise error(source, f"{problem}, which a fit cannot use", remedy)
    joints = np.flatnonzero(robot.independent)
    logs = []
    for env in range(rollout.num_envs):
        params = None
        if info.params is not None and follows:
            params = info.params.for_envs(slice(env, env + 1))
        log = Log(
            source if rollout.num_envs == 1 else f"{source}, env {env}",
            tuple(joints.tolist()),
            recorded,
            rollout.time,
            rollout.qpos[:, env, joints].astype(float),
            rollout.time - rollout.tick,
            np.asarray(rollout.setpoint)[:, env, joints].astype(float),
            held=True,
            timestep=info.timestep,
            compensate=info.compensate,
            params=params,
        )
        resets = np.flatnonzero(within[:, env] & RESET) + 1
        logs += checked(robot, log, resets.tolist())
    return logs


def _build(
    robot: Robot,
    source: str,
    columns: dict[str, Float64],
    kind: CommandKind | None,
    reading: Reading,
) -> Log:
    """Return the log that the columns of a file hold."""
    unit = next((name for name in SECONDS if name in columns), None)
    if unit is None:
        problem = f"has no column 'time', but {', '.join(list(columns)[:6])}"
        remedy = "begin the header with time, in seconds, or time_ms, time_us, time_ns"
        raise error(source, problem, remedy)
    time = SECONDS[unit] * columns[unit]
    by = columns_by_joint(robot, source, columns, QUANTITIES, reading.prefix)
    if by["feedforward"]:
        remedy = "log the complete efforts, without the columns of the feedforward"
        raise error(source, "has a feedforward, which a fit does not simulate", remedy)
    # Measured efforts stand for commands that were not logged.
    measured = not by["effort"]
    by["effort"] = by["effort"] or by["measured_effort"]
    kind = kind or ("effort" if by["effort"] else "setpoint")
    joints = list[int]()
    for joint, name in enumerate(robot.joint_names):
        if robot.independent[joint] and name in by["qpos"] | by[kind]:
            joints.append(joint)
    names = [robot.joint_names[joint] for joint in joints]
    revolute = np.array([robot.units[joint] == "rad" for joint in joints])
    tables = dict[str, Float64]()
    for quantity in ("qpos", kind):
        for name in names or ["JOINT"]:
            if name not in by[quantity]:
                remedy = "positions and commands are needed; a joint without both rests"
                raise error(f"{source}: column {quantity}:{name}", "is missing", remedy)
        tables[quantity] = np.stack([by[quantity][name] for name in names], axis=1)
        if reading.degrees and quantity != "effort":
            tables[quantity] *= np.where(revolute, np.radians(1.0), 1.0)
    measured = measured and kind == "effort"
    table = tables[kind]
    hold = reading.hold
    return Log(
        source, tuple(joints), kind, time, tables["qpos"], time, table, hold, measured=measured
    )


def _read_bag(robot: Robot, path: Path, reading: Reading) -> dict[str, Float64]:
    """Return the columns of a bag by name, in seconds since the first row.

    Messages are merged by the names of joints: each joint has the samples of all messages that name
    it. Rows are at the stamps of the joint with most positions, as long as all columns have values.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingDependencyError("rosbags", "a log in a ROS bag", "tune") from None
    topics = {reading.topic: ("qpos:", "measured_effort:")}
    if reading.command_topic:
        topics[reading.command_topic] = ("setpoint:", "effort:")
    samples = defaultdict[str, dict[int, float]](dict)
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            states = [line for line in reader.connections if line.msgtype == JOINT_STATE]
            # Without a connection the reader would return all messages.
            for line, received, raw in reader.messages(connections=states) if states else ():
                message: Any = reader.deserialize(raw, line.msgtype)
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec or received
                lists = message.position, message.effort
                # A driver without such a value leaves the list empty.
                for quantity, values in zip(topics.get(line.topic, ()), lists, strict=False):
                    for name, value in zip(message.name, values, strict=False):
                        samples[f"{quantity}{name}"][stamp] = float(value)
    except Exception as bad:  # a damaged file can make the library raise anything
        raise error(str(path), f"cannot be read: {bad}", "correct or record it again") from None
    # Other devices publish joints of their own.
    others = dict[str, str]()
    for column in samples:
        joint = column.partition(":")[2].removeprefix(reading.prefix)
        if joint not in robot.joint_names:
            others[column] = joint
    left_out = ", ".join(sorted(set(others.values())))
    for column in others:
        del samples[column]
    needed = {reading.topic: ("qpos:",), reading.command_topic: ("setpoint:", "effort:")}
    for topic, quantities in needed.items():
        if topic and not any(column.startswith(quantities) for column in samples):
            problem = f"has no values in the topic {topic!r} of the robot's joints"
            present = ", ".join(sorted(line.topic for line in states)) or "there are none"
            remedy = f"topics of {JOINT_STATE}: {present}; other joints: {left_out or 'none'}"
            raise error(str(path), problem, remedy)
    if others:
        warn(f"{path}: {left_out}: no joint of the robot, left out", LogWarning)
    stamps = [sorted(rows) for column, rows in samples.items() if column.startswith("qpos:")]
    first = max(joint[0] for joint in stamps)
    last = min(joint[-1] for joint in stamps)
    time = np.array([stamp - first for stamp in max(stamps, key=len) if first <= stamp <= last])
    columns = {"time": time / 1e9}
    for column, rows in samples.items():
        moments = sorted(rows)
        values = [rows[stamp] for stamp in moments]
        columns[column] = np.interp(time, [stamp - first for stamp in moments], values)
    return columns
