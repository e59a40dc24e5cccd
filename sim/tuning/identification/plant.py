r"""Robot with motors, many candidates at once: the model whose motion is fitted to logs.

The rigid-body dynamics are Pinocchio's on the model that SAPIEN derives, in steps of dt as SAPIEN and MuJoCo take them
(semi-implicit Euler), with armature A, viscous damping B and Coulomb friction F of the joints, strength s, bias b and
delay d of their motors, and a payload at the tool::

    (M + A + dt B) (v+ - v) = dt (s u(t - d) + b + c - h - B v - f),     f in F Sgn(v+),     q+ = q + dt v+

u is the logged effort, or that of the PID law under the logged setpoints; h gravity and Coriolis forces, and c what the
robot compensates of them, by a model with or without the payload. A robot that sends c through its motors adds it to u.
Friction stops a joint within the time T ("stopping"), not at once, because real joints and MuJoCo's yield near rest; in
steps of dt, with r = (1 / 9) (M^-1)_jj at the pose 0::

    v+ - dt r f = (1 - dt / T) v     while |f_j| < F_j

The complementarity problem is solved by two projected Jacobi sweeps, begun with the friction of the step before (M.
Anitescu and F. A. Potra, "Formulating dynamic multi-rigid-body contact problems with friction as solvable linear
complementarity problems", Nonlinear Dynamics 14, 1997).

Joints that are in no log rest where the robot starts; followers move with their leaders.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.robot.robot import Robot
from sim.tuning.identification.drive import Drive, Law

Float64 = NDArray[np.float64]
Groups = list[tuple[float, Any]]
"""Payloads [kg], each with the rows that carry it."""
UNLOADED: Groups = [(0.0, slice(None))]
_SWEEPS = 2
_CREEP = 1 / 9
"""Share of its friction-free acceleration that a joint creeps with before it stops, with ``stopping``; MuJoCo's."""


class Motors(NamedTuple):
    """Unknowns of n candidates: arrays (n, joints), but delay, stopping and payload (n, 1)."""

    armature: Float64
    damping: Float64
    friction: Float64
    strength: Float64
    bias: Float64
    delay: Float64
    stopping: Float64
    payload: Float64

    def take(self, rows: Any) -> Motors:
        """Return the candidates ``rows``."""
        return Motors(*(leaf[rows] for leaf in self))


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


