"""Independent joints of a robot, as observed by tasks: with finite ranges, and continuous joints
within half a turn.
"""

from __future__ import annotations

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import TURN, wrap
from batchpid.sim.robot.robot import Robot
from batchpid.sim.signals.observation import Observation

MAX_SPEED = 100.0
"""Joint speed that PhysX allows, and bound of the observed one [rad/s or m/s]."""

FARTHEST = 1000.0
"""Bound of the observed position of a floating base [m]."""


class JointSpace:
    """Independent joints of ``robot`` (:attr:`batchpid.sim.Robot.independent`), with a finite range
    each.

    The range is the joint's limits. For a continuous joint it is [-pi, pi], for another joint
    without limits half a turn, or pi m, on either side of its start.
    """

    def __init__(self, robot: Robot) -> None:
        self._dof = robot.dof
        self._floats = not robot.fixed_base
        self.index = np.flatnonzero(robot.independent)
        """Numbers of the joints in the robot (joints,)."""
        self.names = tuple(robot.joint_names[joint] for joint in self.index)
        self.continuous = robot.continuous[self.index]
        self.turns = np.where(self.continuous, 1 / TURN, 0.0)
        """1 / (2 pi) for continuous joints, else 0: the argument of
        :func:`batchpid.arrays.elementwise.wrap`.
        """
        self.start = wrap(robot.start[self.index], self.turns, np)
        """Start pose (joints,) [rad or m]."""
        lower = robot.lower[self.index]
        upper = robot.upper[self.index]
        middle = np.where(self.continuous, 0.0, self.start)
        self.low = np.where(np.isfinite(lower), lower, middle - np.pi)
        """Lower ends of the ranges (joints,) [rad or m]."""
        self.high = np.where(np.isfinite(upper), upper, middle + np.pi)
        """Upper ends of the ranges (joints,) [rad or m]."""

    def bounds(self) -> tuple[Float64, Float64]:
        """Return bounds of what :meth:`observe` returns; positions may be pi beyond a limit."""
        beyond = np.where(self.continuous, 0.0, np.pi)
        speed = np.full(len(self.index), MAX_SPEED)
        if self._floats:
            base = np.repeat([FARTHEST, 1.0, MAX_SPEED], [3, 4, 6])
        else:
            base = np.zeros(0)
        low = (self.low - beyond, -speed, -base)
        high = (self.high + beyond, speed, base)
        return np.concatenate(low), np.concatenate(high)

    def observe(self, observed: Observation) -> Float64:
        """Return positions and velocities (envs, 2 joints), then pose and twist (envs, 13) of a
        floating base.

        Positions of continuous joints are in [-pi, pi].
        """
        qpos = wrap(observed.qpos[:, self.index].astype(np.float64), self.turns, np)
        if observed.base_pose is None:
            base = []
        else:
            base = [observed.base_pose, observed.base_twist]
        return np.concatenate([qpos, observed.qvel[:, self.index], *base], axis=1)

    def of_robot(self, positions: Float64) -> Float64:
        """Return positions (..., joints) for all joints of the robot (..., dof); followers have
        0.
        """
        rows = np.zeros((*positions.shape[:-1], self._dof))  # the runner puts followers in place
        rows[..., self.index] = positions
        return rows
