"""Columns of a log by name, from CSV and HDF5 files and ROS bags.

A bag is a bag of ROS 1 or ROS 2 or an MCAP file, with messages ``sensor_msgs/JointState``. These hold positions,
velocities and efforts of joints by name, in any order. In the topic of measurements, efforts are measured efforts.
Positions in the topic of commands are setpoints, and its efforts are commanded efforts.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import choice
from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.sim.identification.log import Sensor
from batchpid.sim.recording.recording_files import RecordingError
from batchpid.sim.robot.robot import Robot

QUANTITIES = ("setpoint", "effort", "feedforward", "measured_effort", "qpos", "qvel")
"""Quantities of the columns of a log, QUANTITY:JOINT."""
TIMES = ("time", "time_s", "time_ms", "time_us", "time_ns")
"""Names of the column of the times."""
TimeUnit = Literal["s", "ms", "us", "ns"]
SECONDS: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
JOINT_STATE = "sensor_msgs/msg/JointState"
BAGS = (".bag", ".mcap", ".db3")
_MEASURED = {"position": "qpos", "velocity": "qvel", "effort": "measured_effort"}
_COMMANDED = {"position": "setpoint", "effort": "effort"}
_TIME = re.compile(r"time[\s_]*[\[(]?(s|ms|us|ns)?[\])]?")
_QUOTED = re.compile(r'"[^"]*"')
_NUMBER = r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"
_DECIMAL_COMMA = re.compile(r"[+-]?[\d.]*,\d+([eE][+-]?\d+)?")
_WITH_UNIT = re.compile(rf"{_NUMBER}\s*[^\W\d].*")


class Reading(NamedTuple):
    """Meaning of the columns of log files; recordings say it themselves."""

    time_unit: TimeUnit | None = None
    """Unit of the times; None: as the column's name says, such as ``time_ms``, else seconds."""
    degrees: bool = False
    """True if positions and velocities of revolute joints, setpoints included, are in degrees."""
    measured: Sensor | None = None
    """Place at which the column ``effort`` was measured; None: it was commanded. Columns ``measured_effort`` are taken
    as measured at the motor unless this says "link"."""
    topic: str = "/joint_states"
    """Topic of the measurements in a ROS bag."""
    command_topic: str | None = None
    """Topic of the commands in a ROS bag; None: the measured efforts are used."""
    prefix: str = ""
    """Prefix of the joints' names in a file, which the robot's do not have."""
    sign: Mapping[str, float] | None = None
    """Factors, 1 or -1, of all columns of some joints."""
    scale: Mapping[str, float] | None = None
    """Factors of the efforts of some joints, such as N m per A."""
    start: float = -math.inf
    """Time [s] of the first row to read."""
    end: float = math.inf
    """Time [s] of the last row to read."""


def error(source: str, problem: str, remedy: str, value: Any = None) -> InvalidArgumentError:
    """Return the error of a file."""
    return InvalidArgumentError(source, problem, remedy=remedy, value=value)


