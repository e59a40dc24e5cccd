"""Checks of a log: increasing times, finite values in SI units, joint limits, stretches without gaps, and turns.

A log is divided where its times have a gap: the commands within it are unknown, so a simulation cannot bridge it. It
would also take time and memory in proportion to the length of the gap. Positions and setpoints of revolute joints that
were logged modulo 2 pi become continuous.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import TURN
from batchpid.checks.warn import warn
from batchpid.sim.identification.columns import error
from batchpid.sim.identification.log import Log, LogWarning
from batchpid.sim.robot.robot import Robot

AT_LIMIT = 1e-3
"""Distance to a joint limit at which a joint counts as stopped by it, over its range."""
SPEEDING = 4.0
"""Speed of nearly all rows, over the joint's velocity limit, from which positions may be in degrees."""
BEYOND = {"rad": 0.3, "m": 0.05}
"""Distance beyond a joint limit at which a position counts as given in another unit."""
MIN_ROWS, MIN_SECONDS = 50, 0.2
"""Least number of rows and length [s] of a stretch."""
GAP, PERIODS = 0.1, 5.0
"""Least length of a gap, in seconds and in median periods of the rows; the longer one applies."""
DROPOUT = 10.0
"""Longest gap [s] next to which a short stretch is left out. Next to a longer one its times are probably wrong."""
MOST_TURNS = 2
"""Most turns of a jump; positions that jump by more are not in rad."""
CLEAR = np.pi / 2
"""Largest change from row to row, apart from whole turns, at which the number of turns is certain [rad]."""


def checked(robot: Robot, log: Log, lines: Sequence[int] | None = None) -> list[Log]:
    """Return the stretches of ``log``, if its times increase and its values are finite and in SI units.

    ``lines`` are the numbers of its rows in a file.
    """

    def row(index: int) -> str:
        return f"row {index + 1}" if lines is None else f"line {lines[index]}"

    names = [robot.joint_names[joint] for joint in log.joints]
    tables = (("qpos", log.qpos), (log.kind, log.command), ("qvel", log.qvel))
    for quantity, table in (*tables, ("feedforward", log.feedforward), ("measured_effort", log.measured)):
        if table is not None and not np.isfinite(table).all():
            index, joint = (int(n) for n in np.argwhere(~np.isfinite(table))[0])
            remedy = "remove the row, or give the number"
            raise error(log.source, f"{row(index)}, column '{quantity}:{names[joint]}' is empty or not finite", remedy)
    if not np.isfinite(log.time).all():
        index = int(np.argmin(np.isfinite(log.time)))
        raise error(log.source, f"{row(index)}, column 'time' is empty or not finite", "remove the row")
    if (log.time[1:] <= log.time[:-1]).any():
        index = int(np.argmax(log.time[1:] <= log.time[:-1])) + 1
        raise error(log.source, f"{row(index)}: time does not increase", "sort the rows, and give each time once")
    if len(log.time) < MIN_ROWS or log.seconds < MIN_SECONDS:
        problem = f"has {len(log.time)} rows of {log.seconds:.3g} s"
        raise error(log.source, problem, f"record {MIN_ROWS} rows and {MIN_SECONDS} s at least; time is in seconds")
    with np.errstate(over="ignore"):
        period = float(np.median(np.diff(log.time)))
    if period > 0.05:
        remedy = "record at 100 Hz or more; time is in seconds"
        raise error(log.source, f"has one row per {period:.3g} s, too few to see friction and delay", remedy)
    reach = np.array([BEYOND[robot.units[joint]] for joint in log.joints])
    free = robot.continuous[list(log.joints)]
    low, high = (limit[list(log.joints)] for limit in (robot.lower, robot.upper))
    beyond = ((log.qpos < low - reach) | (log.qpos > high + reach)) & ~free
    if beyond.any():
        index, joint = (int(n) for n in np.argwhere(beyond)[0])
        problem = f"{row(index)}, column 'qpos:{names[joint]}' is far beyond the joint's limits"
        unit = robot.units[log.joints[joint]]
        remedy = f"positions are in {unit}, or degrees as an option; the limits are {low[joint]:g} to {high[joint]:g}"
        if np.isclose(high[joint] - low[joint], 2 * np.pi, rtol=0.01):
            remedy += "; a joint that turns freely is of type continuous"
        raise error(log.source, problem, remedy, float(log.qpos[index, joint]))
    parts, wrapped = [], dict[str, None]()
    for part in divided(log, row):
        first = int(np.searchsorted(log.time, part.time[0]))
        whole, found = unwrapped(robot, part, row, first)
        parts.append(whole)
        wrapped |= dict.fromkeys(found)
    if stopped := [name for name in wrapped if not robot.continuous[robot.joint_names.index(name)]]:
        problem = f"{log.source}: the positions of {', '.join(stopped)} jump by whole turns, and were unwrapped"
        warn(f"{problem}; in the robot's file the type is not continuous: correct it", LogWarning)
    return parts


