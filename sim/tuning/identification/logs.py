"""Logs of a robot in motion: commands and measured positions over time, from CSV, HDF5 or recordings.

A CSV file has a header and one row per sample, in SI units::

    time, setpoint:JOINT or effort:JOINT ..., qpos:JOINT ..., optionally qvel:JOINT ...

An HDF5 file has one dataset per column, of the same names. In a row stand the position measured at ``time`` and the
command computed from it, which acts from then on. Columns may have any order, joints may be missing, and times need not
be equidistant. Columns of other quantities are ignored.

In a recording (:func:`sim.write_recording`) the command of a row acted in the tick that ends at its time, and each env
is a log.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import InvalidArgumentError
from batchpid.trajectories import Trajectory
from batchpid.validate import choice, file_path
from sim.observation import Rollout
from sim.recording.files import HDF5, read_recording
from sim.robot.robot import Robot
from sim.tuning.identification.columns import QUANTITIES, error, read_csv, read_hdf5_columns

Float64 = NDArray[np.float64]
CommandKind = Literal["setpoint", "effort"]
SUFFIXES = (".csv", ".txt", ".npz", *HDF5)
MIN_ROWS, MIN_SECONDS = 50, 0.2
"""Least number of rows and length [s] of a log."""
AT_LIMIT = 1e-3
"""Distance to a joint limit at which a joint counts as stopped by it, over its range."""
BEYOND = {"rad": 0.3, "m": 0.05}
"""Distance beyond a joint limit at which a position counts as given in another unit."""


class LogWarning(UserWarning):
    """A log holds what the model of the robot does not."""


@dataclass(frozen=True, eq=False)
class Log:
    """Commands and measured positions of some joints of one robot."""

    source: str
    """File that it is from, and the env of a recording."""
    joints: tuple[int, ...]
    """Numbers of the joints that it holds, in the robot's order; followers are left out."""
    kind: CommandKind
    time: Float64
    """Times of the measurements (rows,) [s], increasing."""
    qpos: Float64
    """Measured positions (rows, joints) [rad or m]."""
    command_time: Float64
    """Times from which the commands act (commands,) [s]."""
    command: Float64
    """Setpoints [rad or m] or efforts [N m or N] (commands, joints)."""
    held: bool
    """True if a command holds until the next one; False to interpolate between them."""
    qvel: Float64 | None = None
    """Measured velocities (rows, joints), if there are any."""

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return float(self.time[-1] - self.time[0])

    def commands_at(self, time: Float64) -> Float64:
        """Return the commands that act at ``time`` (n,), as (n, joints); before the first one that is the first."""
        if self.held:
            index = np.searchsorted(self.command_time, time + 1e-9, side="right") - 1
            return self.command[np.clip(index, 0, len(self.command) - 1)]
        columns = [np.interp(time, self.command_time, column) for column in self.command.T]
        return np.stack(columns, axis=1)


def read_logs(
    robot: Robot, paths: Iterable[str | os.PathLike[str]], kind: CommandKind | None = None, *, hold: bool = False
) -> list[Log]:
    """Return the logs in files.

    Parameters
    ----------
    kind
        Command to read where a file has both: "setpoint" or "effort"; default the one that it has, else "effort".
    hold
        True if the commands of CSV and HDF5 files hold from row to row, False to interpolate between rows, as for
        commands that changed between rows as well. Recordings are always held.

    Raises
    ------
    InvalidArgumentError
        A file holds no log of this robot; the message names the file, line and column.
    RecordingError
        A recording cannot be read.
    MissingDependencyError
        h5py is not installed, which .h5 files need.
    FileNotFoundError
        There is no such file.
    """
    logs = [log for path in paths for log in _read(robot, file_path("log", path, SUFFIXES), kind, hold)]
    if not logs:
        raise InvalidArgumentError("logs", "are missing", remedy="name one file or more")
    kinds = {log.kind for log in logs}
    if len(kinds) > 1:
        remedy = "use logs of one kind"
        raise InvalidArgumentError("logs", "hold setpoints in some files and efforts in others", remedy=remedy)
    return logs


def _read(robot: Robot, path: Path, kind: CommandKind | None, hold: bool) -> list[Log]:
    if not path.exists():
        raise FileNotFoundError(2, "there is no such file", str(path))
    if path.suffix.lower() in (".csv", ".txt"):
        columns, lines = read_csv(path)
        return [_build(robot, str(path), columns, lines, kind, hold)]
    if path.suffix.lower() in HDF5:
        found = read_hdf5_columns(path)
        if found is not None:
            return [_build(robot, str(path), found, None, kind, hold)]
    return logs_of_rollout(robot, read_recording(path), kind, source=str(path))


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
    found: CommandKind = "effort" if info.control == "effort" else "setpoint"
    if kind is not None and kind != found:
        problem = f"was made under control {info.control!r} and holds {found}s"
        raise InvalidArgumentError(source, problem, remedy=f"fit its {found}s")
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
        logs.append(_checked(robot, log, None))
    return logs


