"""Interface of the physics engines to the loop, the robots and the tuning.

The loop holds the M envs of a group as one :class:`EnginePack`. Robots, controls and tuning use a
:class:`batchpid.sim.robot.robot_model.RobotModel`. :func:`load_engine` returns an :class:`Engine`
by its name, which makes packs; the engine's packages are imported at its first use.

A feature of only some engines is a capability. :func:`require` raises an error if the engine lacks
it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from sys import modules
from typing import Any, Literal

import numpy as np

from batchpid.arrays.array_types import Bool, Float32, Float64, Rows
from batchpid.checks import choice
from batchpid.errors import InvalidArgumentError, MissingDependencyError, SingleOwner
from batchpid.io.files import imported
from batchpid.motors import Actuators
from batchpid.sim.description.merging import coupling_of
from batchpid.sim.engine.coupled_joints import ConstraintEfforts
from batchpid.sim.engine.native_model import NativeModel, NativeStep, TreeModel
from batchpid.sim.engine.scene_spec import (
    SceneSpec,
    Variation,
    VariedMasses,
    added_friction,
    own_friction,
)
from batchpid.sim.findings import Finding
from batchpid.task_space.rigid_tree import RigidTree

Capability = Literal["build", "wrenches", "base_state", "complete_state", "sapien_dissipation"]
"""
- ``"build"``: the user's function ``build`` adds content to scenes;
- ``"wrenches"``: links sense the wrench of their parent;
- ``"base_state"``: compiled steps read state and passive force of robots on a floating base;
- ``"complete_state"``: :meth:`EnginePack.read_state` holds everything that later steps depend on, so
  that a pack in use can be restored, and a snapshot changes no bit;