class Plant:
    """Logged ``joints`` of ``robot`` under ``drive``."""

    def __init__(self, robot: Robot, joints: tuple[int, ...], drive: Drive) -> None:
        self.robot, self.joints, self.drive = robot, joints, drive
        spread = np.zeros((robot.dof, len(joints)))
        spread[joints, range(len(joints))] = 1.0
        if robot.coupling is not None:
            followers = robot.coupling.followers
            spread[followers] = robot.coupling.multiplier[followers, None] * spread[robot.coupling.leader[followers]]
        rest = robot.start.copy()
        rest[list(joints)] = 0.0
        self._spread = None if np.array_equal(spread, np.eye(robot.dof)) else spread
        self._rest = (
            rest
            if robot.coupling is None
            else np.where(
                robot.independent, rest, robot.coupling.multiplier * rest[robot.coupling.leader] + robot.coupling.offset
            )
        )
        free = robot.continuous[list(joints)]
        self._low = np.where(free, -np.inf, robot.lower[list(joints)])
        self._high = np.where(free, np.inf, robot.upper[list(joints)])
        self._models: dict[float, Any] = {}

    def dynamics(self, payload: float = 0.0) -> Any:
        """Return the dynamics of the robot with ``payload`` [kg] at its tool."""
        if payload not in self._models:
            from sim.engine.dynamics import loaded_dynamics

            if len(self._models) > 64:
                self._models.clear()
            self._models[payload] = loaded_dynamics(self.robot, payload) if payload else self.robot.dynamics()
        return self._models[payload]

    def whole(self, qpos: Float64) -> Float64:
        """Return the positions of all joints (n, dof) for those of the logged ones (n, joints)."""
        return qpos if self._spread is None else self._rest + np.einsum("nj,kj->nk", qpos, self._spread)

    def mass_matrix(self, qpos: Float64, payload: Float64) -> Float64:
        """Return the mass matrices (n, joints, joints) of the logged joints at ``qpos`` (n, joints)."""
        return self._mass_matrix(qpos, _groups(payload))

    def _mass_matrix(self, qpos: Float64, groups: Groups) -> Float64:
        whole = self.whole(qpos)
        matrix = np.empty((len(qpos), self.robot.dof, self.robot.dof))
        for kg, rows in groups:
            matrix[rows] = self.dynamics(kg).mass_matrix(whole[rows])
        return matrix if self._spread is None else self._spread.T @ matrix @ self._spread

    def passive(self, qpos: Float64, qvel: Float64, payload: Float64) -> Float64:
        """Return gravity and Coriolis forces (n, joints) [N m or N]."""
        return self._passive(qpos, qvel, _groups(payload))

    def _passive(self, qpos: Float64, qvel: Float64, groups: Groups) -> Float64:
        """Return the passive forces (n, joints) of the rows in ``groups``, 0 for others."""
        whole = self.whole(qpos)
        rate = qvel if self._spread is None else qvel @ self._spread.T
        still, force = np.zeros_like(whole), np.zeros_like(whole)
        for kg, rows in groups:
            force[rows] = self.dynamics(kg).inverse_dynamics(whole[rows], rate[rows], still[rows])
        return force if self._spread is None else force @ self._spread

    def compensation(self, qpos: Float64, qvel: Float64, payload: Float64 | None = None) -> Float64 | None:
        """Return what the robot compensates (n, joints), None for nothing; it may know its ``payload``."""
        if self.drive.compensate == "none":
            return None
        known = payload if self.drive.knows_payload and payload is not None else np.zeros((len(qpos), 1))
        return self.passive(qpos, qvel if "coriolis" in self.drive.compensate else np.zeros_like(qvel), known)

    def _forces(self, qpos: Float64, qvel: Float64, groups: Groups) -> tuple[Float64 | None, Float64]:
        """Return compensation and passive forces (n, joints); what cancels may be left out of both."""
        drive = self.drive
        if drive.compensate != "gravity+coriolis":
            known = groups if drive.knows_payload else UNLOADED
            c = None if drive.compensate == "none" else self._passive(qpos, np.zeros_like(qvel), known)
            return c, self._passive(qpos, qvel, groups)
        unknown = [] if drive.knows_payload else [(kg, rows) for kg, rows in groups if kg]
        unloaded = self._passive(qpos, qvel, [(0.0, rows) for _, rows in unknown])
        if not drive.through:
            return unloaded, self._passive(qpos, qvel, unknown)
        h = c = self._passive(qpos, qvel, groups)
        for _, rows in unknown:
            c = c.copy()
            c[rows] = unloaded[rows]
        return c, h

    def _mobility(self, motors: Motors) -> Float64:
        """Return the diagonals of the inverse mass matrices (n, joints) with the logged joints at 0."""
        matrix = self.mass_matrix(np.zeros_like(motors.armature), motors.payload)
        return np.diagonal(
            np.linalg.inv(matrix + motors.armature[:, None] * np.eye(len(self.joints))), axis1=1, axis2=2
        )

    def simulate(self, motors: Motors, segments: list[Segment], past: int) -> Float64:
        """Return the positions (n, steps + 1, joints) of candidate i in segment i, the start included.

        All segments have the same number of steps. What diverges ends at inf.
        """
        dt, drive = self.drive.timestep, self.drive
        q = np.array([segment.qpos for segment in segments])
        v = np.array([segment.qvel for segment in segments])
        command, noise = (
            np.stack([getattr(segment, name) for segment in segments], axis=1) for name in ("command", "noise")
        )
        steps, rows = len(command) - past, np.arange(len(q))
        law = None if drive.params is None else Law(drive, q, v)
        delays = motors.delay[:, 0] / dt
        whole = np.floor(delays).astype(int)
        part = (delays - whole)[:, None]
        longest = int(whole.max(initial=0)) + 2
        history = np.zeros((longest, *q.shape))
        if drive.through and (held := self.compensation(q, v, motors.payload)) is not None:
            history[:] = held
        keep = np.maximum(1 - dt / np.maximum(motors.stopping, dt), 0.0)
        creep = np.where(motors.stopping > dt, _CREEP * dt * self._mobility(motors), 0.0)
        f = np.zeros_like(q)
        out = np.empty((len(q), steps + 1, q.shape[1]))
        out[:, 0] = q
        implicit = motors.armature + dt * motors.damping
        diagonal = np.arange(q.shape[1])
        groups = _groups(motors.payload)
        in_units = drive.params is not None and drive.params.gain_units is not None
        with np.errstate(all="ignore"):
            for step in range(steps):
                if not np.isfinite(q).all():
                    bad = ~np.isfinite(q).all(1)
                    q, v, f = (np.where(bad[:, None], 0.0, x) for x in (q, v, f))
                    out[bad, step:] = np.inf
                matrix = self._mass_matrix(q, groups)
                c, h = self._forces(q, v, groups)
                now = past + step
                if law is None:
                    u = _at(command, now - whole, rows) * (1 - part) + _at(command, now - whole - 1, rows) * part
                    if drive.through and c is not None:
                        u, c = u + c, None
                else:
                    known = self._mass_matrix(q, UNLOADED) if in_units and groups != UNLOADED else matrix
                    asked = law.effort(
                        command[now], q + noise[now] if drive.noisy else q, v, known, c if drive.through else None
                    )
                    history[now % longest] = asked
                    u = history[(now - whole) % longest, rows] * (1 - part)
                    u += history[(now - whole - 1) % longest, rows] * part
                    if drive.through:
                        c = None
                tau = motors.strength * u + motors.bias - motors.damping * v - h
                if c is not None:
                    tau = tau + c
                matrix[:, diagonal, diagonal] += implicit
                mobility = dt * np.linalg.inv(matrix)
                free = v + (mobility @ tau[..., None])[..., 0]
                inertia = 1 / (mobility[:, diagonal, diagonal] + creep)
                kept = keep * v
                for _ in range(_SWEEPS):
                    slip = free - (mobility @ f[..., None])[..., 0] - kept - creep * f
                    f = np.minimum(np.maximum(f + inertia * slip, -motors.friction), motors.friction)
                v = free - (mobility @ f[..., None])[..., 0]
                q = q + dt * v
                beyond = (q < self._low) | (q > self._high)
                if beyond.any():
                    q, v = np.clip(q, self._low, self._high), np.where(beyond, 0.0, v)
                out[:, step + 1] = q
        bad = ~np.isfinite(out).all((1, 2))
        out[bad] = np.where(np.isfinite(out[bad]), out[bad], np.inf)
        return out


def _at(command: Float64, index: Any, rows: Any) -> Float64:
    return command[np.maximum(index, 0), rows]


def _groups(payload: Float64) -> Groups:
    """Return each payload (n, 1) that occurs, with the rows that carry it."""
    column = payload[:, 0]
    values = np.unique(column)
    if len(values) == 1:
        return [(float(values[0]), slice(None))]
    return [(float(value), np.flatnonzero(column == value)) for value in values]
