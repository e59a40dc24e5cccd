"""Functions of the robots' model that the control step calls: mass matrices, passive force, noise
of sensors.

They are natively compiled where the engine's steps are, for every executor alike, since NumPy's
results differ in the last bits.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Float64
from batchpid.motors import ActuatorState, MotorCoefficients, measurement_noise
from batchpid.sim.engine.native_model import NativeRefresh, mass_matrix_of, passive_force_of
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.control_step import REFRESH_STEPS
from batchpid.sim.loop.custom import OwnController
from batchpid.sim.loop.step_values import Constants, Layout, Model


def model_functions(
    pack: EnginePack, layout: Layout, constants: Constants, controller: OwnController | None
) -> Model:
    """Return the functions for NumPy arrays of the robots of ``pack``."""
    native = pack.steps_natively
    model = Model(
        mass_matrix=mass_matrix_of(pack, native),
        joint_mass_matrix=partial(_joint_mass_matrix, pack),
        controller=controller,
        noise=NoiseBlocks(),
    )
    if layout.gravity:
        force = passive_force_of(pack, native)
        parts = layout.gravity, layout.coriolis
        model = model._replace(
            passive_force=lambda qpos, qvel: force(qpos, qvel, *parts, pack.read_base_motion())
        )
    if not native:
        return model
    if constants.friction.coulomb is not None:
        inputs = constants.friction, constants.drive, constants.coupling, constants.timestep
        refresh = NativeRefresh(pack.joint_model, pack.size, pack.armature, *inputs, REFRESH_STEPS)
        model = model._replace(refresh=refresh)
    return model


def _joint_mass_matrix(pack: EnginePack, qpos: Float64) -> Float64:
    """Return the effective mass matrix of the joints, armature of the motors included."""
    matrix = pack.joint_mass_matrix(qpos)
    if pack.armature.any():
        return matrix + pack.armature[:, None] * np.eye(pack.dof)
    return matrix


BLOCK = 64
"""Sim steps of a block."""


class NoiseBlocks:
    """:func:`batchpid.motors.measurement_noise` at the step of a state, from blocks of consecutive
    steps.
    """

    def __init__(self) -> None:
        self._key: Any = None
        self._first = 0
        self._block: tuple[Array, Array] = (None, None)

    def __call__(
        self, k: MotorCoefficients, state: ActuatorState, like: Float64
    ) -> tuple[Array, Array]:
        """Return the noise of positions and velocities; None for a sensor without noise."""
        position, velocity = self.from_step(k, state, like)
        return (
            None if position is None else position[0],
            None if velocity is None else velocity[0],
        )

    def from_step(
        self, k: MotorCoefficients, state: ActuatorState, like: Float64
    ) -> tuple[Array, Array]:
        """Return the noise of the step of a state and the next ones (steps, M, dof), as far as it
        has been drawn.

        A reset replaces the key. While the key is the same, all envs advance by the same number of
        steps.
        """
        if state.key is None:
            return None, None
        at = int(state.step[0]) - self._first
        if state.key is not self._key or not 0 <= at < BLOCK:
            steps = state.step + np.arange(BLOCK, dtype=np.uint32)[:, None]
            self._block = measurement_noise(k, state.key, steps, np.zeros_like(like), np)
            self._key = state.key
            self._first = int(state.step[0])
            at = 0
        position, velocity = self._block
        return (
            None if position is None else position[at:],
            None if velocity is None else velocity[at:],
        )