- ``"sapien_dissipation"``: SAPIEN's own friction and damping in place of the URDF's.
"""


BASE_AT_REST = np.array([0.0, 0.0, 0.0, 1.0, *9 * [0.0]])
"""Pose and twist of a base at rest at the origin."""


class EnginePack(SingleOwner, ABC):
    """M envs with a robot of ``spec`` each, numbered from ``first_env``, read and written as arrays
    (M, dof), in the order of its joints, SI units.

    ``variation`` holds the robots' differences from the model, one row for each.

    A method that returns an array returns a new one. The motion of an env depends on its own rows
    only, not on other envs of the pack or their number.

    Attributes
    ----------
    size, dof
        Number of envs M, and of joints.
    first_env
        Number of the first env within the runner.
    qf
        Efforts last written, in the engine's precision, without the engine's constraint efforts of
        coupled joints.
    friction
        Friction and damping that the loop has to apply to the joints; None where the engine applies
        them.
    armature
        Reflected inertia of the motors (1 | M, dof) [kg m^2 or kg], not included in
        :attr:`joint_model`.
    steps_natively
        Whether native code does the sim steps, by :meth:`compiled_step`.
    calls
        Object that is replaced when earlier results of :meth:`compiled_step` become invalid.
    """

    qf: Rows
    calls: object

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
        self.friction = own_friction(spec, self._variation)
        armature = self._variation.armature  # vary() changes its rows
        self.armature = self._motors = np.zeros((1, self.dof)) if armature is None else armature
        self._constraint: ConstraintEfforts | None = None

    @property
    def _is_model(self) -> bool:
        """Whether the robots have the masses and the gravity of the model."""
        return not self._masses.added and self._variation.gravity is None

    def _model(self, base: str) -> Any:
        """Return a model of the robots; native where calls are, since NumPy's differs in the last
        bits.
        """
        kind = NativeModel if self.steps_natively else TreeModel
        return kind(lambda: self.rigid_tree, "fixed" if self.spec.fixed_base else base)

    @property
    def rigid_tree(self) -> RigidTree:
        """Tree of the robot as the engine has it, all joints independent."""
        return self.spec.rigid_tree

    @cached_property
    def joint_model(self) -> Any:
        """Model of the present robots, :class:`.TreeModel`; a floating base moves with the
        joints.
        """
        model = self._model("free")
        if self._masses.added:
            model.vary(range(self.size), self._masses.added)
        return model

    @cached_property
    def force_model(self) -> Any:
        """Model of ``spec`` alone, :class:`.TreeModel`, on a base that is held."""
        return self._model("held")

    def _force(self, model: TreeModel, gravity: bool, coriolis: bool) -> Float64:
        """Return the passive force of a model at the present state."""
        state = self.read_qpos(), self.read_qvel(), gravity, coriolis, self.read_base_motion()
        return model.passive_force(*state)

    def _couple(self, wraps: Bool, force: TreeModel | None, asked: Float32 | None = None) -> None:
        """Make the constraint efforts, if joints are coupled: see :class:`.ConstraintEfforts`."""
        coupling = coupling_of(self.spec.joints)
        if coupling.is_identity:
            return
        self._constraint = ConstraintEfforts(
            self.size,
            coupling,
            wraps,
            self.spec.timestep,
            self.joint_model,
            force,
            asked,
        )
        self._add_joints(None)

    def update_constraint(self, rows: Sequence[int] | slice = slice(None)) -> None:
        """Update the mass matrix in the constraint efforts of robots ``rows``, if joints are
        coupled.
        """
        if self._constraint is not None:
            self._constraint.update(self.read_qpos(), self._bias(), rows)

    @property
    def _constraint_address(self) -> int | None:
        return None if self._constraint is None else self._constraint.address

    def _change(self, rows: Sequence[int], variation: Variation) -> None:
        """Set the differences of the robots ``rows`` from the model, in the fields that vary."""
        for mine, new in zip(self._variation, variation, strict=True):
            if mine is not None:
                mine[rows] = new

    def _change_model(self, rows: Sequence[int]) -> None:
        """Update the masses of the robots ``rows`` in the model."""
        if self._masses.added:
            self.joint_model.vary(rows, self._masses.added)

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

    # What each engine does in its own way.

    @abstractmethod
    def read_qpos(self) -> Float64:
        """Return the joint positions [rad or m]."""

    @abstractmethod
    def read_qvel(self) -> Float64:
        """Return the joint velocities [rad/s or m/s]."""

    @abstractmethod
    def passive_force(self, gravity: bool, coriolis: bool) -> Float64:
        """Return the efforts that cancel gravity and Coriolis and centrifugal forces [N m or N].

        They come from the model of ``spec`` at the present state, without the pack's variation. On
        a floating base they are computed as if the base were fixed: no effort of a joint carries
        the base.
        """

    @abstractmethod
    def write_qf(self, effort: Rows) -> None:
        """Apply joint efforts [N m or N]. They persist until written again."""

    @abstractmethod
    def _bias(self) -> Float64:
        """Return the forces in the equations of motion of the joints (M, dof), for the constraint
        efforts.
        """

    @abstractmethod
    def step(self) -> None:
        """Do one sim step of every env, with the constraint efforts of the last
        :meth:`update_constraint`.

        A non-finite state raises no error: the loop detects it in its next reading.
        """

    @abstractmethod
    def read_base(self) -> Float64:
        """Return pose and twist of floating bases in the world (M, 13), a new array: those of the
        root link's origin.

        Position [m], quaternion (w, x, y, z), linear and angular velocity [m/s, rad/s].
        """

    @abstractmethod
    def read_base_motion(self) -> Float64 | None:
        """Return gravity and the rate at which floating bases turn [m/s^2, rad/s], both in their
        own axes (M, 6).

        Gravity is that of ``spec``. None for fixed bases.
        """

    @abstractmethod
    def push(self, rows: Sequence[int], twists: Float64) -> None:
        """Add ``twists`` (len(rows), 6) [m/s, rad/s] to those of floating bases, as
        :meth:`read_base` has them.
        """

    @abstractmethod
    def take_sensed(self, steps: int) -> dict[str, Rows]:
        """Return the means of the link sensors over the last ``steps`` sim steps, all since the
        last call, or, of contacts in SAPIEN, their values in the last one.

        ``contact_force`` (M, links, 3), ``touching`` (M, links), 0 without a contact, and
        ``wrench`` (M, links, 6), as :class:`batchpid.sim.Observation` describes them; of robots
        that were placed meanwhile, since then.
        """

    @abstractmethod
    def write_state(
        self,
        rows: Sequence[int],
        qpos: Rows,
        qvel: Rows,
        base: Float64 | None = None,
    ) -> None:
        """Set positions and velocities (len(rows), dof) of the envs ``rows``, and zero efforts.

        A floating base is placed at ``base`` (len(rows), 13), as :meth:`read_base` returns it; None
        is the origin.

        Content of these envs returns to its start. An env whose state was not finite can be used
        again.
        """

    @abstractmethod
    def suspend(self, mask: Bool) -> None:
        """Apply zero effort and no gravity to the robots of ``mask`` (M,); restore both for the
        others.
        """

    @abstractmethod
    def write_joints(self, actuators: Actuators | None, rows: Sequence[int] | None = None) -> None:
        """Add friction, damping and reflected inertia of ``actuators`` to the description's, for
        ``rows`` or all.
        """

    @abstractmethod
    def vary(self, rows: Sequence[int], variation: Variation) -> None:
        """Change the robots ``rows`` to ``variation``, one row for each, in a pack that was made
        with a variation.

        Next the loop calls :meth:`write_joints` and :meth:`write_state` for them.
        """

    @abstractmethod
    def read_state(self) -> Float64:
        """Return the state of every env (M, values) for a snapshot; only the engine can interpret
        it.

        A row determines all later steps of a new pack. Values beyond the size of its env are NaN.
        """

    @abstractmethod
    def write_state_rows(self, states: Float64) -> None:
        """Put all envs into the states that :meth:`read_state` returned. Incomplete states need a
        new pack.

        Rows may be longer, with more NaN at the end. The loop writes efforts and suspension
        afterwards.
        """

    @abstractmethod
    def read_poses(self, names: Sequence[str] | None = None) -> list[Rows]:
        """Return the poses of the entities that ``build`` returned in each env (poses, 7): x, y, z
        [m], quaternion w, x, y, z.

        With ``names``, those of these bodies of the file of ``spec``, in float64.
        """

    @abstractmethod
    def strays(self) -> Bool:
        """Return the envs (M,) with a floating base, or an object of a file, that is not finite or
        beyond FARTHEST.
        """

    # The drives of the joints: PD control that the engine integrates implicitly.

    @abstractmethod
    def write_drive(self, stiffness: Rows, damping: Rows, force_limit: Rows) -> None:
        """Set the drive of every joint; each argument broadcasts to (M, dof) [N m/rad, N m s/rad, N
        m, or N/m, ...].
        """

    @abstractmethod
    def write_drive_target(self, position: Rows, velocity: Rows | None = None) -> None:
        """Set the drives' targets (M, dof): position [rad or m] and velocity [rad/s or m/s], by
        default 0.
        """

    # Sim steps in native code, where they are native.

    @abstractmethod
    def steps_read_force(self, gravity: bool, coriolis: bool) -> bool:
        """Return whether a compiled step reads this part of the passive force; otherwise call
        :meth:`passive_force`.
        """

    @abstractmethod
    def compiled_step(self, gravity: bool, coriolis: bool, drives: bool = False) -> NativeStep:
        """Return the sim step of the present robots.

        ``gravity`` and ``coriolis`` select the parts of the passive force that it reads; without
        both it is zero. With ``drives`` the targets of the drives may move within a tick.
        """

    @abstractmethod
    def close(self) -> None:
        """Free the envs. The pack cannot be used afterwards."""


def _nothing(spec: SceneSpec) -> Iterator[Finding]:
    """Yield the limits of an engine that has none: nothing."""
    return iter(())


@dataclass
class Engine:
    """Physics engine: it makes packs of robots."""

    name: str
    """Value of the option ``engine``."""
    title: str
    """Name of the library in messages."""
    capabilities: frozenset[Capability]
    """Its optional features."""
    physics: Mapping[str, Any]
    """Settings of its solver, frozen dataclasses of plain values, by the name of the preset."""
    group_size: int
    """Envs that the loop steps together in native code: few enough for the working set to stay in
    the cache. It changes no result.
    """
    make_pack: Callable[..., EnginePack]
    """``make_pack(spec, size, first_env=0, variation=None, workspace=None)`` returns a new pack of
    ``size`` envs.

    ``variation`` are differences of the robots from the model; None for robots that
    :meth:`EnginePack.vary` never changes. ``workspace`` is a dictionary for the working memory,
    shared by packs that never step at the same time, such as the packs of a loop. None: the pack
    allocates its memory. Raises RobotError if the engine cannot build the robot, and
    InvalidArgumentError if the function ``build`` of the spec is wrong.
    """
    native_obstacle: Callable[[], str]
    """Reason for which native code cannot call the engine, in a sentence; "" if it can."""
    refusals: Callable[[SceneSpec], Iterator[Finding]] = _nothing
    """Yields what of a scene it cannot run at all."""
    shortfalls: Callable[[SceneSpec], Iterator[Finding]] = _nothing
    """Yields what of a scene it runs otherwise than the robot's file says."""

    def is_physics(self, settings: object) -> bool:
        """Return whether ``settings`` are settings of its solver."""
        return isinstance(settings, type(self.physics["accurate"]))


