r"""Dynamics of many copies of a robot, each with its payload, and time steps of their joints with friction.

Some joints move (``joints``). Each of the others rests, or follows one of them: q_whole = rest + G q, with one entry at
most in a row of G. M is the mass matrix of all joints, and h are their gravity, Coriolis and centrifugal forces. For
the joints that move these are G^T M G and G^T h.

M and h are computed as in :mod:`batchpid.task_space.tree_dynamics`, or by the native extension for all robots at once.

A step of length dt under efforts tau and Coulomb friction of at most F, with D = M + added inertia (diagonal)::

    D (v+ - v) = dt (tau - f),     f in F Sgn(v+ - keep v - creep f),     q+ = q + dt v+

With keep = creep = 0 friction stops a joint at once. The complementarity problem is solved by projected Jacobi sweeps,
from the friction of the step before (M. Anitescu and F. A. Potra, "Formulating dynamic multi-rigid-body contact
problems with friction as solvable linear complementarity problems", Nonlinear Dynamics 14, 1997). Joints stop at their
limits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64
from batchpid.sim.engine import native
from batchpid.sim.engine.native.interface import DYNAMICS, STEP
from batchpid.sim.engine.robot_model import robot_model
from batchpid.sim.robot.description import RobotDescription
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.spatial_inertia import SpatialInertia, spatial_matrix


class Passive(NamedTuple):
    """Dynamics of n robots at their poses."""

    matrix: Float64
    """Mass matrices with the payload (n, joints, joints) [kg m^2 or kg]."""
    force: Float64
    """Gravity, Coriolis and centrifugal forces without the payload (n, joints) [N m or N]."""
    payload_force: Float64
    """The same forces of the payload (n, joints)."""


class Friction(NamedTuple):
    """Coulomb friction of n robots in a step."""

    limit: Float64
    """Largest effort of friction (n, joints) [N m or N]."""
    keep: Float64
    """Share of its velocity that a joint keeps in a step if friction suffices to stop it (n, 1)."""
    creep: Float64
    """Additional velocity of the joint per effort of friction (n, joints)."""


SWEEPS = 2
"""Number of sweeps over the joints in a step."""


def batch_dynamics(robot: RobotDescription, joints: tuple[int, ...]) -> NativeBatchDynamics | NumpyBatchDynamics:
    """Return the dynamics of ``joints`` of ``robot`` on a fixed base: native ones where the extension is used."""
    kind = NumpyBatchDynamics if native.obstacle() else NativeBatchDynamics
    return kind(Loaded.of(robot), MovingJoints.of(robot, joints))


class Loaded(NamedTuple):
    """Tree of a robot on a fixed base, and the place of a payload: the center of mass of its tool."""

    tree: RigidTree
    body: int
    """Body that carries it, -1 for the base."""
    point: Float64
    """Place in the frame of the body (3,) [m]."""

    @classmethod
    def of(cls, robot: RobotDescription) -> Loaded:
        """Return the tree of ``robot``."""
        whole = robot.rigid_tree
        tool = whole.index(whole.tool)
        at = whole.bodies.link_frames[tool]
        return cls(
            robot_model(robot, False).tree.held, whole.link_bodies[tool], at[:, :3] @ whole.center[tool] + at[:, 3]
        )


class MovingJoints(NamedTuple):
    """Joints of a robot that move, and joints that rest or follow them."""

    leader: NDArray[np.int32]
    """Index of each joint's leader (or of itself) among the joints that move (dof,); -1 for a joint that rests."""
    multiplier: Float64
    """Ratio of each joint's speed to its leader's speed (dof,)."""
    rest: Float64
    """Position of each joint when its leader is at 0 (dof,)."""
    low: Float64
    """Lower limits of the joints that move (joints,), -inf for none."""
    high: Float64

    @classmethod
    def of(cls, robot: RobotDescription, joints: tuple[int, ...]) -> MovingJoints:
        """Return ``joints`` of ``robot``; the others rest at the start pose, or follow."""
        number, rest, coupling = np.full(robot.dof, -1, np.int32), robot.start.copy(), robot.coupling
        number[list(joints)], rest[list(joints)] = np.arange(len(joints)), 0.0
        leader = number[coupling.leader]
        multiplier, rest = np.where(leader < 0, 0.0, coupling.multiplier), coupling.positions(rest)
        free = robot.continuous[list(joints)]
        low = np.where(free, -np.inf, robot.lower[list(joints)])
        high = np.where(free, np.inf, robot.upper[list(joints)])
        return cls(leader, multiplier, rest, low, high)

    @property
    def matrix(self) -> Float64:
        """G (dof, joints)."""
        return np.where(self.leader[:, None] == np.arange(len(self.low)), self.multiplier[:, None], 0.0)


