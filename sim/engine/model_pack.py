"""Base class of the engines' packs: models of the robots, and friction and armature of their
joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.errors import SingleOwner
from batchpid.motors import Actuators
from batchpid.sim.engine.coupled_joints import ConstraintEfforts
from batchpid.sim.engine.native_model import NativeModel, passive_force_of
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.engine.scene_spec import (
    SceneSpec,
    Variation,
    VariedMasses,
    added_friction,
    own_friction,
)
from batchpid.task_space.rigid_tree import RigidTree

BASE_AT_REST = np.array([0.0, 0.0, 0.0, 1.0, *9 * [0.0]])
"""Pose and twist of a base at rest at the origin."""


class ModelPack(EnginePack, SingleOwner):
    """Pack of ``size`` robots of ``spec``, numbered from ``first_env``, with mass matrices and
    forces from its model.

    ``variation`` holds the robots' differences from the model, one row for each. ``natively``
    selects native code.
    """

    @property
    def rigid_tree(self) -> RigidTree:
        """Tree of the model; SAPIEN's own is another."""
        return self.spec.rigid_tree

    def __init__(
        self,
        spec: SceneSpec,
        size: int,
        first_env: int,
        variation: Variation | None,
        natively: bool,
    ) -> None:
        self.spec = spec
        self.size = size
        self.first_env = first_env
        self.steps_natively = natively
        self.dof, self._variation = len(spec.joints), variation or Variation()
        self._masses = VariedMasses(spec, size, self._variation)
        self._suspended: Bool = np.zeros(size, bool)
        self.content = np.zeros(0, np.int64)
        self.friction = own_friction(spec, self._variation)
        armature = self._variation.armature  # vary() changes its rows
        self.armature = self._motors = np.zeros((1, self.dof)) if armature is None else armature
        self._constraint: ConstraintEfforts | None = None

    @property
    def _is_model(self) -> bool:
        """Whether the robots have the masses and the gravity of the model."""
        return not self._masses.added and self._variation.gravity is None

    @cached_property
    def joint_model(self) -> NativeModel:
        """Native model of :meth:`joint_mass_matrix`."""
        model = NativeModel(self, "fixed" if self.spec.fixed_base else "free")
        if self._masses.added:
            model.vary(range(self.size), self.size, self._masses.added)
        return model

    @cached_property
    def force_model(self) -> NativeModel:
        """Native model of the passive force, for compiled steps that do not read it in the
        engine.
        """
        return NativeModel(self, "fixed" if self.spec.fixed_base else "held")

    def joint_mass_matrix(self, qpos: Rows) -> Float64:
        """Return the mass matrices of the joints at ``qpos`` (M, dof, dof) [kg m^2 or kg]; a
        floating base moves with them.
        """
        if self.steps_natively:
            return self.joint_model.mass_matrix(qpos)
        added = self._masses.added
        return ts.mass_matrix(
            self.rigid_tree, qpos, self.rigid_tree.varied(added) if added else None
        )

    @cached_property
    def _passive_force(self) -> Callable[..., Float64]:
        return passive_force_of(self, self.steps_natively)

    def _model_force(self, gravity: bool, coriolis: bool) -> Float64:
        """Return the passive force, computed from the model."""
        state = self.read_qpos(), self.read_qvel(), gravity, coriolis, self.read_base_motion()
        return self._passive_force(*state)

    @property
    def _constraint_address(self) -> int | None:
        return None if self._constraint is None else self._constraint.address

    def _change(self, rows: Sequence[int], variation: Variation) -> None:
        """Set the differences of the robots ``rows`` from the model, in the fields that vary."""
        for mine, new in zip(self._variation, variation, strict=True):
            if mine is not None:
                mine[rows] = new

    def _change_model(self, rows: Sequence[int]) -> None:
        """Update the masses of the robots ``rows`` in the native code's model."""
        if self._masses.added and "joint_model" in self.__dict__:
            self.joint_model.vary(rows, self.size, self._masses.added)

    def _add_joints(self, actuators: Actuators | None) -> Float64:
        """Set friction and armature of ``actuators``; return the inertia that the engine has to add
        to the joints.
        """
        self.friction = added_friction(own_friction(self.spec, self._variation), actuators)
        added = None if actuators is None else actuators.armature
        self.armature = self._motors + (0.0 if added is None else added)
        viscous = self.friction.viscous
        implicit: Float64 = self.armature + self.spec.timestep * (
            0.0 if viscous is None else viscous
        )
        if self._constraint is not None:
            self._constraint.implicit[...] = implicit
        return implicit
