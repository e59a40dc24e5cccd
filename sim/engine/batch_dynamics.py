r"""Dynamics of many robots of one kind, each with its payload, and steps of their joints with friction.

Some joints move (``joints``), others rest or follow one of them: q_whole = rest + G q, with one leader for each row of
G. With the mass matrix M and the passive forces h (gravity, Coriolis and centrifugal forces) of all joints, the
joints that move have G^T M G and G^T h.

The extension computes M by composite rigid bodies (:mod:`batchpid.sim.engine.rigid_body`) and h by the recursive
Newton-Euler algorithm without acceleration of the joints (R. Featherstone, Rigid Body Dynamics Algorithms, Springer,
2008, section 5.3), in the axes of the base and about its origin. With the motions s_j of the joints, the velocity V and
acceleration A of a body, and its inertia I, from the base to the tips::

    V_j = V_above + s_j q'_j       A_j = A_above + V_j x s_j q'_j       F_j = I_j A_j + V_j x* I_j V_j

and back, h_j = s_j . (sum of the F of all that joint j moves). The base has the acceleration -g. Without the extension
Pinocchio computes both, on SAPIEN's model: they agree to 1e-9, with a payload to the rounding of SAPIEN's masses.

A step of length dt under efforts tau and Coulomb friction of at most F, with D = M + added inertia (diagonal)::

    D (v+ - v) = dt (tau - f),     f in F Sgn(v+ - keep v - creep f),     q+ = q + dt v+

With keep = creep = 0 friction stops a joint at once. The complementarity problem is solved by projected Jacobi sweeps,
begun with the friction of the step before (M. Anitescu and F. A. Potra, "Formulating dynamic multi-rigid-body contact
problems with friction as solvable linear complementarity problems", Nonlinear Dynamics 14, 1997). Joints stop at their
limits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.sim.engine import native
from batchpid.sim.engine.engines import load_engine
from batchpid.sim.engine.native.interface import DYNAMICS, STEP
from batchpid.sim.engine.protocol import RobotModel
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.description import RobotDescription

Models = Callable[[float], RobotModel]
"""Model of a robot with a payload [kg]."""
_MOST_PAYLOADS = 64
"""Most models of robots with a payload that are kept."""


class Passive(NamedTuple):
    """Dynamics of n robots at their poses."""

    matrix: Float64
    """Mass matrices with the payload (n, joints, joints) [kg m^2 or kg]."""
    force: Float64
    """Gravity, Coriolis and centrifugal forces without the payload (n, joints) [N m or N]."""
    payload_force: Float64
    """Those of the payload (n, joints)."""


class Friction(NamedTuple):
    """Coulomb friction of n robots in a step."""

    limit: Float64
    """Largest effort of friction (n, joints) [N m or N]."""
    keep: Float64
    """Share of its velocity that a joint keeps in a step if friction suffices to stop it (n, 1)."""
    creep: Float64
    """Velocity that it has besides, per effort of friction (n, joints)."""


SWEEPS = 2
"""Sweeps over the joints in a step, begun with the friction of the step before."""


def batch_dynamics(robot: RobotDescription, joints: tuple[int, ...]) -> NativeBatchDynamics | PinocchioBatchDynamics:
    """Return the dynamics of ``joints`` of ``robot`` on a fixed base: native ones where the extension is used."""
    moving = MovingJoints.of(robot, joints)
    if native.status().active:
        return NativeBatchDynamics(models_of(robot), moving)
    return PinocchioBatchDynamics(models_of(robot), moving)


def models_of(robot: RobotDescription) -> Models:
    """Return the models of ``robot`` on a fixed base."""
    engine = load_engine()
    return lambda payload: (
        engine.loaded_dynamics(robot, payload) if payload else engine.robot_dynamics(robot, ground=False)
    )


class MovingJoints(NamedTuple):
    """Joints of a robot that move, and those that rest or follow them."""

    leader: NDArray[np.int32]
    """Number among the joints that move, of each joint of the robot (dof,); -1 for a joint that rests."""
    multiplier: Float64
    """Ratio of its speed to its leader's speed (dof,)."""
    rest: Float64
    """Its position where its leader is at 0 (dof,)."""
    low: Float64
    """Lower limits of the joints that move (joints,), -inf for none."""
    high: Float64

    @classmethod
    def of(cls, robot: RobotDescription, joints: tuple[int, ...]) -> MovingJoints:
        """Return ``joints`` of ``robot``; others rest where it starts, or follow."""
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
    """Dynamics as of :class:`PinocchioBatchDynamics`, computed by the extension."""

    def __init__(self, models: Models, joints: MovingJoints) -> None:
        bodies, loaded = models(0.0).bodies, models(1.0).bodies
        gained = loaded.mass - bodies.mass
        carrier = int(np.argmax(gained))
        moment = loaded.mass[carrier] * loaded.center[carrier] - bodies.mass[carrier] * bodies.center[carrier]
        self._joints, self._carries = joints, float(gained[carrier] > 0.5)  # 0 where the tool is part of the base
        self._native = native.extension("_batch_dynamics")
        self._tree = self._native.tree(
            bodies.tree,
            bodies.table(),
            joints.leader,
            joints.multiplier,
            joints.rest,
            len(bodies.tree),
            len(joints.low),
            carrier,
            tuple(moment / max(gained[carrier], 0.5)),
            SceneSpec.gravity,
        )

    def at(self, qpos: Float64, qvel: Float64, payload: Float64) -> Passive:
        """See :meth:`PinocchioBatchDynamics.at`."""
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
        """See :meth:`PinocchioBatchDynamics.step`."""
        q, v, f = (leaf.copy() for leaf in state)
        arrays = {"qpos": q, "qvel": v, "friction": f, "matrix": matrix, "effort": effort, "added": added}
        arrays |= friction._asdict() | {"low": self._joints.low, "high": self._joints.high}
        self._native.step(*(arrays[name] for name in STEP), dt, SWEEPS)
        return q, v, f


class PinocchioBatchDynamics:
    """Dynamics of the joints that move, of many robots: by Pinocchio, and steps by NumPy."""

    def __init__(self, models: Models, joints: MovingJoints) -> None:
        self._models, self._joints, self._spread = models, joints, joints.matrix
        self._empty = models(0.0)
        self._loaded: dict[float, RobotModel] = {}

    def at(self, qpos: Float64, qvel: Float64, payload: Float64) -> Passive:
        """Return the dynamics at ``qpos`` and ``qvel`` (n, joints) with ``payload`` (n, 1) [kg] at the tool."""
        q, v = self._joints.rest + qpos @ self._spread.T, qvel @ self._spread.T
        still, column = np.zeros_like(q), payload[:, 0]
        force = self._empty.inverse_dynamics(q, v, still)
        matrix, loaded = np.empty((*q.shape, q.shape[1])), np.zeros_like(force)
        for kg in np.unique(column):
            rows, model = column == kg, self._model(float(kg))
            matrix[rows] = model.mass_matrix(q[rows])
            if kg:
                loaded[rows] = model.inverse_dynamics(q[rows], v[rows], still[rows]) - force[rows]
        return Passive(self._spread.T @ matrix @ self._spread, force @ self._spread, loaded @ self._spread)

    def _model(self, payload: float) -> RobotModel:
        if not payload:
            return self._empty
        if payload not in self._loaded:
            if len(self._loaded) >= _MOST_PAYLOADS:
                self._loaded.clear()
            self._loaded[payload] = self._models(payload)
        return self._loaded[payload]

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
