"""Friction and damping of the joints of a pack: the model of :mod:`batchpid.friction` in the loop."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid import friction
from sim.engine.dynamics import scene_dynamics
from sim.engine.pack import Pack

Float64 = NDArray[np.float64]

REFRESH_STEPS = 64
"""Sim steps for which the joints' inertia is kept: its half would do, so 32 ms are short for the motion of an arm."""


class JointFriction:
    """Friction model of the M joints of ``pack``; it owns the model's state.

    Attributes
    ----------
    acts
        Whether there is any friction or damping to apply.
    """

    def __init__(self, pack: Pack) -> None:
        self._pack, self._model = pack, pack.friction
        self.acts = any(leaf is not None for leaf in self._model)
        self._state = friction.FrictionState()
        self._drive: tuple[Any, Any] = (0.0, 0.0)
        self.reset(np.ones(pack.size, bool))

    def set_drive(self, damping: Any, stiffness: Any) -> None:
        """Set damping and stiffness of the engine's drives, (1, dof) or (M, dof), from the next refresh on."""
        self._drive = damping, stiffness

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Reset the envs of ``mask`` (M,), which were placed."""
        if self._model.coulomb is None:
            return
        pack = self._pack
        velocity, load = pack.read_qvel(), pack.passive_force(True, True)
        fresh = friction.init(self._model, velocity, load, self._mass_matrix(), pack.spec.timestep, *self._drive)
        self._state = fresh if self._state.effort is None else friction.reset(self._state, fresh, mask)

    def effort(self, motor: Float64, qvel: Float64, step: int) -> Float64:
        """Return the efforts to apply in sim step ``step``, counted from the start of the runner (M, dof)."""
        if step % REFRESH_STEPS == 0 and self._model.coulomb is not None:
            timestep = self._pack.spec.timestep
            self._state = friction.refresh(self._model, self._state, self._mass_matrix(), timestep, *self._drive)
        self._state, total = friction.advance(self._model, self._state, motor, qvel)
        return total

    def read(self) -> dict[str, NDArray[Any]]:
        """Return the state of the model by name, for :meth:`write`."""
        return {name: leaf for name, leaf in self._state._asdict().items() if leaf is not None}

    def write(self, state: dict[str, NDArray[Any]]) -> None:
        """Set the state of the model."""
        self._state = friction.FrictionState(**state)

    def _mass_matrix(self) -> Float64:
        return scene_dynamics(self._pack.spec).mass_matrix(self._pack.read_qpos())
