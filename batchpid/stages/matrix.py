"""Mass matrix for the law."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace
from batchpid.motors.coupling import Coupling
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values

MASS_MATRIX_STEPS = 4
"""Sim steps for which a mass matrix is kept within a tick.

The implicit law takes a fresh one in each: in setpoint steps at w dt = 1 panda diverges with a
matrix kept for 4 steps, at w dt = 3 with one kept for 2.
"""


@dataclass(frozen=True)
class Matrix(Stage):
    """M = M(y) + known armature + dt B, for the leaders, half way through the sim steps for which
    it serves.

    The matrix error is then zero on average. With matrices 0.3 steps ahead, a jaco2 that is near
    upright, its axes nearly in line, leaves its path by 18 mrad.
    """

    armature: Array
    damping: Array
    coupling: Coupling
    timestep: Any
    steps: int
    """Sim steps for which a matrix is kept within a tick."""

    name = "matrix"
    native = "mass matrix"
    calls_model = True
    is_brief = True

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if not control.uses_matrix:
            return None
        steps = 1 if control.late else MASS_MATRIX_STEPS
        inputs = control.armature, control.damping, control.coupling
        return cls(*inputs, control.timestep, steps)

    @property
    def every(self) -> int:
        return self.steps

    def init(self, values: Values) -> Told:
        rows, dof = values.measured.qpos.shape
        return np.zeros((rows, dof, dof)), values

    def step(self, state: Array, values: Values) -> Told:
        qpos, qvel, _ = values.seen
        index, end, _ = values.step

        def fresh() -> Array:
            steps = namespace(qpos).minimum(self.steps, end - index).astype(qpos.dtype)
            return self.at(qpos + 0.5 * (steps - 1) * self.timestep * qvel, values)

        state = values.model.when(index % self.steps == 0, fresh, state)
        return state, values._replace(matrix=state)

    def at(self, qpos: Array, values: Values) -> Array:
        """Return the matrix at the pose ``qpos`` (M, dof)."""
        xp = namespace(qpos)
        matrix = values.model.mass_matrix(qpos)
        if self.armature is not None:
            matrix = matrix + xp.diag(self.armature)
        if self.damping is not None:
            matrix = matrix + self.timestep * xp.diag(self.damping)
        return self.coupling.mass_matrix(matrix)

    def bind(self, program: Any, state: Array, values: Values) -> Values:
        tree, bodies = program.pack.rigid_tree.tables
        program.place(pose=values.seen.qpos, rate=values.seen.qvel, tree=tree, bodies=bodies)
        program.place(matrix=state, armature=self.armature, damping=self.damping)
        program.place(**self.coupling.native())
        return values._replace(matrix=state)
