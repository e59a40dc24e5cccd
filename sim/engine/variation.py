"""Robots that differ from the model, env by env: payload, joint friction, coarse sensors, late efforts.

Compensation and mass matrix stay those of the unloaded robot, because a controller does not know what it will carry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim.engine.building import SceneSpec
from sim.engine.dynamics import Dynamics
from sim.engine.pack import Pack

if TYPE_CHECKING:
    from sapien.wrapper.articulation_builder import ArticulationBuilder

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Variation:
    """How each env's robot differs: ``payload`` [kg] and ``friction`` (PhysX's coefficient), both (envs,).

    The payload is added to the mass of ``link``. ``resolution`` [rad or m] is the position sensor's step, 0 for none;
    ``late`` delays every effort by one sim step.
    """

    payload: Float64
    friction: Float64
    link: str
    resolution: float = 0.0
    late: bool = False

    def for_envs(self, envs: slice | Any) -> Variation:
        """The variation of some envs (a slice or an index array)."""
        return Variation(self.payload[envs], self.friction[envs], self.link, self.resolution, self.late)


class VariedPack(Pack):
    """A pack whose robots differ from the model by ``variation``, one entry for each of its scenes."""

    def __init__(
        self,
        builder: ArticulationBuilder,
        spec: SceneSpec,
        size: int,
        first_env: int,
        system_size: int,
        variation: Variation,
        model: Dynamics,
    ) -> None:
        self._variation, self._model, self._resolution = variation, model, variation.resolution
        super().__init__(builder, spec, size, first_env, system_size)
        self._late = np.zeros((size, self.dof)) if variation.late else None

    def _build(self, row: int, system: Any) -> tuple[Any, Any]:
        """A scene and its robot, with its payload and its friction."""
        scene, robot = super()._build(row, system)
        variation = self._variation
        for link in robot.links:
            if link.name == variation.link:
                link.set_mass(link.mass + float(variation.payload[row]))
        for joint in robot.active_joints:
            joint.set_friction(joint.friction + float(variation.friction[row]))
        return scene, robot

    def read_qpos(self, dtype: Any = np.float64) -> NDArray[Any]:
        """Joint positions as the sensors give them."""
        qpos = super().read_qpos(dtype)
        return qpos if self._resolution == 0 else (np.rint(qpos / self._resolution) * self._resolution).astype(dtype)

    def passive_force(self, gravity: bool, coriolis: bool, dtype: Any = np.float64) -> NDArray[Any]:
        """What the model of the unloaded robot says at the measured positions."""
        qpos, still = self.read_qpos(), np.zeros((self.size, self.dof))
        qvel = self.read_qvel() if coriolis else still
        force = self._model.inverse_dynamics(qpos, qvel, still)
        if coriolis and not gravity:
            force = force - self._model.inverse_dynamics(qpos, still, still)
        return force.astype(dtype)

    def write_qf(self, effort: NDArray[Any]) -> None:
        """Apply efforts, or those of the step before where they are late."""
        if self._late is None:
            super().write_qf(effort)
        else:
            late, self._late = self._late, np.array(effort, np.float64)
            super().write_qf(late)

    def write_state(self, rows: Sequence[int], *state: Any) -> None:
        """Place robots; no effort of theirs is pending."""
        super().write_state(rows, *state)
        if self._late is not None:
            self._late[list(rows)] = 0.0
