"""Log of a robot in motion, and the checks that every log passes once.

A log is divided where its times have a gap, because the commands within it are unknown. Positions
and setpoints of revolute joints that were logged modulo 2 pi become continuous.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64, Rows
from batchpid.arrays.elementwise import TURN
from batchpid.checks.warn import warn
from batchpid.sim.recording.setpoint_files import error
from batchpid.sim.robot.robot import Robot

CommandKind = Literal["setpoint", "effort"]
BEYOND = {"rad": 0.3, "m": 0.05}
"""Distance beyond a joint limit at which a position counts as given in another unit."""
MIN_ROWS, MIN_SECONDS = 50, 0.2
"""Least number of rows and length [s] of a stretch."""
GAP, PERIODS = 0.1, 5.0
"""Least length of a gap, in seconds and in median periods of the rows; the longer one applies."""
CLEAR = np.pi / 2
"""Largest change from row to row, apart from whole turns, at which the number of turns is certain
[rad].
"""


class LogWarning(UserWarning):
    """A log was changed when it was read, or shows an effect that the model of the robot lacks."""


class LogSettings(NamedTuple):
    """Settings of one log among several; None: as all."""

    robot: Robot | None = None
    """The robot, with the same joints as all."""
    params: bp.PIDParams | None = None
    """Params of the PID law, of the joints of the log."""
    payload: float = 0.0
    """Known payload at the tool [kg], in addition to the unknown one."""
    held_out: bool | None = None
    """True to hold out the whole log, False to fit it all; None: its last quarter is held out."""


ALIKE = LogSettings()
"""Settings of a log that has none of its own."""


@dataclass(frozen=True, eq=False)
class Log:
    """Commands and measured positions of some joints of one robot."""

    source: str
    """Name of its file, and the env of a recording."""
    joints: tuple[int, ...]
    """Numbers of its joints, in the robot's order; followers are left out."""
    kind: CommandKind
    time: Float64
    """Times of the measurements (rows,) [s]."""
    qpos: Float64
    """Measured positions (rows, joints) [rad or m]."""
    command_time: Float64
    """Times from which the commands act (commands,) [s]."""
    command: Float64
    """Setpoints [rad or m] or efforts [N m or N] (commands, joints)."""
    held: bool
    """True if a command holds until the next one; False to interpolate between them."""
    timestep: float | None = None
    """Time step of the control [s], where the log says it."""
    compensate: str | None = None
    """Forces that the robot compensated, where the log says it."""
    feedforward: Float64 | None = None
    """Efforts that are added to the efforts of the law (commands, joints) [N m or N]."""
    measured: bool = False
    """True if the efforts of ``command`` were measured and not commanded: they have no delay."""
    params: bp.PIDParams | None = None
    """Params that drove the robot, where the log says it."""
    settings: LogSettings = ALIKE
    is_checked: bool = False
    """True for the result of :func:`checked`."""

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return float(self.time[-1] - self.time[0])

    def part(
        self, rows: Any = slice(None), commands: Any = slice(None), joints: Any = slice(None)
    ) -> Log:
        """Return the log of some rows, commands and joints: slices or masks."""
        forward = self.feedforward
        return replace(
            self,
            joints=tuple(np.array(self.joints)[joints].tolist()),
            time=self.time[rows],
            qpos=self.qpos[rows][:, joints],
            command_time=self.command_time[commands],
            command=self.command[commands][:, joints],
            feedforward=None if forward is None else forward[commands][:, joints],
        )

    def commands_at(self, time: Float64, table: Float64 | None = None) -> Float64:
        """Return the commands that act at ``time`` (n,), as (n, joints); the first one also acts
        before its time.

        ``table`` takes the place of the commands, such as the feedforward.
        """
        table = self.command if table is None else table
        if self.held:
            index = np.searchsorted(self.command_time, time + 1e-9, side="right") - 1
            return table[np.clip(index, 0, len(table) - 1)]
        return interpolated(time, self.command_time, table)


def interpolated(time: Float64, known: Rows, table: Rows) -> Float64:
    """Return the rows (n, columns) at ``time`` (n,) of a table whose rows are for the times
    ``known``.
    """
    return np.stack([np.interp(time, known, column) for column in table.T], axis=1)


