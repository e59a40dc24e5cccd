"""Logs from files: CSV with a column for each quantity and joint, recordings of a runner, and ROS
bags.

Columns are ``time`` [s] (or ``time_ms``, ``time_us``, ``time_ns``), ``qpos:JOINT``, and
``setpoint:JOINT``, ``effort:JOINT`` or ``measured_effort:JOINT``. ``feedforward:JOINT`` is refused,
others are ignored. A bag is a bag of ROS 1 or ROS 2 or an MCAP file with messages
``sensor_msgs/JointState``, which hold values of joints by name, in any order. In the topic of
measurements efforts are measured efforts. In the topic of commands positions are setpoints, and
efforts are commanded efforts.

Commands keep their own stamps: one that holds acts until the next one. A bag has rows only where
all topics have messages; it is divided where one is silent for more than three of its periods, and
refused where the stamps of its topics are of different clocks.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.checks import file_path
from batchpid.errors import BatchPIDError, MissingDependencyError
from batchpid.sim.identification.log import GAP, CommandKind, Log, checked, logs_of_rollout
from batchpid.sim.recording.recording_files import RecordingError, read_recording
from batchpid.sim.recording.setpoint_files import columns_by_joint, error, read_csv
from batchpid.sim.robot.robot import Robot

LOG_QUANTITIES = ("setpoint", "effort", "feedforward", "measured_effort", "qpos")
BAGS = (".bag", ".mcap", ".db3")
HDF5 = (".h5", ".hdf5")
UNITS = {
    "deg": np.pi / 180,
    "mrad": 1e-3,
    "mm": 1e-3,
    "mNm": 1e-3,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
}
"""Units of columns, over those of SI."""
MEANINGS = {
    "setpoint": r"cmd|goal|target|desired|ref|setpoint",
    "measured_effort": r"tau|torque|effort|eff\b|nm",
    "qpos": r"pos|angle|qpos|\bq\b",
}
"""Words in the names of columns by which a pattern is proposed, the clearest first."""
JOINT_STATE = "sensor_msgs/msg/JointState"
SILENT_PERIODS, LEAST_SILENCE = 3, 0.01
"""Silence of a topic that divides a log: in median periods of its messages, and at least [s]."""
CLOCK_OFFSET = 0.05
"""Difference of two topics' times from stamp to receipt from which their clocks differ [s]."""
A_LOG = "a log is a .csv file with the columns time, qpos:JOINT and setpoint:JOINT or effort:JOINT"


class Reading(NamedTuple):
    """Meaning of the columns of log files; recordings say it themselves."""

    hold: bool = False
    """True if commands hold from row to row, False to interpolate between rows."""
    topic: str = "/joint_states"
    """Topic of the measurements in a ROS bag."""
    command_topic: str | None = None
    """Topic of the commands in a ROS bag; None: the measured efforts are used."""
    columns: tuple[str, ...] = ()
    """Columns of a CSV file or bag under other names or in other units, as "QUANTITY: PATTERN
    UNIT". In the pattern {joint} stands for the joint's name, and "-" before it turns the sign; the
    unit is one of :data:`UNITS` or a factor, and can be left out. "QUANTITY:JOINT: COLUMN UNIT" is
    for one joint.
    """


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
        try:
            rollout = read_recording(path)
        except RecordingError as bad:
            raise RecordingError(f"{bad}; {A_LOG}, or a recording of a Runner") from bad
        return logs_of_rollout(robot, rollout, kind, source=str(path))
    if path.exists() and (suffix in BAGS or path.is_dir()):
        return _read_bag(robot, path, kind, reading)
    file_path("log", path, (".csv", ".txt", *HDF5, *BAGS))
    columns, numbers = read_csv(path, (*LOG_QUANTITIES, "time"))
    sources = _sources(robot, str(path), columns, reading.columns)
    columns = {name: scale * columns[column] for name, (column, scale) in sources.items()}
    log = _build(robot, str(path), columns, kind, reading)
    return checked(robot, replace(log, lines=np.array(numbers)))


def _sources(
    robot: Robot,
    source: str,
    columns: Collection[str],
    patterns: Iterable[str],
) -> dict[str, tuple[str, float]]:
    """Return the column of a file and its unit for each name of a log: those that ``patterns``
    name, and the others as they are.
    """
    matched = dict[str, tuple[str, float]]()
    times = [f"time: time_{unit} {unit}" for unit in ("ms", "us", "ns")]
    for text in [*[text for text in times if text.split()[1] in columns], *patterns]:
        name, _, right = text.partition(": ")
        pattern, *units = right.split() or [""]
        try:
            scale = UNITS.get(units[0]) or float(units[0]) if units else 1.0
        except ValueError:
            remedy = f"use one of {', '.join(UNITS)}, or a factor"
            raise error(f"columns {text!r}", "has an unknown unit", remedy, units[0]) from None
        if pattern.startswith("-"):
            scale = -scale
        present = dict[str, tuple[str, float]]()
        for joint in robot.joint_names if "{joint}" in pattern else [""]:
            column = pattern.removeprefix("-").replace("{joint}", joint)
            if column in columns:
                present[f"{name}:{joint}" if joint else name] = column, scale
        if not present:
            problem = f"has no column of the pattern {text!r}"
            raise error(source, problem, f"its columns are {', '.join(columns)}")
        matched |= present
    used = {column for column, _ in matched.values()}
    return {column: (column, 1.0) for column in columns if column not in used} | matched


