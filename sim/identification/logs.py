"""Logs of a robot in motion: commands and measured positions over time, from CSV, HDF5, ROS bags or recordings.

A CSV file has a header and one row per sample, in SI units::

    time, qpos:JOINT ..., setpoint:JOINT or effort:JOINT ..., and where there are any qvel:JOINT, measured_effort:JOINT,
    feedforward:JOINT

An HDF5 file has one dataset per column, of the same names. A row holds the position measured at ``time`` and the
command computed from it, which acts from then on. A feedforward is an effort that is added to the law's. Columns may
have any order, joints may be missing, and times need not be equidistant. Columns of other quantities are ignored, such
as the rates of setpoints that ``batchpid excite`` writes. :class:`batchpid.sim.identification.columns.Reading` has
other units and names, and the topics of ROS bags; :mod:`batchpid.sim.identification.log_lists` reads lists of logs
(.yaml), each with its settings.

Where the times have a gap, such as between two recordings, each stretch without gap is a log. Positions and setpoints
that wrap at +-pi or at 0 and 2 pi are unwrapped (:mod:`batchpid.sim.identification.log_checks`).

In a recording (:func:`batchpid.sim.write_recording`) the command of a row acted in the tick that ends at its time, and
each env is a log.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import file_path
from batchpid.checks.warn import warn
from batchpid.errors import InvalidArgumentError
from batchpid.sim.identification import log_lists
from batchpid.sim.identification.columns import (
    BAGS,
    QUANTITIES,
    Reading,
    columns_by_joint,
    error,
    is_bag,
    read_bag,
    read_csv,
    read_hdf5_columns,
    time_column,
)
from batchpid.sim.identification.log import CommandKind, Log, LogWarning, Sensor
from batchpid.sim.identification.log_checks import SPEEDING, checked, commands_of, too_fast
from batchpid.sim.observation import Rollout
from batchpid.sim.recording.recording_files import HDF5, read_recording
from batchpid.sim.robot.robot import Robot

SUFFIXES = (".csv", ".txt", *HDF5, *BAGS)


def read_logs(
    robot: Robot,
    paths: Iterable[str | os.PathLike[str]],
    kind: CommandKind | None = None,
    *,
    hold: bool = False,
    reading: Reading | None = None,
) -> list[Log]:
    """Return the logs in files, one for each stretch without gaps in time.

    Parameters
    ----------
    kind
        Command to read where a file has both: "setpoint" or "effort"; default the one that it has, else "effort".
    hold
        True if the commands of CSV and HDF5 files hold from row to row, False to interpolate between rows, as for
        commands that changed between rows as well. Recordings are always held.
    reading
        Units and names in the files; default SI units and the robot's names. Recordings have no use for it.

    Raises
    ------
    InvalidArgumentError
        A file holds no log of this robot; the message names the file, line and column.
    RecordingError
        A recording cannot be read.
    MissingDependencyError
        h5py or rosbags is not installed, which .h5 files and ROS bags need.
    FileNotFoundError
        There is no such file.
    """
    reading = reading or Reading()
    logs = [log for path in paths for log in _read(robot, Path(path), kind, hold, reading)]
    if not logs:
        raise InvalidArgumentError("logs", "are missing", remedy="name one file or more")
    kinds = {log.kind for log in logs}
    if len(kinds) > 1:
        remedy = "use logs of one kind"
        raise InvalidArgumentError("logs", "hold setpoints in some files and efforts in others", remedy=remedy)
    return logs


def _read(robot: Robot, path: Path, kind: CommandKind | None, hold: bool, reading: Reading) -> list[Log]:
    if not is_bag(path):
        file_path("log", path, (*SUFFIXES, *log_lists.SUFFIXES))
    if not path.exists():
        raise FileNotFoundError(2, "there is no such file", str(path))
    if path.suffix.lower() in log_lists.SUFFIXES:
        return log_lists.read_log_list(path, robot, read_logs, kind, hold, reading)
    if is_bag(path):
        states, *commands = [_named(robot, str(path), each, reading) for each in read_bag(path, reading)]
        return _build(robot, str(path), states, None, kind, hold, reading, *commands)
    columns, lines = None, None
    if path.suffix.lower() in (".csv", ".txt"):
        columns, lines = read_csv(path)
    elif path.suffix.lower() in HDF5:
        columns = read_hdf5_columns(path)
    if columns is not None:
        _refuse(reading, ("topic", "command_topic"), f"{path}, which is no ROS bag")
        return _build(robot, str(path), columns, lines, kind, hold, reading)
    _refuse(reading, Reading._fields, f"{path}, a recording, which has SI units")
    return logs_of_rollout(robot, read_recording(path), kind, source=str(path))


def _refuse(reading: Reading, names: Sequence[str], file: str) -> None:
    """Refuse the options ``names`` of ``reading``, for which a file has no use."""
    given = [name for name in names if getattr(reading, name) != getattr(Reading(), name)]
    if given:
        raise InvalidArgumentError(", ".join(given), f"is not for {file}", remedy="leave it out")


def _named(robot: Robot, source: str, columns: dict[str, Float64], reading: Reading) -> dict[str, Float64]:
    """Return the columns of a bag without those of other joints, which are named in a warning."""
    ours = {f"{reading.prefix}{name}" for name in robot.joint_names}
    theirs = dict.fromkeys(name.partition(":")[2] for name in columns if name != "time")
    others = [name for name in theirs if name not in ours]
    if len(others) == len(theirs):
        remedy = f"the robot has {', '.join(robot.joint_names)}: give the prefix of the names, or another topic"
        raise error(source, f"has none of the robot's joints, but {', '.join(others)}", remedy)
    if others:
        message = f"{source}: {', '.join(others)}: no joint of the robot, left out"
        warn(message, LogWarning)
    return {name: values for name, values in columns.items() if name.partition(":")[2] not in others}


def logs_of_rollout(
    robot: Robot, rollout: Rollout, kind: CommandKind | None = None, source: str = "rollout"
) -> list[Log]:
    """Return one log for each env of ``rollout``, whose setpoints are efforts under control "effort".

    Raises InvalidArgumentError if it is of other joints, or an env has failed.
    """
    info = rollout.info
    if info.joint_names != robot.joint_names:
        problem = f"is of the joints {', '.join(info.joint_names)}"
        raise InvalidArgumentError(source, problem, remedy=f"{robot.name!r} has {', '.join(robot.joint_names)}")
    if info.own_command is not None:
        problem = f"was made with setpoints of {', '.join(info.own_command.names)}, not of joints"
        raise InvalidArgumentError(source, problem, remedy="record a run under control 'pid' or 'effort'")
    if info.control not in (None, "pid", "effort"):
        problem = f"was made under control {info.control!r}, which the model does not have"
        raise InvalidArgumentError(source, problem, remedy="record a run under control 'pid' or 'effort'")
    found: CommandKind = "effort" if info.control == "effort" else "setpoint"
    if kind is not None and kind != found:
        problem = f"was made under control {info.control!r} and holds {found}s"
        raise InvalidArgumentError(source, problem, remedy=f"fit its {found}s")
    if info.rates and found == "setpoint":
        problem, remedy = "was made with setpoint rates, which the model of the law does not have", "record one without"
        raise InvalidArgumentError(source, problem, remedy=remedy)
    if info.rates is None and not info.complete and found == "setpoint":
        problem = f"{source}: was cut short, before it said whether setpoints had rates"
        warn(f"{problem}; it is fitted as a run without: if it had them, record another", LogWarning)
    if not rollout.ok.all():
        env = int(np.argmin(rollout.ok.all(0)))
        raise InvalidArgumentError(source, "has failed", env=env, remedy="record a run without faults")
    joints = tuple(np.flatnonzero(robot.independent).tolist())
    begin = rollout.time - rollout.tick
    logs = []
    for env in range(rollout.num_envs):
        tables = {
            name: np.asarray(getattr(rollout, name), float)[:, env, joints] for name in ("setpoint", "qpos", "qvel")
        }
        name = source if rollout.num_envs == 1 else f"{source}, env {env}"
        log = Log(name, joints, found, rollout.time, tables["qpos"], begin, tables["setpoint"], True, tables["qvel"])
        log = replace(log, timestep=info.timestep, compensate=info.compensate)
        logs += checked(robot, log)
    return logs


def _build(
    robot: Robot,
    source: str,
    columns: dict[str, Float64],
    lines: list[int] | None,
    kind: CommandKind | None,
    hold: bool,
    reading: Reading,
    commands: dict[str, Float64] | None = None,
) -> list[Log]:
    """Return the logs that the columns of a file hold; ``commands`` are those that have times of their own."""
    time = time_column(source, columns, reading.time_unit)
    command_time = time if commands is None else commands["time"]
    everything = columns if commands is None else columns | commands
    by = columns_by_joint(robot, source, everything, QUANTITIES, reading.prefix)
    _in_si_units(robot, by, reading)
    if not by["qpos"]:
        raise error(
            source, "has no column qpos:JOINT", "measured positions are needed, e.g. qpos:" + robot.joint_names[0]
        )
    found, sensor = _choose(robot, source, by, kind, reading)
    needed = [found, *(q for q in ("feedforward", "measured_effort") if by[q])]
    for joint in {name for q in needed for name in by[q].keys() ^ by["qpos"].keys()}:
        lacking = next(q for q in ("qpos", *needed) if joint not in by[q])
        remedy = "give both of a joint or neither; a joint that is left out rests at the robot's start pose"
        raise InvalidArgumentError(f"{source}: column {lacking}:{joint}", "is missing", remedy=remedy)
    names = [name for name, free in zip(robot.joint_names, robot.independent, strict=True) if free]
    names = [name for name in names if name in by["qpos"]]
    if not names:
        raise error(source, "holds followers alone, which their leaders move", "give the columns of the leaders")
    if not by["qvel"].keys() >= {*names}:
        by["qvel"] = {}
    used = {quantity: [by[quantity][name] for name in names] for quantity in ("qpos", "qvel", *needed) if by[quantity]}
    for quantity, own in used.items():
        wanted_length = len(time if quantity in ("qpos", "qvel", "measured_effort") else command_time)
        if {*map(len, own)} != {wanted_length}:
            raise error(source, "has columns of different lengths", "give one value per row in each")
    tables = {quantity: np.stack(own, axis=1) for quantity, own in used.items()}
    joints = tuple(robot.joint_names.index(name) for name in names)
    log = Log(source, joints, found, time, tables["qpos"], command_time, tables[found], hold, tables.get("qvel"))
    log = replace(log, feedforward=tables.get("feedforward"), measured=tables.get("measured_effort"), sensor=sensor)
    rows = np.flatnonzero((time >= reading.start) & (time <= reading.end) | np.isnan(time))
    if not len(rows):
        span = f"its times are {time[0]:g} to {time[-1]:g} s"
        raise error(source, f"has no rows from {reading.start:g} to {reading.end:g} s", span)
    if len(rows) < len(time):
        lines = None if lines is None else [lines[row] for row in rows]
        log = log.part(rows, commands_of(time[rows], command_time))
    parts = checked(robot, log, lines)
    if fast := too_fast(robot, parts):
        message = f"{source}: {fast} moves {SPEEDING:g} times as fast as its limit of velocity or more"
        warn(f"{message}: positions look like degrees (option degrees)", LogWarning)
    return parts


def _choose(
    robot: Robot, source: str, by: dict[str, dict[str, Float64]], kind: CommandKind | None, reading: Reading
) -> tuple[CommandKind, Sensor | None]:
    """Return the kind of command, and where efforts were measured; leave in ``by`` the columns that are used.

    Measured efforts take the place of commanded ones where a file has no commands.
    """
    sensor = reading.measured if by["effort"] else None
    if by["measured_effort"]:
        sensor = reading.measured or "motor"
    elif sensor is not None:
        by["measured_effort"], by["effort"] = by["effort"], {}
    if kind != "setpoint" and not by["effort"] and (kind == "effort" or not by["setpoint"]):
        by["effort"], by["measured_effort"] = by["measured_effort"], {}
    kinds: list[CommandKind] = [each for each in ("effort", "setpoint") if by[each]]
    if not kinds or (kind is not None and kind not in kinds):
        wanted = kind or "setpoint"
        raise error(
            source, f"has no column {wanted}:JOINT", f"commands are needed, e.g. {wanted}:{robot.joint_names[0]}"
        )
    found = kind or kinds[0]
    if found == "setpoint" and by["measured_effort"]:
        message = f"{source}: measured efforts are not used with setpoints; without gains they are"
        warn(message, LogWarning)
        by["measured_effort"], sensor = {}, None
    if found == "effort" and by["feedforward"]:
        remedy = "give the gains of the law that it was added to, or leave the column out"
        raise error(source, "has a feedforward, which efforts include", remedy)
    return found, sensor if found == "effort" else None


def _in_si_units(robot: Robot, by: dict[str, dict[str, Float64]], reading: Reading) -> None:
    """Change the columns by quantity and joint to SI units, and to the robot's signs."""
    for quantity, columns in by.items():
        for joint, values in columns.items():
            angle = robot.units[robot.joint_names.index(joint)] == "rad" and quantity in ("qpos", "qvel", "setpoint")
            factor = (reading.sign or {}).get(joint, 1.0)
            if quantity in ("effort", "measured_effort", "feedforward"):
                factor *= (reading.scale or {}).get(joint, 1.0)
            columns[joint] = factor * (np.radians(values) if reading.degrees and angle else values)
