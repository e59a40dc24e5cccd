r"""Robot with motors, many candidates at once: the model whose motion is fitted to logs.

Control and motors are the Runner's, :func:`batchpid.sim.loop.control_step.control_step` at every sim step. In place of
an engine, the rigid tree of the logged joints (:mod:`batchpid.task_space`) moves in steps of dt by semi-implicit Euler
as in SAPIEN and MuJoCo, with armature A, viscous damping B and Coulomb friction F of the joints, and a payload at the
tool::

    D (v+ - v) = dt (u + c - h - B v - f),     D = M + A + dt B,     f in F Sgn(v+),     q+ = q + dt v+

u is the effort of the motors, asked for by the log or by the PID law under the logged setpoints; h gravity and Coriolis
forces; c the robot's compensation of h, by a model with or without the payload. Through the motors, c is part of u.
Friction stops a joint within the time T ("stopping"), not at once, because real joints and MuJoCo's yield near rest; in
steps of dt, with r = (1 / 9) (M^-1)_jj at the pose 0::

    v+ - dt r f = (1 - dt / T) v     while |f_j| < F_j

This complementarity problem is solved by projected Jacobi sweeps, from the friction of the step before (M. Anitescu and
F. A. Potra, "Formulating dynamic multi-rigid-body contact problems with friction as solvable linear complementarity
problems", Nonlinear Dynamics 14, 1997). Joints stop at their limits. Unlogged joints rest at the robot's start pose;
followers move with their leaders.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Document, Float64
from batchpid.motors.actuators import Actuators
from batchpid.motors.coupling import Coupling, Follower
from batchpid.motors.friction import Friction, bound_of
from batchpid.sim.engine.scene_spec import added_friction
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.logged_control import LoggedControl, LoggedDrive
from batchpid.sim.identification.unknowns import Motors, actuators_of
from batchpid.sim.robot.robot import Robot
from batchpid.task_space import native_rows
from batchpid.task_space.rigid_tree import RigidTree

DIVERGED = 1e6
"""Position beyond which a simulation has diverged [rad or m]."""
SWEEPS = 2
"""Sweeps over the joints in a step."""
_CREEP = 1 / 9
"""Share of its friction-free acceleration that a joint creeps with before it stops, with ``stopping``; MuJoCo's."""
PAYLOAD = "payload at the tool"
"""Link at the place of the payload: the center of mass of the tool."""
_EMPTY = "mass_matrix", "bias"
_LOADED = *_EMPTY, "jacobian", "jacobian_rate"


class Segment(NamedTuple):
    """Part of a log to simulate, on the grid of the sim steps."""

    qpos: Float64
    """Position at its start (joints,) [rad or m]."""
    qvel: Float64
    """Velocity at its start (joints,)."""
    command: Float64
    """Setpoints or efforts (past + steps, joints) from ``past`` steps before the start on."""
    noise: Float64
    """Noise of the positions that the law is given (past + steps, joints)."""
    feedforward: Float64 | None = None
    """Efforts that are added to the efforts of the law (past + steps, joints)."""


class Passive(NamedTuple):
    """Dynamics of n robots at their poses."""

    matrix: Float64
    """Mass matrices with the payload (n, joints, joints) [kg m^2 or kg]."""
    force: Float64
    """Gravity, Coriolis and centrifugal forces without the payload (n, joints) [N m or N]."""
    payload_force: Float64 | float
    """The same forces of the payload (n, joints)."""