def _proposed(robot: Robot, columns: Iterable[str]) -> str:
    """Return the patterns that the names of columns suggest, as a remedy; "" for none."""
    patterns = dict[str, None]()
    for column in columns:
        joints = [joint for joint in robot.joint_names if joint in column]
        # The name of one joint may be part of another's.
        pattern = column.replace(max(joints, key=len), "{joint}") if joints else column
        words = pattern.replace("{joint}", " ").lower()
        unit = next((unit for unit in UNITS if re.search(rf"(?i)[_. \[]{unit}\b", column)), "")
        if not joints and re.search(r"time|stamp", words):
            patterns[f"time: {column} {unit}".strip()] = None
        for quantity, meaning in MEANINGS.items():
            if joints and re.search(meaning, words.replace("_", " ")):
                patterns[f"{quantity}: {pattern} {unit}".strip()] = None
                break
    return " ".join(f'"{pattern}"' for pattern in patterns)


def _build(
    robot: Robot,
    source: str,
    columns: dict[str, Float64],
    kind: CommandKind | None,
    reading: Reading,
    commands: dict[str, Float64] | None = None,
) -> Log:
    """Return the log that the columns of a file hold; ``commands`` are columns with their own
    times.
    """
    commands = commands or columns
    by = columns_by_joint(robot, source, columns | commands, LOG_QUANTITIES)
    if by["feedforward"]:
        remedy = "log the complete efforts, without the columns of the feedforward"
        raise error(source, "has a feedforward, which a fit does not simulate", remedy)
    # Measured efforts stand for commands that were not logged.
    measured = not by["effort"]
    by["effort"] = by["effort"] or by["measured_effort"]
    kind = kind or ("effort" if by["effort"] else "setpoint")
    logged = by["qpos"] | by[kind]
    joints = [
        joint
        for joint in np.flatnonzero(robot.independent).tolist()
        if robot.joint_names[joint] in logged
    ]
    names = [robot.joint_names[joint] for joint in joints]
    needed = {"time": columns.get("time")}
    for quantity in ("qpos", kind):
        for name in names or ["JOINT"]:
            needed[f"{quantity}:{name}"] = by[quantity].get(name)
    for column, values in needed.items():
        if values is None:
            remedy = f"{A_LOG}; a joint without both rests"
            proposed = _proposed(robot, columns)
            if proposed and not names:
                remedy = f"name its columns (--columns {proposed})"
            raise error(f"{source}: column {column}", "is missing", remedy)
    qpos, command = (
        np.stack([by[quantity][name] for name in names], axis=1) for quantity in ("qpos", kind)
    )
    return Log(
        source,
        tuple(joints),
        kind,
        columns["time"],
        qpos,
        commands["time"],
        command,
        held=reading.hold,
        measured=measured and kind == "effort",
    )


def _read_bag(
    robot: Robot,
    path: Path,
    kind: CommandKind | None,
    reading: Reading,
) -> list[Log]:
    """Return the logs of a bag.

    Messages are merged by the names of joints: each joint has the samples of all messages that name
    it. Rows are at the stamps of the joint with most positions, in seconds since the first one;
    commands act from their own stamps on.
    """
    samples = _samples(path, reading)
    stamps = dict[str, Float64]()
    values = dict[str, Float64]()
    # Other devices publish joints of their own.
    others = set[str]()
    for name, (column, scale) in _sources(robot, str(path), samples, reading.columns).items():
        joint = name.partition(":")[2]
        if joint in robot.joint_names:
            stamps[name], values[name] = samples[column] * [[1.0], [scale]]
        else:
            others.add(joint)
    quantities = ("setpoint:", "effort:") if reading.command_topic else ("measured_effort:",)
    moved = [column for column in stamps if column.startswith("qpos:")]
    driven = [column for column in stamps if column.startswith(quantities)]
    for topic, columns in ((reading.topic, moved), (reading.command_topic, driven)):
        if topic and not columns:
            problem = f"has no values of the robot's joints in the topic {topic!r}"
            remedy = f"its topics of {JOINT_STATE}: {', '.join(_topics(path)) or 'none'}; other"
            remedy += f" joints: {', '.join(sorted(others)) or 'none'}"
            raise error(str(path), problem, remedy)
    used = {column: stamps[column] for column in moved + driven}
    first = max(times[0] for times in used.values())
    last = min(times[-1] for times in used.values())
    if first >= last:
        remedy = "record all topics at the same time"
        raise error(str(path), f"has no time in which {', '.join(used)} all have values", remedy)
    remarks = []
    if others:
        remarks.append(f"{', '.join(sorted(others))}: no joint of the robot, left out")
    times = max((stamps[column] for column in moved), key=len)
    outside = first - times[0], times[-1] - last
    if max(outside) > GAP:
        words = f"first {max(outside[0], 0):.3f} s and last {max(outside[1], 0):.3f} s"
        remarks.append(f"{words} without values of all columns: left out")
    times = times[(times >= first) & (times <= last)]
    cuts = list[float]()
    for (begin, end), columns in sorted(_silences(used, first, last).items()):
        words = f"is silent from {begin - first:.3f} to {end - first:.3f} s"
        remarks.append(f"{', '.join(columns)} {words}: the log is divided there")
        times = times[(times <= begin) | (times >= end)]
        cuts.append(end)
    positions = {"time": times - first}
    for column in moved:
        positions[column] = np.interp(times, stamps[column], values[column])
    sent = np.unique(np.concatenate([[first, last], *(stamps[column] for column in driven)]))
    sent = sent[(sent >= first) & (sent <= last)]
    commands = {"time": sent - first}
    for column in driven:
        if reading.hold:
            place = np.searchsorted(stamps[column], sent, "right") - 1
            commands[column] = values[column][place]
        else:
            commands[column] = np.interp(sent, stamps[column], values[column])
    log = _build(
        robot,
        str(path),
        positions,
        kind,
        reading,
        commands,
    )
    for remark in remarks:
        log = log.with_remark(remark)
    return checked(robot, log, np.searchsorted(times, cuts).tolist())