def divided(log: Log, row: Callable[[int], str]) -> list[Log]:
    """Return the stretches of ``log`` between gaps, its times increasing; ``row`` names a row.

    Raises InvalidArgumentError if a stretch is too short, and a gap next to it is longer than :data:`DROPOUT`; or all
    stretches are too short.
    """
    with np.errstate(over="ignore"):
        periods = np.diff(log.time)
    gap = max(GAP, PERIODS * float(np.median(periods)))
    ends = [0, *(np.flatnonzero(periods > gap) + 1).tolist(), len(log.time)]
    kept, left_out = list[slice](), []
    for rows in (slice(*pair) for pair in pairwise(ends)):
        if rows.stop - rows.start >= MIN_ROWS and log.time[rows.stop - 1] - log.time[rows.start] >= MIN_SECONDS:
            kept.append(rows)
            continue
        _check_dropout(log, rows, periods, row)
        left_out.append(f"{row(rows.start)} to {row(rows.stop - 1)}")
    if not kept:
        problem = f"has gaps of more than {gap:.3g} s in time, the first at {row(ends[1])}"
        raise error(log.source, f"{problem}; all stretches between them are too short", _need())
    if left_out:
        problem = f"{len(left_out)} stretches between gaps in time are too short and left out"
        more = ", ..." if len(left_out) > 5 else ""
        warn(f"{log.source}: {problem}: {', '.join(left_out[:5])}{more}", LogWarning)
    if kept == [slice(0, len(log.time))]:
        return [log]
    parts = []
    for rows in kept:
        commands = commands_of(log.time[rows], log.command_time, gap)
        source = f"{log.source}, {row(rows.start)} to {row(rows.stop - 1)}"
        parts.append(replace(log.part(rows, commands), source=source))
    return parts


def _check_dropout(log: Log, rows: slice, periods: Float64, row: Callable[[int], str]) -> None:
    """Raise InvalidArgumentError for a short stretch, ``rows``, next to a gap that is longer than :data:`DROPOUT`."""
    for jump in (at for at in (rows.start, rows.stop) if 0 < at < len(log.time) and periods[at - 1] > DROPOUT):
        count, seconds = rows.stop - rows.start, log.time[rows.stop - 1] - log.time[rows.start]
        problem = f"{row(jump)}: time jumps by {periods[jump - 1]:.4g} s, to {log.time[jump]:.12g} s"
        where = "before" if jump == rows.stop else "from there on"
        problem += f", and the {count} {'row' if count == 1 else 'rows'} {where} span {seconds:.3g} s"
        raise error(log.source, problem, f"correct the times, or remove those rows; {_need()}")


def _need() -> str:
    return f"a stretch without gap needs {MIN_ROWS} rows and {MIN_SECONDS} s"


def commands_of(time: Float64, command_time: Float64, gap: float = GAP) -> slice:
    """Return the commands at the rows ``time``, within half a ``gap`` [s] of them.

    The one that acts at the first row and, for interpolation, one after the last are among them.
    """
    first = np.searchsorted(command_time, time[0] - gap / 2), np.searchsorted(command_time, time[0], "right") - 1
    stop = np.searchsorted(command_time, time[-1] + gap / 2, "right"), np.searchsorted(command_time, time[-1]) + 1
    return slice(max(int(min(first)), 0), int(max(stop)))


