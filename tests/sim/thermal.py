"""A stage of the caller's, with a state, that reads the efforts of the sim step before."""

from dataclasses import dataclass
from typing import Any

from batchpid.stages import Stage


@dataclass(frozen=True)
class Thermal(Stage):
    """w <- w + dt / T ((u / u_c)^2 - w), and |u| <= u_c while w > 1."""

    effort: Any
    """u_c [N m or N]."""
    time: Any
    """T [s]."""

    name = "thermal"
    after = "limits"

    def init(self, values):
        return 0.0 * values.measured.qpos, values

    def step(self, heat, values):
        xp = heat.__array_namespace__()
        load = values.last.motor / self.effort
        heat = heat + (values.timestep / self.time) * (load * load - heat)
        most = xp.where(heat > 1.0, self.effort, xp.inf)
        return heat, values.within(-most, most)
