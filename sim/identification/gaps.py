"""Gaps in the times of a log, and the stretches between them.

The commands within a gap are unknown, so a simulation cannot bridge it. It would also take time and memory in
proportion to the length of the gap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.checks.warn import warn
from batchpid.sim.identification.columns import error
from batchpid.sim.identification.log import Log, LogWarning

MIN_ROWS, MIN_SECONDS = 50, 0.2
"""Least number of rows and length [s] of a stretch."""
GAP, PERIODS = 0.1, 5.0
"""Least length of a gap, in seconds and in median periods of the rows; the longer one applies."""
DROPOUT = 10.0
"""Longest gap [s] next to which a short stretch is left out. Next to a longer one its times are probably wrong."""


class Stretches(NamedTuple):
    """Rows of a log between gaps."""

    rows: list[slice]
    left_out: list[slice]
    """Rows of stretches that are too short."""
    gap: float
    """Least length of a gap [s]."""


def stretches(source: str, time: Float64, row: Callable[[int], str]) -> Stretches:
    """Return the stretches of a log with increasing times (rows,) [s]; ``row`` names a row.

    Raises InvalidArgumentError if a stretch is too short, and a gap next to it is longer than :data:`DROPOUT`; or all
    stretches are too short.
    """
    with np.errstate(over="ignore"):
        periods = np.diff(time)
    gap = max(GAP, PERIODS * float(np.median(periods)))
    ends = [0, *(np.flatnonzero(periods > gap) + 1).tolist(), len(time)]
    parts = [slice(*pair) for pair in pairwise(ends)]
    kept, left_out = [], []
    for part in parts:
        count, seconds = part.stop - part.start, time[part.stop - 1] - time[part.start]
        if count >= MIN_ROWS and seconds >= MIN_SECONDS:
            kept.append(part)
            continue
        left_out.append(part)
        for jump in (at for at in (part.start, part.stop) if 0 < at < len(time) and periods[at - 1] > DROPOUT):
            problem = f"{row(jump)}: time jumps by {periods[jump - 1]:.4g} s, to {time[jump]:.12g} s"
            where = "before" if jump == part.stop else "from there on"
            problem += f", and the {count} {'row' if count == 1 else 'rows'} {where} span {seconds:.3g} s"
            raise error(source, problem, f"correct the times, or remove those rows; {_need()}")
    if not kept:
        problem = f"has gaps of more than {gap:.3g} s in time, the first at {row(parts[0].stop)}"
        raise error(source, f"{problem}; all stretches between them are too short", _need())
    return Stretches(kept, left_out, gap)


def _need() -> str:
    return f"a stretch without gap needs {MIN_ROWS} rows and {MIN_SECONDS} s"


def divided(log: Log, row: Callable[[int], str]) -> list[Log]:
    """Return the stretches of ``log`` between gaps; ``row`` names a row."""
    found = stretches(log.source, log.time, row)
    if found.left_out:
        ranges = ", ".join(f"{row(each.start)} to {row(each.stop - 1)}" for each in found.left_out[:5])
        problem = f"{len(found.left_out)} stretches between gaps in time are too short and left out"
        more = ", ..." if len(found.left_out) > 5 else ""
        warn(f"{log.source}: {problem}: {ranges}{more}", LogWarning)
    if found.rows == [slice(0, len(log.time))]:
        return [log]
    parts = []
    for rows in found.rows:
        commands = commands_of(log.time[rows], log.command_time, found.gap)
        source = f"{log.source}, {row(rows.start)} to {row(rows.stop - 1)}"
        parts.append(replace(log.part(rows, commands), source=source))
    return parts


def commands_of(time: Float64, command_time: Float64, gap: float = GAP) -> slice:
    """Return the commands at the rows ``time``, within half a ``gap`` [s] of them.

    The one that acts at the first row and, for interpolation, one after the last are among them.
    """
    first = np.searchsorted(command_time, time[0] - gap / 2), np.searchsorted(command_time, time[0], "right") - 1
    stop = np.searchsorted(command_time, time[-1] + gap / 2, "right"), np.searchsorted(command_time, time[-1]) + 1
    return slice(max(int(min(first)), 0), int(max(stop)))