class NativeBatchDynamics:
    """Dynamics as of :class:`NumpyBatchDynamics`, computed by the extension."""

    def __init__(self, loaded: Loaded, joints: MovingJoints) -> None:
        self._joints, self._carries = joints, float(loaded.body >= 0)
        self._native = native.extension("_batch_dynamics")
        self._tree = self._native.tree(
            *loaded.tree.tables,
            joints.leader,
            joints.multiplier,
            joints.rest,
            loaded.tree.dof,
            len(joints.low),
            max(loaded.body, 0),
            tuple(loaded.point.tolist()),
            tuple(loaded.tree.bodies.gravity.tolist()),
        )

    def at(self, qpos: Float64, qvel: Float64, payload: Float64) -> Passive:
        """See :meth:`NumpyBatchDynamics.at`."""
        count, joints = qpos.shape
        found = Passive(np.empty((count, joints, joints)), np.empty((count, joints)), np.empty((count, joints)))
        inputs = {"qpos": qpos, "qvel": qvel, "payload": self._carries * payload}
        arrays = {name: np.ascontiguousarray(rows) for name, rows in inputs.items()} | found._asdict()
        self._native.dynamics(self._tree, *(arrays[name] for name in DYNAMICS))
        return found

    def step(
        self,
        state: tuple[Float64, Float64, Float64],
        matrix: Float64,
        effort: Float64,
        added: Float64,
        friction: Friction,
        dt: float,
    ) -> tuple[Float64, Float64, Float64]:
        """See :meth:`NumpyBatchDynamics.step`."""
        q, v, f = (leaf.copy() for leaf in state)
        arrays = {"qpos": q, "qvel": v, "friction": f, "matrix": matrix, "effort": effort, "added": added}
        arrays |= friction._asdict() | {"low": self._joints.low, "high": self._joints.high}
        self._native.step(*(arrays[name] for name in STEP), dt, SWEEPS)
        return q, v, f


class NumpyBatchDynamics:
    """Dynamics of the joints that move, of many robots, by NumPy."""

    def __init__(self, loaded: Loaded, joints: MovingJoints) -> None:
        self._loaded, self._joints, self._spread = loaded, joints, joints.matrix

    def at(self, qpos: Float64, qvel: Float64, payload: Float64) -> Passive:
        """Return the dynamics at ``qpos`` and ``qvel`` (n, joints) with ``payload`` (n, 1) [kg] at the tool."""
        q, v = self._joints.rest + qpos @ self._spread.T, qvel @ self._spread.T
        tree, body, point = self._loaded
        bodies = tree.bodies
        if body >= 0:
            point_mass = spatial_matrix(SpatialInertia(1.0, point, np.zeros((3, 3))))
            bodies = tree.with_added({body: payload[:, :, None] * point_mass})
        force = ts.bias(tree, q, v)
        loaded = ts.bias(tree, q, v, bodies=bodies) - force
        matrix = ts.mass_matrix(tree, q, bodies)
        return Passive(self._spread.T @ matrix @ self._spread, force @ self._spread, loaded @ self._spread)

    def step(
        self,
        state: tuple[Float64, Float64, Float64],
        matrix: Float64,
        effort: Float64,
        added: Float64,
        friction: Friction,
        dt: float,
    ) -> tuple[Float64, Float64, Float64]:
        """Return positions, velocities and efforts of friction (n, joints) after a step; ``state`` holds them before.

        ``matrix`` is the one from :meth:`at`, ``effort`` excludes friction, ``added`` is the inertia on its diagonal.
        """
        q, v, f = state
        mobility = dt * np.linalg.inv(matrix + added[:, :, None] * np.eye(q.shape[1]))

        def along(effort: Float64) -> Float64:
            return (mobility @ effort[..., None])[..., 0]

        free = v + along(effort)
        weight = 1 / (np.diagonal(mobility, axis1=1, axis2=2) + friction.creep)
        for _ in range(SWEEPS):
            slip = free - along(f) - friction.keep * v - friction.creep * f
            f = np.minimum(np.maximum(f + weight * slip, -friction.limit), friction.limit)
        v = free - along(f)
        q = q + dt * v
        low, high = self._joints.low, self._joints.high
        return np.clip(q, low, high), np.where((q < low) | (q > high), 0.0, v), f
