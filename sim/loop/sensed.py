"""Sensors of the links of a group of envs, averaged over a tick."""

from __future__ import annotations

from batchpid.arrays.array_types import Bool, Rows
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.arrays import StateRows
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.signals.quantities import untouched


class LinkSensors(StateRows):
    """Quantities of ``size`` envs from the sensors of links, if ``options`` observe some."""

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

    @property
    def state(self) -> dict[str, Rows]:
        """Arrays of the state (M, ...), by name."""
        return self.values
