"""Checks of a log: increasing times, finite values in SI units, limits of the joints, and stretches without gaps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from batchpid.checks.warn import warn
from batchpid.sim.identification.columns import error
from batchpid.sim.identification.gaps import MIN_ROWS, MIN_SECONDS, divided
from batchpid.sim.identification.log import Log, LogWarning
from batchpid.sim.identification.turns import unwrapped
from batchpid.sim.robot.robot import Robot

AT_LIMIT = 1e-3
"""Distance to a joint limit at which a joint counts as stopped by it, over its range."""
SPEEDING = 4.0
"""Speed of nearly all rows, over the joint's velocity limit, from which positions may be in degrees."""
BEYOND = {"rad": 0.3, "m": 0.05}
"""Distance beyond a joint limit at which a position counts as given in another unit."""


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
        whole, found = unwrapped(robot, part, partial(_row_from, row, first))
        parts.append(whole)
        wrapped |= dict.fromkeys(found)
    if stopped := [name for name in wrapped if not robot.continuous[robot.joint_names.index(name)]]:
        problem = f"{log.source}: the positions of {', '.join(stopped)} jump by whole turns, and were unwrapped"
        warn(f"{problem}; in the robot's file the type is not continuous: correct it", LogWarning)
    return parts


def too_fast(robot: Robot, logs: list[Log]) -> str:
    """Return the names of the joints that move too fast for positions in rad, without rare jumps."""
    rates = [np.abs(np.diff(log.qpos, axis=0)) / np.diff(log.time)[:, None] for log in logs]
    speeds, own = np.concatenate(rates), list(logs[0].joints)
    typical = np.sqrt((np.minimum(speeds, np.quantile(speeds, 0.95, axis=0)) ** 2).mean(0))
    limit = robot.velocity_limit[own]
    fast = (limit > 0) & (typical > SPEEDING * limit) & (np.array(robot.units)[own] == "rad")
    return ", ".join(robot.joint_names[joint] for joint, each in zip(own, fast, strict=True) if each)


def _row_from(row: Callable[[int], str], first: int, index: int) -> str:
    """Return the name of the row ``index`` of a part that begins at the row ``first``."""
    return row(first + index)


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
