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
from batchpid.errors import warn
from batchpid.sim.recording.setpoint_files import error
from batchpid.sim.robot.robot import Robot

CommandKind = Literal["setpoint", "effort"]
BEYOND = {"rad": 0.3, "m": 0.05}
"""Distance beyond a joint limit at which a position counts as given in another unit."""
MIN_ROWS, MIN_SECONDS = 50, 0.2
"""Least number of rows and length [s] of a stretch."""
LONGEST = 0.05
"""Longest period of the rows [s]."""
GAP, PERIODS = 0.1, 5.0
"""Least length of a gap, in seconds and in median periods of the rows; the longer one applies."""
CLEAR = np.pi / 2
"""Largest change from row to row, apart from whole turns, at which the number of turns is certain
[rad].
"""
BEGIN = 0.03
"""Time at the start of a log over which its first velocity is measured [s]."""


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

    @property
    def start(self) -> tuple[Float64, Float64]:
        """Position and velocity (joints,) at the start: a line through the first rows; small speeds
        are rest.
        """
        count = max(4, int((self.time <= self.time[0] + BEGIN).sum()))
        first = self.qpos[:count]
        slope, place = np.polyfit(self.time[:count] - self.time[0], first, 1)
        speed = np.diff(self.qpos, axis=0) / np.diff(self.time)[:, None]
        moves = np.abs(slope) > 0.2 * np.sqrt((speed**2).mean(0))
        return np.where(moves, place, first.mean(0)), np.where(moves, slope, 0.0)

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
    places = [f"row {index + 1}" for index in range(len(log.time))]
    if lines is not None:
        places = [f"line {line}" for line in lines]
    _check_finite(robot, log, places)
    steps = np.diff(log.time, prepend=-np.inf)
    if (steps < 0).any():
        place = places[int(np.argmax(steps < 0))]
        raise error(log.source, f"{place}: time decreases", "sort the rows")
    repeated = steps == 0
    if repeated.any():
        first = places[int(np.argmax(repeated))]
        problem = f"{repeated.sum()} rows repeat a time, the first at {first}: left out"
        warn(f"{log.source}: {problem}", LogWarning)
        places = [place for place, again in zip(places, repeated, strict=True) if not again]
        # Commands of a recording have times of their own.
        rows_are_commands = len(log.command_time) == len(repeated)
        log = log.part(~repeated, ~repeated if rows_are_commands else slice(None))
    period = float(np.median(np.diff(log.time))) if len(log.time) > 1 else 0.0
    units = "time is in seconds, or the column is time_ms, time_us or time_ns"
    if period > LONGEST:
        problem = f"has one row per {period:.3g} s, too few to see friction and delay"
        raise error(log.source, problem, f"record at 100 Hz or more; {units}")
    gap = max(GAP, PERIODS * period)
    cuts = np.flatnonzero(np.diff(log.time) > gap) + 1
    parts = list[Log]()
    short = list[str]()
    for begin, end in pairwise([0, *cuts.tolist(), len(log.time)]):
        part = _between(log, slice(begin, end), places) if len(cuts) else log
        if len(part.time) < MIN_ROWS or part.seconds < MIN_SECONDS:
            short.append(f"{places[begin]} to {places[end - 1]}")
            continue
        parts.append(replace(_unwrapped(robot, part, places[begin:end]), is_checked=True))
    if not parts:
        problem = f"has {len(log.time)} rows of {log.seconds:.3g} s in {1 + len(cuts)} stretches"
        remedy = f"record {MIN_ROWS} rows and {MIN_SECONDS} s without a gap; {units}"
        raise error(log.source, problem, remedy)
    if short:
        problem = f"stretches between gaps in time are too short, left out: {short[0]} ..."
        warn(f"{log.source}: {problem}", LogWarning)
    return parts


def _between(log: Log, rows: slice, places: list[str]) -> Log:
    """Return the stretch ``rows`` of ``log``, with the commands that act in it."""
    begin, end = log.time[rows.start], log.time[rows.stop - 1]
    first = max(int(np.searchsorted(log.command_time, begin, "right")) - 1, 0)
    last = int(np.searchsorted(log.command_time, end, "right")) + 1
    source = f"{log.source}, {places[rows.start]} to {places[rows.stop - 1]}"
    return replace(log.part(rows, slice(first, last)), source=source)


def _check_finite(robot: Robot, log: Log, places: list[str]) -> None:
    tables = {"qpos": log.qpos, log.kind: log.command, "feedforward": log.feedforward}
    columns = {"time": log.time}
    for quantity, table in tables.items():
        if table is not None:
            for joint, column in zip(log.joints, table.T, strict=True):
                columns[f"{quantity}:{robot.joint_names[joint]}"] = column
    for name, column in columns.items():
        if not np.isfinite(column).all():
            place = places[min(int(np.argmin(np.isfinite(column))), len(places) - 1)]
            problem = f"{place}, column {name!r} is empty or not finite"
            raise error(log.source, problem, "remove the row")


def _unwrapped(robot: Robot, log: Log, places: list[str]) -> Log:
    """Return ``log``, without gaps, with continuous positions, and setpoints on the turns closest
    to them.
    """
    qpos = log.qpos.copy()
    command = log.command.copy()
    limited = list[str]()
    for number, joint in enumerate(log.joints):
        name, column = robot.joint_names[joint], qpos[:, number]
        steps = np.diff(column)
        turns = np.rint(steps / TURN)
        if robot.units[joint] != "rad":
            turns[:] = 0
        wraps = turns.any()
        unclear = (np.abs(steps - TURN * turns) > CLEAR) | (np.abs(turns) > 2)
        if wraps and unclear.any():
            at = int(np.argmax(unclear))
            problem = f"{places[at + 1]}: joint {name!r} jumps by {steps[at]:.3g} rad"
            remedy = "give positions in rad, log more rows per second, or remove wrong rows"
            raise error(log.source, problem, remedy)
        if wraps and not robot.continuous[joint]:
            limited.append(name)
        elif not robot.continuous[joint]:
            _check_unit(robot, log, joint, column, places)
        column[1:] -= TURN * np.cumsum(turns)
        if log.kind == "setpoint" and (wraps or robot.continuous[joint]):
            measured = np.interp(log.command_time, log.time, column)
            command[:, number] -= TURN * np.rint((command[:, number] - measured) / TURN)
    if limited:
        problem = f"the positions of {', '.join(limited)} jump by whole turns, and were unwrapped"
        remedy = "in the robot's file the type is not continuous: correct it"
        warn(f"{log.source}: {problem}; {remedy}", LogWarning)
    return replace(log, qpos=qpos, command=command)


def _check_unit(robot: Robot, log: Log, joint: int, column: Float64, places: list[str]) -> None:
    """Raise InvalidArgumentError for positions far beyond the joint's limits."""
    name, unit = robot.joint_names[joint], robot.units[joint]
    low, high = robot.lower[joint], robot.upper[joint]
    beyond = (column < low - BEYOND[unit]) | (column > high + BEYOND[unit])
    if not beyond.any():
        return
    index = int(np.argmax(beyond))
    limits = f"far beyond the joint's limits, {low:g} to {high:g}"
    remedy = f"positions are in {unit}; degrees need the option degrees (--degrees)"
    remedy += "; a joint that turns freely is of type continuous"
    problem = f"{places[index]}, column 'qpos:{name}' is {limits}"
    raise error(log.source, problem, remedy, column[index])
