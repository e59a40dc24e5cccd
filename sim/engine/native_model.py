r"""Rigid-body model of robots in native code: mass matrices and passive forces, also within the sim steps of a tick.

Mass matrices come from composite rigid bodies (:mod:`batchpid.sim.engine.rigid_body`), passive forces from the
recursive Newton-Euler algorithm (:mod:`batchpid.sim.engine.batch_dynamics`). On a floating base (b; j are the joints)
the joints show the Schur complements::

    M = M_jj - M_jb M_bb^-1 M_bj        h = h_j - M_jb M_bb^-1 h_b

in which gravity, and the velocity and acceleration of the base's origin, cancel: h depends on the rate at which the
base turns.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import SHARE, Friction, FrictionState
from batchpid.sim.engine import native
from batchpid.sim.engine.engines import scene_dynamics
from batchpid.sim.engine.native.interface import Model, Refresh
from batchpid.sim.engine.protocol import CompiledModel, RobotModel
from batchpid.sim.engine.rigid_body import RigidBodies
from batchpid.sim.engine.scene_spec import SceneSpec


class NativeModel:
    """Model of the robots of ``spec``, on a base that ``floats``, or is held."""

    def __init__(self, spec: SceneSpec, floats: bool = False) -> None:
        self._spec, self._floats, self._native = spec, floats, native.extension("_gateway")
        self._inertias: Float64 | None = None

    @cached_property
    def bodies(self) -> RigidBodies:
        """Bodies of the robot, without differences of the masses."""
        return scene_dynamics(self._spec).bodies

    @cached_property
    def _structure(self) -> tuple[Model, Any]:
        bodies = self.bodies
        tree, rows = np.ascontiguousarray(bodies.tree, np.int32), np.ascontiguousarray(bodies.table())
        inertias = bodies.inertias()[None] if self._inertias is None else self._inertias
        arrays: dict[str, NDArray[Any]] = {"tree": tree, "rows": rows, "inertias": inertias}
        addresses = {name: array.ctypes.data for name, array in arrays.items()}
        numbers = {"dof": len(tree), "varies": self._inertias is not None, "floats": self._floats}
        return Model(gravity=self._spec.gravity, **numbers, **addresses), arrays

    @property
    def address(self) -> int:
        """Address of the model, for structures of the extension."""
        return ctypes.addressof(self._structure[0])

    def vary(self, rows: Sequence[int], size: int, added: Mapping[str, Float64]) -> None:
        """Add spatial inertias (size, 6, 6) to links, by name, of the robots ``rows`` of ``size`` in place.

        They are :func:`batchpid.task_space.spatial_inertia.spatial_matrix`, in the axes of the links.
        """
        if self._inertias is None:
            self.__dict__.pop("_structure", None)
            self._inertias = np.tile(self.bodies.inertias(), (size, 1, 1))
        picked = np.asarray(rows, np.intp)
        self._inertias[picked] = self.bodies.varied({name: each[picked] for name, each in added.items()})

    def mass_matrix(self, qpos: NDArray[Any]) -> Float64:
        """Return the mass matrices (n, dof, dof) [kg m^2 or kg] that the joints show at ``qpos`` (n, dof)."""
        rows = np.ascontiguousarray(qpos, np.float64)
        out = np.empty((*rows.shape, rows.shape[1]))
        self._native.joint_matrices(self.address, rows, out, len(rows))
        return out

    def passive_force(
        self, qpos: Float64, qvel: Float64, gravity: bool, coriolis: bool, turning: Float64 | None = None
    ) -> Float64:
        """Return the efforts (n, dof) [N m or N] that cancel gravity, and Coriolis and centrifugal forces.

        A floating base turns at ``turning`` (n, 3) [rad/s], in its own axes.
        """
        state = [None if each is None else np.ascontiguousarray(each, np.float64) for each in (qpos, qvel, turning)]
        out = np.empty(qpos.shape)
        self._native.forces(self.address, gravity, coriolis, *state, out, len(out))
        return out


class NativeRefresh:
    """:func:`batchpid.motors.friction.refresh` of a group of envs, with the joints' mass matrices, in native code.

    Parameters
    ----------
    model
        Model of the robots, with their differences.
    size
        Number of envs M.
    armature
        Reflected inertia of the motors (1 | M, dof) [kg m^2 or kg].
    friction, drive
        Friction, and damping and stiffness of the engine's drives, each (1 | M, dof).
    coupling
        Coupling of the joints.
    timestep
        [s]
    steps
        Sim steps between two updates.
    """

    def __init__(
        self,
        model: CompiledModel,
        size: int,
        armature: Float64,
        friction: Friction,
        drive: tuple[Any, Any],
        coupling: Coupling,
        timestep: float,
        steps: int,
    ) -> None:
        self._native = native.extension("_gateway")
        shape = (size, armature.shape[1])
        viscous = 0.0 if friction.viscous is None else friction.viscous
        named = {"armature": armature, "coulomb": friction.coulomb, "viscous": viscous}
        named |= dict(zip(("damping", "stiffness"), drive, strict=True))
        arrays = {name: np.array(np.broadcast_to(rows, shape), np.float64, order="C") for name, rows in named.items()}
        arrays |= coupling.native()
        addresses = {name: array.ctypes.data for name, array in arrays.items()}
        self._structure = Refresh(model=model.address, timestep=timestep, share=SHARE, steps=steps, **addresses)
        self._kept = model, arrays

    @property
    def address(self) -> int:
        """Address of the constants, for a tick of the extension."""
        return ctypes.addressof(self._structure)

    def __call__(self, state: FrictionState, qpos: Float64) -> FrictionState:
        """Return ``state`` with its factors at ``qpos`` (M, dof)."""
        factors = np.empty(qpos.shape), np.empty(qpos.shape)
        self._native.refresh(self.address, np.ascontiguousarray(qpos, np.float64), *factors, len(qpos))
        return state._replace(gain=factors[0], memory=factors[1])


def mass_matrix_of(spec: SceneSpec, natively: bool) -> Callable[[Float64], Float64]:
    """Return the function of positions that computes the mass matrices of a robot's description, on a fixed base.

    ``natively`` says whether the extension is used; then every executor takes them from it, since Pinocchio's differ in
    the last bits.
    """
    if natively:
        return NativeModel(spec).mass_matrix
    model = _model_of(spec)
    return lambda qpos: model().mass_matrix(qpos)


def passive_force_of(spec: SceneSpec, natively: bool) -> Callable[[Float64, Float64, bool, bool], Float64]:
    """Return the function of positions, velocities, gravity and coriolis that computes a robot's passive forces.

    The base is held. ``natively`` says whether the extension is used; then every executor takes them from it, since the
    engines' differ in the last bits.
    """
    if natively:
        return NativeModel(spec).passive_force
    model = _model_of(spec)
    return lambda qpos, qvel, gravity, coriolis: model().passive_force(qpos, qvel, gravity, coriolis)


def _model_of(spec: SceneSpec) -> Callable[[], RobotModel]:
    """Return a function that returns the model of ``spec``, looked up once: the hash of a spec takes many calls."""
    return cache(lambda: scene_dynamics(spec))