def checked(robot: Robot, log: Log, lines: Sequence[int] | None = None) -> list[Log]:
    """Return the stretches of ``log`` between gaps in time, with continuous positions.

    ``lines`` are the numbers of its rows in a file.

    Raises
    ------
    InvalidArgumentError
        A value is not finite, times decrease, there are too few rows, or positions are in another
        unit.
    """
    if log.is_checked:
        return [log]
    places = (
        [f"row {index + 1}" for index in range(len(log.time))]
        if lines is None
        else [f"line {n}" for n in lines]
    )
    _check_finite(robot, log, places)
    if (log.time[1:] < log.time[:-1]).any():
        index = int(np.argmax(log.time[1:] < log.time[:-1])) + 1
        raise error(log.source, f"{places[index]}: time decreases", "sort the rows")
    repeated = np.append(False, log.time[1:] == log.time[:-1])
    if repeated.any():
        first = places[int(np.argmax(repeated))]
        warn(
            f"{log.source}: {repeated.sum()} rows repeat a time, the first at {first}: left out",
            LogWarning,
        )
        places = [place for place, again in zip(places, repeated, strict=True) if not again]
        log = log.part(
            ~repeated, ~repeated if len(log.command_time) == len(repeated) else slice(None)
        )
    need = f"{MIN_ROWS} rows and {MIN_SECONDS} s"
    if len(log.time) < MIN_ROWS or log.seconds < MIN_SECONDS:
        problem = f"has {len(log.time)} rows of {log.seconds:.3g} s"
        raise error(
            log.source,
            problem,
            f"record {need} at least; time is in seconds, or the column is time_ms",
        )
    period = float(np.median(np.diff(log.time)))
    if period > 0.05:
        remedy = (
            "record at 100 Hz or more; time is in seconds, or the column is time_ms, time_us or"
            " time_ns"
        )
        raise error(
            log.source, f"has one row per {period:.3g} s, too few to see friction and delay", remedy
        )
    gap = max(GAP, PERIODS * period)
    ends = [0, *(np.flatnonzero(np.diff(log.time) > gap) + 1).tolist(), len(log.time)]
    parts, short = list[Log](), list[str]()
    for begin, end in pairwise(ends):
        if end - begin < MIN_ROWS or log.time[end - 1] - log.time[begin] < MIN_SECONDS:
            short.append(f"{places[begin]} to {places[end - 1]}")
            continue
        part = log if len(ends) == 2 else _between(log, slice(begin, end), places)
        parts.append(replace(_unwrapped(robot, part, places[begin:end]), is_checked=True))
    if not parts:
        raise error(
            log.source,
            f"has gaps of more than {gap:.3g} s in time",
            f"a stretch between gaps needs {need}",
        )
    if short:
        warn(
            f"{log.source}: stretches between gaps in time are too short, left out: {short[0]} ...",
            LogWarning,
        )
    return parts


def _between(log: Log, rows: slice, places: list[str]) -> Log:
    """Return the stretch ``rows`` of ``log``, with the commands that act in it."""
    begin, end = log.time[rows.start], log.time[rows.stop - 1]
    first = max(int(np.searchsorted(log.command_time, begin, "right")) - 1, 0)
    commands = slice(first, int(np.searchsorted(log.command_time, end, "right")) + 1)
    source = f"{log.source}, {places[rows.start]} to {places[rows.stop - 1]}"
    return replace(log.part(rows, commands), source=source)


def _check_finite(robot: Robot, log: Log, places: list[str]) -> None:
    tables = {
        "time": log.time[:, None],
        "qpos": log.qpos,
        log.kind: log.command,
        "feedforward": log.feedforward,
    }
    for quantity, table in tables.items():
        if table is None or np.isfinite(table).all():
            continue
        index, joint = (int(n) for n in np.argwhere(~np.isfinite(table))[0])
        column = (
            "time" if quantity == "time" else f"{quantity}:{robot.joint_names[log.joints[joint]]}"
        )
        raise error(
            log.source,
            f"{places[min(index, len(places) - 1)]}, column {column!r} is empty or not finite",
            "remove the row",
        )


def _unwrapped(robot: Robot, log: Log, places: list[str]) -> Log:
    """Return ``log``, without gaps, with continuous positions, and setpoints on the turns closest
    to them.
    """
    qpos = log.qpos.copy()
    command = log.command.copy()
    wrapped = list[str]()
    for number, joint in enumerate(log.joints):
        name, column = robot.joint_names[joint], qpos[:, number]
        turns = np.zeros(len(column) - 1)
        if robot.units[joint] == "rad":
            steps = np.diff(column)
            turns = np.rint(steps / TURN)
            unclear = (np.abs(steps - TURN * turns) > CLEAR) | (np.abs(turns) > 2)
            if (turns != 0).any() and unclear.any():
                at = int(np.argmax(unclear))
                problem = f"{places[at + 1]}: joint {name!r} jumps by {steps[at]:.3g} rad"
                remedy = "give positions in rad, log more rows per second, or remove wrong rows"
                raise error(log.source, problem, remedy)
            column[1:] -= TURN * np.cumsum(turns)
        if turns.any():
            wrapped.append(name)
        else:
            _check_unit(robot, log, joint, column, places)
        if log.kind == "setpoint" and (turns.any() or robot.continuous[joint]):
            measured = np.interp(log.command_time, log.time, column)
            command[:, number] -= TURN * np.rint((command[:, number] - measured) / TURN)
    limited = [name for name in wrapped if not robot.continuous[robot.joint_names.index(name)]]
    if limited:
        problem = (
            f"{log.source}: the positions of {', '.join(limited)} jump by whole turns, and were"
            " unwrapped"
        )
        warn(f"{problem}; in the robot's file the type is not continuous: correct it", LogWarning)
    return replace(log, qpos=qpos, command=command)


def _check_unit(robot: Robot, log: Log, joint: int, column: Float64, places: list[str]) -> None:
    """Raise InvalidArgumentError for positions that are not in the joint's unit, or far beyond its
    limits.
    """
    name, unit, (low, high) = (
        robot.joint_names[joint],
        robot.units[joint],
        (robot.lower[joint], robot.upper[joint]),
    )
    remedy = f"positions are in {unit}; degrees need the option degrees (--degrees)"
    beyond = (column < low - BEYOND[unit]) | (column > high + BEYOND[unit])
    if beyond.any() and not robot.continuous[joint]:
        index = int(np.argmax(beyond))
        problem = (
            f"{places[index]}, column 'qpos:{name}' is far beyond the joint's limits, {low:g} to"
            f" {high:g}"
        )
        raise error(
            log.source,
            problem,
            f"{remedy}; a joint that turns freely is of type continuous",
            column[index],
        )
