"""Log of a robot in motion, and the checks that every log passes once.

A log is divided where its times have a gap, because the commands within it are unknown. Positions
and setpoints of revolute joints that were logged modulo 2 pi become continuous.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, SupportsIndex

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.arrays.elementwise import TURN
from batchpid.errors import InvalidArgumentError
from batchpid.sim.robot.robot import Robot

CommandKind = Literal["setpoint", "effort"]
LIMIT_MARGINS = 0.3, 0.05
"""Distances [rad], [m] beyond a joint limit at which a position counts as given in another
unit.
"""
MIN_ROWS, MIN_SECONDS = 50, 0.2
"""Least number of rows and length [s] of a stretch."""
LONGEST_PERIOD = 0.05
"""Longest period of the rows [s]."""
GAP, PERIODS = 0.1, 5.0
"""Least length of a gap, in seconds and in median periods of the rows; the longer one applies."""
CLEAR = np.pi / 2
"""Largest change from row to row, apart from whole turns, at which the number of turns is certain
[rad].
"""


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
    measured: bool = False
    """True if the efforts of ``command`` were measured and not commanded: they have no delay."""
    params: bp.PIDParams | None = None
    """Params that drove the robot, of all its joints or of the log's; None: as given to
    ``identify``.
    """
    robot: Robot | None = None
    """The robot, with the same joints as that of ``identify``; None: that one."""
    held_out: bool | None = None
    """True to hold out the whole log, False to fit it all; None: its last quarter is held out."""
    lines: Rows | None = None
    """Number of each row's line in a file (rows,)."""
    is_checked: bool = False
    """True for the result of :func:`checked`."""
    remarks: tuple[str, ...] = ()
    """Sentences on what was left out of its source, for the report."""

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return float(self.time[-1] - self.time[0])

    def part(
        self,
        rows: slice | Bool = slice(None),
        commands: slice | Bool = slice(None),
        joints: slice | Bool = slice(None),
    ) -> Log:
        """Return the log of some rows, commands and joints: slices or masks."""
        return replace(
            self,
            joints=tuple(np.array(self.joints)[joints].tolist()),
            time=self.time[rows],
            qpos=self.qpos[rows][:, joints],
            command_time=self.command_time[commands],
            command=self.command[commands][:, joints],
            lines=None if self.lines is None else self.lines[rows],
        )

    def commands_at(self, time: Float64) -> Float64:
        """Return the commands that act at ``time`` (n,), as (n, joints); the first one also acts
        before its time.
        """
        if self.held:
            index = np.searchsorted(self.command_time, time + 1e-9, side="right") - 1
            return self.command[np.clip(index, 0, len(self.command) - 1)]
        return interpolated(time, self.command_time, self.command)

    def place(self, row: SupportsIndex) -> str:
        """Return the name of a row."""
        return f"row {int(row) + 1}" if self.lines is None else f"line {self.lines[row]}"

    def error(self, problem: str, remedy: str, value: object = None) -> InvalidArgumentError:
        """Return the error of this log."""
        return InvalidArgumentError(self.source, problem, remedy=remedy, value=value)

    def with_remark(self, remark: str) -> Log:
        """Return the log with one remark more."""
        return replace(self, remarks=(*self.remarks, f"{self.source}: {remark}"))


def interpolated(time: Float64, known: Rows, table: Rows) -> Float64:
    """Return the rows (n, columns) at ``time`` (n,) of a table whose rows are for the times
    ``known``.
    """
    return np.stack([np.interp(time, known, column) for column in table.T], axis=1)


