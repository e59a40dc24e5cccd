r"""Robot with motors, many candidates at once: the model whose motion is fitted to logs.

The rigid-body dynamics follow the model that SAPIEN derives (:mod:`batchpid.sim.engine.batch_dynamics`), in steps of dt
by semi-implicit Euler as in SAPIEN and MuJoCo, with armature A, viscous damping B and Coulomb friction F of the joints,
strength s, bias b and delay d of their motors, and a payload at the tool::

    (M + A + dt B) (v+ - v) = dt (s u(t - d) + b + c - h - B v - f),     f in F Sgn(v+),     q+ = q + dt v+

u is the logged effort, or the effort of the PID law under the logged setpoints; h gravity and Coriolis forces; c the
robot's compensation of h, by a model with or without the payload. A robot that sends c through its motors adds it to u.
Friction stops a joint within the time T ("stopping"), not at once, because real joints and MuJoCo's yield near rest; in
steps of dt, with r = (1 / 9) (M^-1)_jj at the pose 0::

    v+ - dt r f = (1 - dt / T) v     while |f_j| < F_j

Unlogged joints rest at the robot's start pose; followers move with their leaders.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.engine.batch_dynamics import Friction, Passive, batch_dynamics
from batchpid.sim.identification.logged_control import Drive, Law
from batchpid.sim.robot.robot import Robot

DIVERGED = 1e6
"""Position beyond which a simulation has diverged [rad or m]."""
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
        self.drive = drive
        self._dynamics = batch_dynamics(robot, joints)

    def mass_matrix(self, qpos: Float64, payload: Float64) -> Float64:
        """Return the mass matrices (n, joints, joints) of the logged joints at ``qpos`` (n, joints)."""
        return self._dynamics.at(qpos, np.zeros_like(qpos), payload).matrix

    def passive(self, qpos: Float64, qvel: Float64, payload: Float64) -> Float64:
        """Return gravity and Coriolis forces (n, joints) [N m or N]."""
        found = self._dynamics.at(qpos, qvel, payload)
        return found.force + found.payload_force

    def compensation(self, qpos: Float64, qvel: Float64, payload: Float64) -> Float64 | None:
        """Return the robot's compensation (n, joints), None for none; ``payload`` is included if the robot knows it."""
        return self._compensation(qpos, self._dynamics.at(qpos, qvel, payload), payload)

    def _compensation(self, qpos: Float64, found: Passive, payload: Float64) -> Float64 | None:
        if self.drive.compensate == "none":
            return None
        if self.drive.compensate == "gravity":
            found = self._dynamics.at(qpos, np.zeros_like(qpos), payload)
        return found.force + found.payload_force if self.drive.knows_payload else found.force

    def _mobility(self, motors: Motors) -> Float64:
        """Return the diagonals of the inverse mass matrices (n, joints) with the logged joints at 0."""
        matrix = self.mass_matrix(np.zeros_like(motors.armature), motors.payload)
        own = np.eye(motors.armature.shape[1])
        return np.diagonal(np.linalg.inv(matrix + motors.armature[:, None] * own), axis1=1, axis2=2)

    def simulate(self, motors: Motors, segments: list[Segment], past: int) -> Float64:
        """Return the positions (n, steps + 1, joints) of candidate i in segment i, the start included.

        All segments have the same number of steps. A simulation that diverges ends at inf.
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
        friction = Friction(
            motors.friction,
            np.maximum(1 - dt / np.maximum(motors.stopping, dt), 0.0),
            np.where(motors.stopping > dt, _CREEP * dt * self._mobility(motors), 0.0),
        )
        f = np.zeros_like(q)
        out = np.empty((len(q), steps + 1, q.shape[1]))
        out[:, 0] = q
        added = motors.armature + dt * motors.damping
        in_units = drive.params is not None and drive.params.gain_units is not None
        unloaded = np.zeros_like(motors.payload)
        with np.errstate(all="ignore"):
            for step in range(steps):
                if not (within := np.abs(q) <= DIVERGED).all():
                    bad = ~within.all(1)
                    q, v, f = (np.where(bad[:, None], 0.0, x) for x in (q, v, f))
                    out[bad, step:] = np.inf
                passive = self._dynamics.at(q, v, motors.payload)
                c = self._compensation(q, passive, motors.payload)
                now = past + step
                if law is None:
                    u = _at(command, now - whole, rows) * (1 - part) + _at(command, now - whole - 1, rows) * part
                    if drive.through and c is not None:
                        u, c = u + c, None
                else:
                    if step % drive.substeps == 0:
                        known = self._dynamics.at(q, v, unloaded).matrix if in_units else passive.matrix
                        seen = q + noise[now] if drive.noisy else q
                        asked = law.effort(command[now], seen, v, known, c if drive.through else None)
                    history[now % longest] = asked
                    u = history[(now - whole) % longest, rows] * (1 - part)
                    u += history[(now - whole - 1) % longest, rows] * part
                    if drive.through:
                        c = None
                effort = motors.strength * u + motors.bias - motors.damping * v - passive.force - passive.payload_force
                if c is not None:
                    effort += c
                q, v, f = self._dynamics.step((q, v, f), passive.matrix, effort, added, friction, dt)
                out[:, step + 1] = q
        out[:, -1] = np.where(np.abs(out[:, -1]) <= DIVERGED, out[:, -1], np.inf)
        return out


def _at(command: Float64, index: Any, rows: Any) -> Float64:
    return command[np.maximum(index, 0), rows]