class Plant:
    """Logged ``joints`` of ``robot`` under ``drive``."""

    def __init__(self, robot: Robot, joints: tuple[int, ...], drive: LoggedDrive) -> None:
        self.drive, own, coupling = drive, list(joints), robot.coupling
        tree, whole = robot.dynamics(False).tree, robot.rigid_tree
        moves = np.isin(coupling.leader, joints)
        number = np.cumsum(moves) - 1
        followers = [
            Follower(number[each], number[coupling.leader[each]], coupling.multiplier[each], coupling.offset[each])
            for each in np.flatnonzero(moves & ~coupling.independent)
        ]
        tool = whole.index(whole.tool)
        frame = whole.bodies.link_frames[tool]
        tree = _with_payload(tree, whole.link_bodies[tool], frame[:, :3] @ whole.center[tool] + frame[:, 3])
        fixed = tree.fixed_at(coupling.positions(robot.start), moves)
        self.tree = replace(fixed, coupling=Coupling.of(fixed.dof, followers))
        """Rigid tree of the logged joints, with a link without mass for the payload."""
        self._own = None if np.array_equal(number[own], np.arange(fixed.dof)) else number[own]
        free = robot.continuous[own]
        self.low, self.high = (
            np.where(free, end, limit[own])[None] for end, limit in ((-np.inf, robot.lower), (np.inf, robot.upper))
        )
        self._damping = robot.damping[own]

    def mass_matrix(self, qpos: Float64, payload: Float64) -> Float64:
        """Return the mass matrices (n, joints, joints) of the logged joints at ``qpos`` (n, joints)."""
        return self.at(qpos, np.zeros_like(qpos), payload).matrix

    def with_tree(self, tree: RigidTree) -> Plant:
        """Return this plant with other masses, those of ``tree``."""
        other = copy(self)
        other.tree = tree
        return other

    def compensation(self, qpos: Float64, qvel: Float64, payload: Float64) -> Float64 | None:
        """Return the robot's compensation (n, joints), None for none; ``payload`` is included if the robot knows it."""
        return self._compensation(self.at(qpos, qvel, payload), self._at_rest(qpos, payload))

    def at(self, qpos: Float64, qvel: Float64, payload: Float64) -> Passive:
        """Return the dynamics at ``qpos`` and ``qvel`` (n, joints) with ``payload`` (n, 1) [kg] at the tool."""
        return self._dynamics(qpos, qvel, payload)()

    def _dynamics(self, qpos: Float64, qvel: Float64, payload: Float64) -> Callable[[], Passive]:
        """Return :meth:`at` of what the arrays then hold; each result takes the place of the one before."""
        tree, own, index = self.tree, self._own, len(self.tree.links) - 1
        wanted = _LOADED if payload.any() else _EMPTY
        q, v = (np.ascontiguousarray(each) if own is None else np.zeros((len(qpos), tree.dof)) for each in (qpos, qvel))
        native = native_rows.bound(tree, wanted, q, v, index)

        def dynamics() -> Passive:
            if own is not None:
                q[:, own], v[:, own] = qpos, qvel
                q[...], v[...] = tree.positions(q), tree.rates(v)
            if native is None:
                of_tree = ts.task_dynamics(tree, q, v, PAYLOAD)
                matrix, force, *tool = (getattr(of_tree, name) for name in wanted)
            else:
                native[0]()
                matrix, force, *tool = native[1]
            if own is not None:
                matrix, force = np.ascontiguousarray(matrix[:, own[:, None], own]), force[:, own]
            if not tool:
                return Passive(matrix, force, 0.0)
            jacobian, rate = tool[0][:, :3], tool[1][:, :3] - tree.bodies.gravity
            jacobian = jacobian if own is None else jacobian[..., own]
            pull = payload[..., None] * jacobian.swapaxes(1, 2)
            matrix += pull @ jacobian
            return Passive(matrix, force, (pull @ rate[..., None])[..., 0])

        return dynamics

    def _at_rest(self, qpos: Float64, payload: Float64) -> Callable[[], Passive] | None:
        """Return the dynamics without velocities, as :meth:`_dynamics` does; None where these are not compensated."""
        return self._dynamics(qpos, np.zeros_like(qpos), payload) if self.drive.compensate == "gravity" else None

    def _compensation(self, found: Passive, at_rest: Callable[[], Passive] | None) -> Float64 | None:
        if self.drive.compensate == "none":
            return None
        if at_rest is not None:
            found = at_rest()
        return found.force + found.payload_force if self.drive.knows_payload else found.force

    def control(
        self,
        actuators: Actuators,
        qpos: Float64,
        qvel: Float64,
        asked: Float64 | None = None,
        drive: LoggedDrive | None = None,
    ) -> LoggedControl:
        """Return the control of robots at ``qpos`` and ``qvel`` (n, joints), with their motors; default: its drive."""
        unloaded = np.zeros((len(qpos), 1))

        def model(qpos: Float64) -> Float64:
            return self.mass_matrix(qpos, unloaded)

        return LoggedControl(drive or self.drive, actuators, qpos, qvel, asked, self._damping, model)

    def simulate(self, motors: Motors, segments: list[Segment], past: int) -> Float64:
        """Return the positions (n, steps + 1, joints) of candidate i in segment i, the start included.

        All segments have the same number of steps. A simulation that diverges ends at inf.
        """
        drive, payload = self.drive, motors["payload"]
        q = np.array([segment.qpos for segment in segments])
        v = np.array([segment.qvel for segment in segments])
        command, noise = (
            np.stack([getattr(segment, name) for segment in segments], axis=1) for name in ("command", "noise")
        )
        forward = None
        if any(segment.feedforward is not None for segment in segments):
            none = np.zeros_like(command[:, 0])
            rows = [none if segment.feedforward is None else segment.feedforward for segment in segments]
            forward = np.stack(rows, axis=1)
        actuators = actuators_of(motors, q.shape[1])
        held = self.compensation(q, v, payload) if drive.through else None
        if (offset := motors.get("offset")) is not None:
            q -= offset
        asked = np.zeros((1, *q.shape)) if drive.params is not None else command[max(past - 1, 0) :: -1]
        control = self.control(actuators, q, v, asked if held is None else asked + held, drive.of(motors))
        motion = _Motion(self, actuators, motors)
        dynamics, at_rest = self._dynamics(q, v, payload), self._at_rest(q, payload)
        out = np.empty((len(q), len(command) - past + 1, q.shape[1]))
        out[:, 0] = q
        with np.errstate(all="ignore"):
            for step in range(len(command) - past):
                if not (within := np.abs(q) <= DIVERGED).all():
                    bad = ~within.all(1)
                    for array in (q, v, motion.friction):
                        array[bad] = 0.0
                    out[bad, step:] = np.inf
                passive, now = dynamics(), past + step
                c = self._compensation(passive, at_rest)
                inside, outside = (c, None) if drive.through else (None, c)
                if forward is not None:
                    inside = forward[now] if inside is None else inside + forward[now]
                shake = noise[now] if drive.noisy else None
                effort = control.advance(command[now], q, v, inside, shake)
                if outside is not None:
                    effort = effort + outside
                motion.step(q, v, passive.matrix, effort, passive.force + passive.payload_force)
                out[:, step + 1] = q
        out[:, -1] = np.where(np.abs(out[:, -1]) <= DIVERGED, out[:, -1], np.inf)
        return out if offset is None else out + offset[:, None]