def _build(
    robot: Robot,
    source: str,
    columns: dict[str, Float64],
    lines: list[int] | None,
    kind: CommandKind | None,
    hold: bool,
) -> Log:
    """Return the log that the columns of a file hold."""
    if "time" not in columns:
        problem = f"has no column 'time', but {', '.join(list(columns)[:6])}"
        raise error(source, problem, "begin the header with time, in seconds")
    by: dict[str, dict[str, Float64]] = {quantity: {} for quantity in QUANTITIES}
    for name, values in columns.items():
        quantity, colon, joint = name.partition(":")
        if colon and quantity.strip() in by:
            choice(f"{source}: column {name!r}: joint", joint.strip(), robot.joint_names)
            by[quantity.strip()][joint.strip()] = values
    if not by["qpos"]:
        raise error(
            source, "has no column qpos:JOINT", "measured positions are needed, e.g. qpos:" + robot.joint_names[0]
        )
    kinds: list[CommandKind] = [each for each in ("effort", "setpoint") if by[each]]
    if not kinds or (kind is not None and kind not in kinds):
        wanted = kind or "setpoint"
        raise error(
            source, f"has no column {wanted}:JOINT", f"commands are needed, e.g. {wanted}:{robot.joint_names[0]}"
        )
    found = kind or kinds[0]
    for joint in by[found].keys() ^ by["qpos"].keys():
        lacking = "qpos" if joint in by[found] else found
        remedy = "give both of a joint or neither; a joint that is left out rests at the robot's start pose"
        raise InvalidArgumentError(f"{source}: column {lacking}:{joint}", "is missing", remedy=remedy)
    names = [name for name in robot.joint_names if name in by["qpos"]]
    names = [name for name, free in zip(robot.joint_names, robot.independent, strict=True) if free and name in names]
    if not names:
        raise error(source, "holds followers alone, which their leaders move", "give the columns of the leaders")
    if len({len(columns["time"]), *(len(by[q][n]) for q in ("qpos", found) for n in names)}) > 1:
        raise error(source, "has columns of different lengths", "give one value per row in each")
    tables = {q: np.stack([by[q][n] for n in names], axis=1) for q in ("qpos", found)}
    whole = all(n in by["qvel"] and len(by["qvel"][n]) == len(columns["time"]) for n in names)
    qvel = np.stack([by["qvel"][n] for n in names], axis=1) if whole else None
    joints = tuple(robot.joint_names.index(name) for name in names)
    time = columns["time"]
    log = Log(source, joints, found, time, tables["qpos"], time, tables[found], hold, qvel)
    return _checked(robot, log, lines)


def _checked(robot: Robot, log: Log, lines: Sequence[int] | None) -> Log:
    """Return ``log`` if its times increase and its values are finite and in SI units."""

    def row(index: int) -> str:
        return f"row {index + 1}" if lines is None else f"line {lines[index]}"

    names = [robot.joint_names[joint] for joint in log.joints]
    for quantity, table in (("qpos", log.qpos), (log.kind, log.command), ("qvel", log.qvel)):
        if table is not None and not np.isfinite(table).all():
            index, joint = (int(n) for n in np.argwhere(~np.isfinite(table))[0])
            remedy = "remove the row, or give the number"
            raise error(log.source, f"{row(index)}, column '{quantity}:{names[joint]}' is empty or not finite", remedy)
    if not np.isfinite(log.time).all():
        index = int(np.argmin(np.isfinite(log.time)))
        raise error(log.source, f"{row(index)}, column 'time' is empty or not finite", "remove the row")
    if (np.diff(log.time) <= 0).any():
        index = int(np.argmax(np.diff(log.time) <= 0)) + 1
        raise error(log.source, f"{row(index)}: time does not increase", "sort the rows, and give each time once")
    if len(log.time) < MIN_ROWS or log.seconds < MIN_SECONDS:
        problem = f"has {len(log.time)} rows of {log.seconds:.3g} s"
        raise error(log.source, problem, f"record {MIN_ROWS} rows and {MIN_SECONDS} s at least; time is in seconds")
    if (period := float(np.median(np.diff(log.time)))) > 0.05:
        remedy = "record at 100 Hz or more; time is in seconds"
        raise error(log.source, f"has one row per {period:.3g} s, too few to see friction and delay", remedy)
    reach = np.array([BEYOND[robot.units[joint]] for joint in log.joints])
    free = robot.continuous[list(log.joints)]
    low, high = (limit[list(log.joints)] for limit in (robot.lower, robot.upper))
    beyond = ((log.qpos < low - reach) | (log.qpos > high + reach)) & ~free
    if beyond.any():
        index, joint = (int(n) for n in np.argwhere(beyond)[0])
        problem = f"{row(index)}, column 'qpos:{names[joint]}' is far beyond the joint's limits"
        remedy = f"positions are in {robot.units[log.joints[joint]]}; the limits are {low[joint]:g} to {high[joint]:g}"
        raise error(log.source, problem, remedy, float(log.qpos[index, joint]))
    return log


def at_limits(robot: Robot, log: Log) -> list[str]:
    """Return a line for each joint that ``log`` shows at a limit, where a stop acts and not the motor alone."""
    lines = []
    for column, joint in zip(log.qpos.T, log.joints, strict=True):
        low, high = robot.lower[joint], robot.upper[joint]
        if robot.continuous[joint] or not np.isfinite(high - low):
            continue
        touching = (column < low + AT_LIMIT * (high - low)) | (column > high - AT_LIMIT * (high - low))
        if touching.any():
            limits = f"limits {low:g} to {high:g} {robot.units[joint]}"
            place = f"{log.source}: joint {robot.joint_names[joint]!r} is at its limit"
            lines.append(f"{place} in {touching.mean():.2g} of the rows ({limits})")
    return lines


def setpoint_csv(robot: Robot, motion: Trajectory) -> str:
    """Return the setpoints of ``motion`` as CSV, with the header of a log; its first row is for time 0."""
    lines = [",".join(["time", *(f"setpoint:{name}" for name in robot.joint_names)])]
    dt = float(motion.time[0])
    for time, row in zip(motion.time - dt, motion.position, strict=True):
        lines.append(",".join([f"{time:.9g}", *(f"{value:.9g}" for value in row)]))
    return "\n".join(lines) + "\n"