def unwrapped(robot: Robot, log: Log, row: Callable[[int], str], first: int) -> tuple[Log, list[str]]:
    """Return ``log``, a stretch without gaps, with continuous positions, and the names of the joints that wrapped.

    Setpoints get the turns that bring them closest to the positions. ``row`` names a row of the whole log, in which the
    stretch begins at the row ``first``. Raises InvalidArgumentError if the number of turns is not certain.
    """
    qpos, command, wrapped = log.qpos.copy(), log.command.copy(), []
    for number, joint in enumerate(log.joints):
        name = robot.joint_names[joint]
        if robot.units[joint] != "rad":
            continue
        steps = np.diff(qpos[:, number])
        turns = np.rint(steps / TURN)
        if turns.any():
            _check_turns(log, name, steps, turns, row, first)
            qpos[1:, number] -= TURN * np.cumsum(turns)
            wrapped.append(name)
        if log.kind == "setpoint" and (turns.any() or robot.continuous[joint]):
            measured = np.interp(log.command_time, log.time, qpos[:, number])
            command[:, number] = _closest(command[:, number], measured)
            far = np.abs(command[:, number] - measured) > np.pi
            if turns.any() and far.any():
                at = int(np.clip(np.searchsorted(log.time, log.command_time[np.argmax(far)]), 0, len(log.time) - 1))
                problem = f"the setpoint of joint {name!r} is more than half a turn from its wrapped position"
                remedy = "unwrap the columns of the joint before they are logged"
                raise error(log.source, f"{row(first + at)}: {problem}", remedy)
    if np.array_equal(qpos, log.qpos) and np.array_equal(command, log.command):
        return log, []
    return replace(log, qpos=qpos, command=command), wrapped


def _check_turns(log: Log, name: str, steps: Float64, turns: Float64, row: Callable[[int], str], first: int) -> None:
    """Raise InvalidArgumentError if the ``turns`` of the ``steps`` of a joint from row to row are not certain."""
    unclear = np.flatnonzero((np.abs(steps - TURN * turns) > CLEAR) | (np.abs(turns) > MOST_TURNS))
    if not len(unclear):
        return
    at = int(unclear[0])
    seconds = log.time[at + 1] - log.time[at]
    problem = f"{row(first + at + 1)}: joint {name!r} jumps by {steps[at]:.3g} rad within {seconds:.3g} s"
    if abs(turns[at]) > MOST_TURNS:
        raise error(log.source, problem, "give positions in rad")
    remedy = "the number of turns is not certain: log more rows per second, unwrap the column, or remove wrong rows"
    raise error(log.source, problem, remedy)


def _closest(setpoints: Float64, measured: Float64) -> Float64:
    """Return ``setpoints`` (commands,), wrapped or not, with the turns that bring them closest to ``measured``."""
    if np.abs(np.diff(setpoints)).max(initial=0.0) <= np.pi and np.abs(setpoints - measured).max() <= np.pi:
        return setpoints
    ways = [each - TURN * np.rint(np.median(each - measured) / TURN) for each in (setpoints, np.unwrap(setpoints))]
    return min(ways, key=lambda each: float(np.abs(each - measured).mean()))


def too_fast(robot: Robot, logs: list[Log]) -> str:
    """Return the names of the joints that move too fast for positions in rad, without rare jumps."""
    rates = [np.abs(np.diff(log.qpos, axis=0)) / np.diff(log.time)[:, None] for log in logs]
    speeds, own = np.concatenate(rates), list(logs[0].joints)
    typical = np.sqrt((np.minimum(speeds, np.quantile(speeds, 0.95, axis=0)) ** 2).mean(0))
    limit = robot.velocity_limit[own]
    fast = (limit > 0) & (typical > SPEEDING * limit) & (np.array(robot.units)[own] == "rad")
    return ", ".join(robot.joint_names[joint] for joint, each in zip(own, fast, strict=True) if each)


def at_limits(robot: Robot, log: Log) -> list[str]:
    """Return a line for each joint that ``log`` shows at a limit, where a stop acts and not the motor alone."""
    lines = []
    for column, joint in zip(log.qpos.T, log.joints, strict=True):
        low, high = robot.lower[joint], robot.upper[joint]
        if robot.continuous[joint] or not np.isfinite(high - low):
            continue
        if (column < low - BEYOND["rad"]).any() or (column > high + BEYOND["rad"]).any():
            continue  # unwrapped: it turns freely
        touching = (column < low + AT_LIMIT * (high - low)) | (column > high - AT_LIMIT * (high - low))
        if touching.any():
            limits = f"limits {low:g} to {high:g} {robot.units[joint]}"
            place = f"{log.source}: joint {robot.joint_names[joint]!r} is at its limit"
            lines.append(f"{place} in {touching.mean():.2g} of the rows ({limits})")
    return lines
