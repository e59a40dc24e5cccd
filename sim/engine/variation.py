"""Robots that differ from the model, env by env: payload, joint friction, quantized sensors, delayed efforts.

Compensation and mass matrix stay those of the unloaded robot, because a controller does not know its payload.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.friction import Friction
from sim.engine.building import SceneSpec, add_point_mass, center_of_mass
from sim.engine.dynamics import scene_dynamics
from sim.engine.pack import Pack
from sim.robot.mimics import coupling_of

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Variation:
    """Differences of each env's robot from the model."""

    payload: Float64
    """Mass added at the center of mass of ``link`` (envs,) [kg]."""
    friction: Float64
    """Coulomb friction added to every joint (envs,) [N m or N]."""
    link: str
    """Name of the link that carries the payload."""
    resolution: float = 0.0
    """Step of the position sensors [rad or m], 0 for none."""
    late: bool = False
    """True to apply every effort one sim step after it was computed."""

    def for_envs(self, envs: slice | Any) -> Variation:
        """Return the variation of some envs (a slice or an index array)."""
        return Variation(self.payload[envs], self.friction[envs], self.link, self.resolution, self.late)


class VariedPack(Pack):
    """Pack whose robots differ from the model by ``variation``, one entry for each of its scenes."""

    def __init__(self, spec: SceneSpec, size: int, first_env: int, system_size: int, variation: Variation) -> None:
        self._variation, self._model, self._resolution = variation, scene_dynamics(spec), variation.resolution
        self._carrier = center_of_mass(spec, variation.link)
        super().__init__(spec, size, first_env, system_size)
        self._pending = np.zeros((size, self.dof)) if variation.late else None

    def _build(self, row: int, system: Any) -> tuple[Any, Any]:
        """Return a new scene and the robot in it, with its payload."""
        scene, robot = super()._build(row, system)
        variation = self._variation
        body, center = self._carrier
        for link in robot.links:
            if link.name == body:
                add_point_mass(link, float(variation.payload[row]), center)
        return scene, robot

    def _friction(self) -> Friction:
        """Return the friction of the joints, with what is added."""
        coupling = coupling_of(self.spec.joints)
        where = np.ones(self.dof) if coupling is None else coupling.independent  # the coupling moves the others
        model, added = super()._friction(), self._variation.friction[:, None] * where
        return model._replace(coulomb=added if model.coulomb is None else added + model.coulomb)

    def read_qpos(self, dtype: Any = np.float64) -> NDArray[Any]:
        """Return the joint positions as the sensors measure them."""
        qpos = super().read_qpos(dtype)
        return qpos if self._resolution == 0 else (np.rint(qpos / self._resolution) * self._resolution).astype(dtype)

    def passive_force(self, gravity: bool, coriolis: bool, dtype: Any = np.float64) -> NDArray[Any]:
        """Return the passive force of the unloaded robot's model at the measured positions."""
        qpos, still = self.read_qpos(), np.zeros((self.size, self.dof))
        qvel = self.read_qvel() if coriolis else still
        force = self._model.inverse_dynamics(qpos, qvel, still)
        if coriolis and not gravity:
            force = force - self._model.inverse_dynamics(qpos, still, still)
        return force.astype(dtype)

    def delivered(self, effort: NDArray[Any]) -> NDArray[Any]:
        """Return these efforts, or those of the step before where they are late."""
        if self._pending is not None:
            effort, self._pending = self._pending, np.array(effort, np.float64)
        return effort

    def write_state(self, rows: Sequence[int], *state: Any) -> None:
        """Place robots; their pending efforts are dropped."""
        super().write_state(rows, *state)
        if self._pending is not None:
            self._pending[list(rows)] = 0.0