def read_csv(path: Path, quantities: Sequence[str] = QUANTITIES) -> tuple[dict[str, Float64], list[int]]:
    """Return the columns of a CSV file by name, and the line of each row.

    Empty cells are NaN, and so is text in columns of other quantities than ``quantities`` and the time.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as bad:
        raise error(str(path), f"is not a text: {bad.reason} at byte {bad.start}", "save it as UTF-8") from None
    rows: list[list[float]] = []
    lines: list[int] = []
    header: list[str] | None = None
    delimiter = ","
    for number, line in enumerate(io.StringIO(text, newline=None), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if header is None:
            delimiter = max(",;\t", key=_QUOTED.sub("", line).count)
        cells = line.rstrip("\n").split(delimiter)
        if '"' in line or "'" in line:
            cells = _unquoted(path, number, line, delimiter)
        if header is None:
            header = [name.strip() for name in cells]
            continue
        if len(cells) != len(header):
            problem = f"line {number} has {len(cells)} cells, the header {len(header)}"
            raise error(str(path), problem, "complete or remove the line")
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:  # a cell is empty, or text
            rows.append(_read_row(path, number, header, cells, quantities))
        lines.append(number)
    if header is None or not rows:
        raise error(str(path), "has no rows", "give a header and one row per sample")
    if len(set(header)) != len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise error(str(path), f"has the column {twice!r} twice", "keep one of them")
    table = np.array(rows)
    return {name: table[:, index] for index, name in enumerate(header)}, lines


def time_column(source: str, columns: dict[str, Float64], unit: TimeUnit | None) -> Float64:
    """Return the times [s] of the column ``time``, whose name may end in its unit, such as ``time_ms``.

    Raises InvalidArgumentError if there is none, or if the name contradicts ``unit``.
    """
    found = {name: match[1] for name in columns if (match := _TIME.fullmatch(name))}
    name = "time" if "time" in found else next(iter(found), None)
    if name is None:
        problem = f"has no column 'time', but {', '.join(list(columns)[:6])}"
        raise error(source, problem, "begin the header with time, in seconds, or time_ms, time_us, time_ns")
    if unit is not None and found[name] not in (None, unit):
        raise error(source, f"has the column {name!r}, not in {unit}", "leave out the unit of the times", unit)
    return SECONDS[unit or found[name] or "s"] * columns[name]


def columns_by_joint(
    robot: Robot, source: str, columns: dict[str, Float64], quantities: Sequence[str], prefix: str = ""
) -> dict[str, dict[str, Float64]]:
    """Return the columns of ``quantities`` by quantity and by the robot's name of their joint; others are left out.

    Raises InvalidArgumentError for an unknown joint, or for two columns that differ in blanks alone.
    """
    by: dict[str, dict[str, Float64]] = {quantity: {} for quantity in quantities}
    for name, values in columns.items():
        quantity, colon, joint = name.partition(":")
        quantity, joint = quantity.strip(), joint.strip().removeprefix(prefix)
        if not colon or quantity not in by:
            continue
        choice(f"{source}: column {name!r}: joint", joint, robot.joint_names)
        if joint in by[quantity]:
            raise error(source, f"has the column '{quantity}:{joint}' twice, apart from blanks", "keep one of them")
        by[quantity][joint] = values
    return by


def _unquoted(path: Path, number: int, line: str, delimiter: str) -> list[str]:
    """Return the cells of line ``number``, without the quotes around them, double or single."""
    quote = '"' if '"' in line else "'"
    try:
        (cells,) = csv.reader(
            [line.rstrip("\n")], delimiter=delimiter, quotechar=quote, skipinitialspace=True, strict=True
        )
    except csv.Error:
        problem = f"line {number} has a quote that does not enclose a whole cell"
        raise error(str(path), problem, f"put {quote} at both ends of a cell, or at none") from None
    return cells


def _read_row(path: Path, number: int, header: list[str], cells: list[str], quantities: Sequence[str]) -> list[float]:
    """Return the numbers of line ``number``; NaN for empty cells, and for text in columns of other quantities."""
    row = []
    for column, cell in zip(header, cells, strict=True):
        text = cell.strip()
        try:
            row.append(float(text) if text else math.nan)
        except ValueError:
            if column.partition(":")[0].strip() in (*quantities, "time"):
                problem = f"line {number}, column {column!r} is not a number"
                raise error(str(path), problem, _remedy(text), text) from None
            row.append(math.nan)
    return row


def _remedy(text: str) -> str:
    """Return the remedy for a cell whose ``text`` is not a number."""
    if _DECIMAL_COMMA.fullmatch(text):
        return "write numbers with a decimal point"
    if _WITH_UNIT.fullmatch(text):
        return "write the number alone, without its unit: rad, m, N m, N and seconds are meant"
    return "remove the row, or give the number"


def read_hdf5_columns(path: Path) -> dict[str, Float64] | None:
    """Return the datasets of an HDF5 file by name, None if none is named as a column of a log."""
    import h5py

    try:
        with h5py.File(path, "r", locking=False) as file:
            quantities = {name: name.partition(":")[0].strip() for name in file if ":" in name}
            names = [name for name in file if quantities.get(name) in QUANTITIES or name.strip() in TIMES]
            arrays = {name: np.asarray(file[name]) for name in names}
    except (OSError, ValueError, KeyError, RuntimeError) as bad:
        raise RecordingError(f"{path}: cannot be read as a log: {bad}") from bad
    if not any(name.partition(":")[0].strip() == "qpos" for name in arrays):
        return None
    columns = {}
    for name, array in arrays.items():
        if name.strip() in columns:
            raise error(str(path), f"has the column {name.strip()!r} twice, apart from blanks", "keep one of them")
        if array.ndim != 1 or not len(array) or array.dtype.kind not in "biuf":
            problem = f"has {name!r} of shape {array.shape} and {array.dtype}, which is not a column of numbers"
            raise error(str(path), problem, "give each dataset one number per row")
        columns[name.strip()] = array.astype(np.float64)
    return columns


def is_bag(path: Path) -> bool:
    """Return whether ``path`` is a bag: a file of ROS 1, a file of MCAP or SQLite, or the folder of a ROS 2 bag."""
    return path.suffix.lower() in BAGS or (path / "metadata.yaml").exists()


def read_bag(path: Path, reading: Reading) -> list[dict[str, Float64]]:
    """Return the columns of a bag by name: of its measurements, and of its commands if ``reading`` names their topic.

    Times are in seconds since the first measurement. They come from the stamps of the headers, or from the bag if a
    stamp is 0. If messages have different joints, the most frequent set of joints is used.

    Raises
    ------
    InvalidArgumentError
        The bag cannot be read, or lacks a topic.
    MissingDependencyError
        rosbags is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingDependencyError("rosbags", "a log in a ROS bag", "tune") from None
    topics = {reading.topic: _MEASURED} | ({reading.command_topic: _COMMANDED} if reading.command_topic else {})
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            known = sorted(each.topic for each in reader.connections if each.msgtype == JOINT_STATE)
            for topic in topics:
                if topic not in known:
                    remedy = f"use one of its topics of {JOINT_STATE}: {', '.join(known) or 'there are none'}"
                    raise error(str(path), f"has no topic {topic!r} of {JOINT_STATE}", remedy)
            messages: dict[str, list[Any]] = {topic: [] for topic in topics}
            chosen = [each for each in reader.connections if each.topic in topics]
            for connection, received, raw in reader.messages(connections=chosen):
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp
                messages[connection.topic].append((stamp.sec * 10**9 + stamp.nanosec or received, message))
    except BatchPIDError:
        raise
    except Exception as bad:  # a damaged file can make the library raise anything
        raise error(str(path), f"cannot be read: {bad}", "correct or record it again") from None
    begin = min((stamp for stamp, _ in messages[reading.topic]), default=0)
    return [_columns_of(f"{path}: {topic}", messages[topic], names, begin) for topic, names in topics.items()]


def _columns_of(source: str, messages: list[Any], names: dict[str, str], begin: int) -> dict[str, Float64]:
    """Return the columns of messages with their stamps [ns]; ``names`` are the quantities by the messages' fields."""
    groups = defaultdict[tuple[str, ...], list[Any]](list)
    for stamp, message in messages:
        groups[tuple(message.name)].append((stamp, message))
    if not groups:
        raise error(source, "has no messages", "choose another topic")
    joints, rows = max(groups.items(), key=lambda group: len(group[1]))
    rows.sort(key=itemgetter(0))  # a bag has them in the order of arrival
    columns = {"time": np.array([stamp - begin for stamp, _ in rows]) / 1e9}
    for field, quantity in names.items():
        values = [getattr(message, field) for _, message in rows]
        if all(len(value) == len(joints) for value in values):  # a driver without such a value leaves the list empty
            columns |= {f"{quantity}:{joint}": column for joint, column in zip(joints, np.array(values).T, strict=True)}
    return columns
