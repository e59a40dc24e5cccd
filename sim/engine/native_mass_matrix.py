"""Mass matrices of robots on a fixed base, in native code: the composite-rigid-body algorithm of rigid_body.h."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.sim.engine import native
from batchpid.sim.engine.engines import scene_dynamics
from batchpid.sim.engine.scene_spec import SceneSpec


class NativeMassMatrix:
    """Mass matrices of the robot of ``spec``, by the native code that also runs within a tick."""

    def __init__(self, spec: SceneSpec) -> None:
        self._spec, self._native = spec, native.extension("_gateway")

    @cached_property
    def _bodies(self) -> tuple[NDArray[Any], ...]:
        bodies = scene_dynamics(self._spec).bodies
        return np.ascontiguousarray(bodies.tree, np.int32), np.ascontiguousarray(bodies.table())

    def __call__(self, qpos: NDArray[Any]) -> NDArray[np.float64]:
        """Return the mass matrices (M, dof, dof) [kg m^2 or kg] at ``qpos`` (M, dof)."""
        rows = np.ascontiguousarray(qpos, np.float64)
        out = np.empty((*rows.shape, rows.shape[1]))
        self._native.mass_matrices(*self._bodies, rows, out, *rows.shape)
        return out