def _silences(
    used: dict[str, Float64], first: float, last: float
) -> dict[tuple[float, float], list[str]]:
    """Return the columns by begin and end of their silences between two stamps."""
    silences = defaultdict[tuple[float, float], list[str]](list)
    for column, stamps in used.items():
        steps = np.diff(stamps)
        longest = max(SILENT_PERIODS * float(np.median(steps)), LEAST_SILENCE)
        for row in np.flatnonzero(steps > longest):
            begin, end = stamps[row : row + 2].tolist()
            if begin < last and end > first:
                silences[begin, end].append(column)
    return silences


def _samples(path: Path, reading: Reading) -> dict[str, Float64]:
    """Return the columns of a bag, each (2, samples): stamps [s] since the first one, and values."""
    topics = {reading.topic: ("qpos:", "measured_effort:")}
    if reading.command_topic:
        topics[reading.command_topic] = ("setpoint:", "effort:")
    samples = defaultdict[str, dict[int, float]](dict)
    delays = defaultdict[tuple[str, bool], list[int]](list)
    try:
        with _reader(path) as reader:
            states = [line for line in reader.connections if line.topic in topics]
            states = [line for line in states if line.msgtype == JOINT_STATE]
            # Without a connection the reader would return all messages.
            for line, received, raw in reader.messages(connections=states) if states else ():
                message: Any = reader.deserialize(raw, line.msgtype)
                header = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                stamp = header or received
                delays[line.topic, header > 0].append(received - stamp)
                lists = message.position, message.effort
                # A driver without such a value leaves the list empty.
                for quantity, values in zip(topics[line.topic], lists, strict=False):
                    for name, value in zip(message.name, values, strict=False):
                        samples[f"{quantity}{name}"][stamp] = float(value)
    except BatchPIDError:
        raise
    except Exception as bad:  # a damaged file can make the library raise anything
        raise error(str(path), f"cannot be read: {bad}", "correct or record it again") from None
    _check_clocks(path, {key: float(np.median(times)) / 1e9 for key, times in delays.items()})
    # Nanoseconds since 1970 have more digits than a float.
    origin = min(map(min, samples.values()), default=0)
    tables = dict[str, Float64]()
    for column, rows in samples.items():
        tables[column] = np.array([(1e-9 * (at - origin), rows[at]) for at in sorted(rows)]).T
    return tables


def _check_clocks(path: Path, delays: dict[tuple[str, bool], float]) -> None:
    """Raise InvalidArgumentError if topics have stamps of different clocks.

    ``delays`` are the times from stamp to receipt [s], by topic and whether it has stamps.
    """
    kinds = {is_stamped for _, is_stamped in delays}
    times = delays.values()
    if len(kinds) > 1 or (delays and max(times) - min(times) > CLOCK_OFFSET):
        words = []
        for (topic, is_stamped), delay in delays.items():
            when = f"{delay:.3f} s before receipt" if is_stamped else "without stamps"
            words.append(f"{topic!r} {when}")
        remedy = "stamp the messages of both topics by one clock, when they are measured or sent"
        raise error(str(path), f"has stamps of two clocks: {', '.join(words)}", remedy)


def _topics(path: Path) -> list[str]:
    """Return the topics of joint states in a bag."""
    with _reader(path) as reader:
        return sorted(line.topic for line in reader.connections if line.msgtype == JOINT_STATE)


def _reader(path: Path) -> Any:
    """Return the reader of a bag."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingDependencyError("rosbags", "a log in a ROS bag", "tune") from None
    if path.is_dir() and not (path / "metadata.yaml").exists():
        names = ", ".join(sorted(file.name for file in path.iterdir())[:5]) or "nothing"
        remedy = f"`ros2 bag reindex` writes it for a bag; {A_LOG}"
        raise error(str(path), f"is a folder without metadata.yaml, with {names}", remedy)
    return AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