def checked(robot: Robot, log: Log, resets: Sequence[int] = ()) -> list[Log]:
    """Return the stretches of ``log`` between gaps in time, with continuous positions; ``resets``
    are rows before which the robot was placed elsewhere.

    Raises
    ------
    InvalidArgumentError
        A value is not finite, times do not increase, there are too few rows, or positions are in
        another unit.
    """
    _check_finite(robot, log)
    if log.is_checked:
        return [log]
    late = np.diff(log.time) <= 0
    if late.any():
        row = log.place(np.argmax(late) + 1)
        raise log.error(f"{row}: time does not increase", "sort the rows, and remove repeated ones")
    period = float(np.median(np.diff(log.time))) if len(log.time) > 1 else 0.0
    if period > LONGEST_PERIOD:
        problem = f"has one row per {period:.3g} s, too few to see friction and delay"
        raise log.error(problem, "record at 100 Hz or more, with the time in seconds")
    gaps = np.flatnonzero(np.diff(log.time) > max(GAP, PERIODS * period)) + 1
    cuts = np.union1d(gaps, resets).astype(int)
    parts = list[Log]()
    short = list[str]()
    for begin, end in pairwise([0, *cuts.tolist(), len(log.time)]):
        part = _between(log, begin, end) if len(cuts) else log
        if len(part.time) < MIN_ROWS or part.seconds < MIN_SECONDS:
            short.append(f"{log.place(begin)} to {log.place(end - 1)}")
        else:
            parts.append(_unwrapped(robot, part))
    if not parts:
        problem = f"has {len(log.time)} rows in {len(short)} stretches, all too short"
        remedy = f"record {MIN_ROWS} rows and {MIN_SECONDS} s without a gap, the time in seconds"
        raise log.error(problem, remedy)
    if short:
        remark = f"stretches between gaps in time or resets are too short, left out: {short[0]} ..."
        # The source of a stretch names its rows, too.
        remarks = log.with_remark(remark).remarks
        parts = [replace(part, remarks=remarks) for part in parts]
    return parts


def _check_finite(robot: Robot, log: Log) -> None:
    tables = {"time": log.time, "command_time": log.command_time, "qpos": log.qpos}
    tables[log.kind] = log.command
    for quantity, table in tables.items():
        for row, *columns in np.argwhere(~np.isfinite(table)).tolist():
            joints = [robot.joint_names[log.joints[column]] for column in columns]
            name = ":".join([quantity, *joints])
            problem = f"{log.place(row)}, column {name!r} is empty or not finite"
            raise log.error(problem, "remove the row")


def _between(log: Log, begin: int, end: int) -> Log:
    """Return the rows from ``begin`` to ``end`` of ``log``, with the commands that act in them."""
    first, last = np.searchsorted(log.command_time, log.time[[begin, end - 1]], "right")
    source = f"{log.source}, {log.place(begin)} to {log.place(end - 1)}"
    part = log.part(slice(begin, end), slice(max(first - 1, 0), last + 1))
    return replace(part, source=source)


def _unwrapped(robot: Robot, log: Log) -> Log:
    """Return ``log``, without gaps, with continuous positions, and setpoints on the turns closest
    to them.
    """
    joints = list(log.joints)
    names = [robot.joint_names[joint] for joint in joints]
    revolute = np.array([robot.units[joint] == "rad" for joint in joints])
    steps = np.diff(log.qpos, axis=0)
    turns = np.rint(steps / TURN) * revolute
    wraps = turns.any(0)
    unclear = (np.abs(steps - TURN * turns) > CLEAR) | (np.abs(turns) > 2)
    for row, column in np.argwhere(unclear & wraps):
        problem = f"{log.place(row + 1)}: joint {names[column]!r} jumps by"
        remedy = "give positions in rad, log more rows per second, or remove wrong rows"
        raise log.error(f"{problem} {steps[row, column]:.3g} rad", remedy)
    # Positions far beyond the limits are in another unit; those that wrap are within a turn.
    margin = np.where(revolute, *LIMIT_MARGINS)
    low = robot.lower[joints]
    high = robot.upper[joints]
    beyond = (log.qpos < low - margin) | (log.qpos > high + margin)
    free = robot.continuous[joints] | wraps
    for row, column in np.argwhere(beyond & ~free):
        problem = (
            f"{log.place(row)}, column 'qpos:{names[column]}' is far beyond the joint's limits"
        )
        remedy = "give positions in rad or m; a joint that turns freely is of type continuous"
        between = f"{low[column]:g} to {high[column]:g}"
        raise log.error(f"{problem}, {between}", remedy, log.qpos[row, column])
    qpos = log.qpos.copy()
    qpos[1:] -= TURN * np.cumsum(turns, axis=0)
    command = log.command
    if log.kind == "setpoint":
        measured = interpolated(log.command_time, log.time, qpos)
        command = command - TURN * free * np.rint((command - measured) / TURN)
    return replace(
        log,
        qpos=qpos,
        command=command,
        is_checked=True,
    )
