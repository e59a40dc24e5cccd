"""Parts of a group of envs with a state of their own: sensors of links, and pushes of bases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.signals.quantities import untouched

Int64 = NDArray[np.int64]
COUNTS = ("steps", "due", "number")
"""Sim steps since the reset, those at which the next push is due, and pushes so far."""


class LinkSensors:
    """Quantities of ``size`` envs from the sensors of links, averaged over a tick, if ``options`` observe
    some.
    """

    def __init__(self, options: RunnerOptions, size: int) -> None:
        self.values: dict[str, Rows] = untouched(size, options.observed)
        """Quantities of :class:`batchpid.sim.Observation` in the last tick (size, ...), by name."""

    def begin(self, pack: EnginePack) -> None:
        """Begin a tick."""
        if self.values:
            pack.take_sensed()

    def end(self, pack: EnginePack, substeps: int, failed: Bool) -> None:
        """Take the means over a tick of ``substeps`` sim steps, 0 for ``failed`` envs (size,)."""
        sums = pack.take_sensed() if self.values else {}
        for name, rows in sums.items():
            values = self.values[name]
            if values.dtype == bool:
                values[...] = rows > 0
            else:
                values[...] = rows / substeps
            values[failed] = 0

    def clear(self, mask: Bool) -> None:
        """Set the values of the envs of ``mask`` (size,) to 0."""
        for values in self.values.values():
            values[mask] = 0


class Pushes:
    """Pushes of ``size`` envs at random times, if the randomization of ``options`` has some.

    A push comes at the beginning of the first tick after its time, at most one in a tick.
    """

    def __init__(self, options: RunnerOptions, size: int) -> None:
        self._options = options
        names = COUNTS if options.has_pushes else ()
        self.counts: dict[str, Int64] = {name: np.zeros(size, np.int64) for name in names}
        """Counts of each env (size,), by name of :data:`COUNTS`; empty without pushes."""

    def begin(self, mask: Bool, episodes: Int64) -> None:
        """Begin the episodes (envs, 2) of the envs of ``mask`` (envs,)."""
        for counts in self.counts.values():
            counts[mask] = 0
        self._take(np.flatnonzero(mask), episodes)

    def due(self, suspended: Bool, episodes: Int64) -> tuple[list[int], Float64]:
        """Return the envs that are pushed now, and the changes of their twists (n, 6)."""
        rows = np.flatnonzero((self.counts["steps"] >= self.counts["due"]) & ~suspended)
        if rows.size:
            twists = self._draw("push", rows, episodes)
        else:
            twists = np.zeros((0, 6))
        self.counts["number"][rows] += 1
        self._take(rows, episodes)
        return rows.tolist(), twists

    def _take(self, rows: NDArray[np.intp], episodes: Int64) -> None:
        """Set the time of the next push of envs ``rows``."""
        if self.counts and rows.size:
            intervals = self._draw("push_interval", rows, episodes)[:, 0]
            steps = np.ceil(np.minimum(intervals / self._options.timestep, 2.0**53))
            self.counts["due"][rows] += steps.astype(np.int64)

    def _draw(self, name: str, rows: NDArray[np.intp], episodes: Int64) -> Float64:
        randomization = self._options.randomization
        assert randomization is not None
        return randomization.next_push(
            name, self._options.robot, episodes[rows], self.counts["number"][rows]
        )