def require(engine: Engine, capability: Capability, argument: str) -> None:
    """Raise InvalidArgumentError for ``argument`` if ``engine`` lacks ``capability``, which the
    other one has.
    """
    if capability not in engine.capabilities:
        problem = f"needs the capability {capability!r}, which engine {engine.name!r} does not have"
        other = next(name for name in MODULES if name != engine.name)
        raise InvalidArgumentError(
            argument, problem, remedy=f"omit it, or use the engine {other!r}"
        )


MODULES = {
    "sapien": "batchpid.sim.engine.sapien.pack",
    "mujoco": "batchpid.sim.engine.mujoco.mujoco_pack",
}
"""Module of each engine by name. Its constant ENGINE is the :class:`Engine`."""


def load_engine(name: str) -> Engine:
    """Return an engine.

    Raises
    ------
    InvalidArgumentError
        No engine has this name, or SAPIEN is not installed.
    MissingDependencyError
        MuJoCo is too old.
    """
    # Engines are imported at their first use: one of them need not be installed.
    module = MODULES[choice("engine", name, MODULES)]
    if name == "mujoco" and module not in modules:
        _require_mujoco()
    if name == "sapien" and module not in modules and find_spec("sapien") is None:
        problem = "is not installed: SAPIEN is for Linux on x86-64"
        raise InvalidArgumentError("engine", problem, value=name, remedy="use 'mujoco'")
    engine: Engine = imported(module).ENGINE
    return engine


def _require_mujoco() -> None:
    try:
        # A module that came with the oldest version that has all that is used here.
        imported("mujoco.batch")
    except ImportError as error:
        raise MissingDependencyError("mujoco>=3.17", "the engine 'mujoco'") from error