def plants_of(robot: Robot, joints: tuple[int, ...], drive: LoggedDrive, logs: list[Log]) -> list[Plant]:
    """Return the plant of each log under ``drive``, with the robot and the params of its settings."""
    known: dict[tuple[int, int], Plant] = {}
    found = []
    for own, params, *_ in (log.settings for log in logs):
        key = id(own), id(params)
        if key not in known:
            known[key] = Plant(own or robot, joints, drive if params is None else replace(drive, params=params))
        found.append(known[key])
    return found


def _with_payload(tree: RigidTree, body: int, place: Float64) -> RigidTree:
    """Return ``tree`` with a link without mass for the payload, at a ``place`` (3,) [m] in the frame of a body."""
    carrier = tree.link_bodies.index(body)
    frame = tree.bodies.link_frames[carrier]
    more = {"position": frame[:, :3].T @ (place - frame[:, 3]), "wxyz": [1, 0, 0, 0], "axis": [1, 0, 0]}
    more |= {"parent": carrier, "mass": 0, "center": np.zeros(3), "inertia": np.zeros((3, 3))}
    tables: Document = {name: np.concatenate([getattr(tree, name), np.array([row])]) for name, row in more.items()}
    return replace(tree, links=(*tree.links, PAYLOAD), joint_types=(*tree.joint_types, "fixed"), **tables)


class _Motion:
    """Steps of the joints of n candidates, with their friction."""

    def __init__(self, plant: Plant, actuators: Actuators, motors: Motors) -> None:
        self._dt = dt = plant.drive.timestep
        stopping, shape = motors["stopping"], actuators.armature.shape
        matrix = plant.mass_matrix(np.zeros(shape), motors["payload"])
        own = np.linalg.inv(matrix + actuators.armature[:, None] * np.eye(shape[1]))
        self.friction = np.zeros(shape)
        """Efforts of friction in the last step (n, joints) [N m or N]."""
        self._added = actuators.armature + dt * actuators.viscous
        self._friction, self._slides = added_friction(Friction(), actuators), np.zeros(shape)
        keep = np.maximum(1 - dt / np.maximum(stopping, dt), 0.0)
        creep = np.where(stopping > dt, _CREEP * dt * np.diagonal(own, axis1=1, axis2=2), 0.0)
        self._constants = keep, creep, plant.low, plant.high

    def step(self, qpos: Float64, qvel: Float64, matrix: Float64, effort: Float64, force: Float64) -> None:
        """Change positions and velocities (n, joints) to those after a step.

        ``effort`` are the motors' efforts less viscous friction, ``force`` the robot's gravity and Coriolis forces.
        """
        model, motor = self._friction, effort
        if model.load is not None:
            motor = effort + model.viscous * qvel
        limit = bound_of(model, self._slides, motor, qvel)
        arrays = qpos, qvel, self.friction, matrix, effort - force, self._added, limit, *self._constants
        if not native_rows.move(self._dt, SWEEPS, *arrays):
            _move(self._dt, *arrays)
        if model.static is not None:
            self._slides = (np.abs(self.friction) >= limit).astype(float)


def _move(dt: float, *arrays: Float64) -> None:
    """Change positions, velocities and friction as :func:`batchpid.task_space.native_rows.move` does."""
    q, v, f, matrix, effort, added, limit, keep, creep, low, high = arrays
    mobility = dt * np.linalg.inv(matrix + added[:, :, None] * np.eye(q.shape[1]))

    def along(effort: Float64) -> Float64:
        return (mobility @ effort[..., None])[..., 0]

    free = v + along(effort)
    weight = 1 / (np.diagonal(mobility, axis1=1, axis2=2) + creep)
    for _ in range(SWEEPS):
        f[...] = np.clip(f + weight * (free - along(f) - keep * v - creep * f), -limit, limit)
    v[...] = free - along(f)
    q += dt * v
    v[...] = np.where((q < low) | (q > high), 0.0, v)
    np.clip(q, low, high, out=q)
