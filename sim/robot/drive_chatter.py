r"""Chatter of a stiff drive between its effort limits, in MuJoCo.

MuJoCo integrates a drive's damping implicitly, but a force at its limit is a constant, so that a drive that saturates
acts as an explicit one. With inertia I, joint damping b, effort limit L and time step dt, a force that alternates
between L and -L keeps a joint where it is, at velocities that alternate between w and -w::

    (I + dt b) w = -I w + dt L        so that        w = dt L / (2 I + dt b)

Such a drive, with damping d = kd + dt kp, keeps alternating if it passes from one limit to the other within a step:
d w > L, or d dt / (2 I + dt b) > 1, which is the stability bound of the explicit law. The joint then sticks wherever
the error is at most (d w - L) / kp. (This is also so for MuJoCo's own servos with ``forcerange``.)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64
from batchpid.checks.warn import warn
from batchpid.errors import InvalidArgumentError
from batchpid.sim.observation import Observation
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.loop_stability import StabilityWarning, stability_report

DURATION, TICKS = 0.1, 12
"""Time [s] and number of ticks for which a joint must chatter before a warning."""
_FASTEST, _SLOWEST = 1.5, 0.5
"""Velocities of a chattering joint, as shares of w: other joints change its inertia."""
_PROGRESS = 0.1
"""Largest share of the distance at these velocities that a chattering joint moves."""


class _Window(NamedTuple):
    """State of every joint since it began to look like chatter, (envs, dof)."""

    start: Float64
    """Position at the beginning [rad or m]."""
    distance: Float64
    """Distance that the joint would have moved at the magnitudes of its velocities [rad or m]."""
    ticks: NDArray[np.int64]


class DriveChatterCheck:
    """Check of the ticks under control "drive" for joints that chatter. It warns once.

    Parameters
    ----------
    robot, timestep
        The inertia is taken at the robot's start pose with this time step [s].
    """

    def __init__(self, robot: RobotDescription, timestep: float) -> None:
        self._robot, self._timestep = robot, timestep
        self._speed: Float64 | None = None
        self._window: _Window | None = None
        self.found: tuple[int, int] | None = None
        """Env and joint that chatters."""
        self._has_warned = False

    def set_gains(self, params: bp.PIDParams, actuators: bp.Actuators | None) -> None:
        """Find the joints that can chatter with these gains, effort limits and armature."""
        self._speed = self._window = None
        kp, kd = (np.zeros((1, self._robot.dof)) if leaf is None else leaf for leaf in (params.kp, params.kd))
        armature = None if actuators is None else actuators.armature
        least = 0.0 if armature is None else armature.min(0)
        try:
            inertia = stability_report(self._robot, params, self._robot.start, self._timestep, least).inertia
        except InvalidArgumentError:  # the robot's mass matrix is not positive definite
            return
        limit = math.inf if params.effort_max is None else np.asarray(params.effort_max, np.float64)
        speed = self._timestep * limit / (2 * inertia)  # w: the report's inertia is I + dt b / 2
        chatters = (kd + self._timestep * kp) * self._timestep > 2 * inertia
        speed = np.where(chatters & np.isfinite(speed) & self._robot.independent, speed, np.inf)
        self._speed = speed if np.isfinite(speed).any() else None

    @property
    def is_watching(self) -> bool:
        """False where no joint can chatter, and after the warning: :meth:`see` then has nothing to find."""
        return self._speed is not None and not self._has_warned

    def see(self, observation: Observation, seconds: float) -> None:
        """Look at the ticks (ticks, envs, ...) of ``observation``, each of which lasted ``seconds``."""
        if self._speed is None or self._has_warned:
            return
        for tick in range(len(observation.ok)):
            qpos, speed = observation.qpos[tick].astype(float), np.abs(observation.qvel[tick]).astype(float)
            alike = (speed > _SLOWEST * self._speed) & (speed < _FASTEST * self._speed)
            self._advance(qpos, speed * seconds, alike & observation.ok[tick][:, None], seconds)

    def _advance(self, qpos: Float64, distance: Float64, alike: Bool, seconds: float) -> None:
        window = self._window
        if window is None:
            window = _Window(qpos, np.zeros_like(qpos), np.zeros(qpos.shape, int))
        moved, covered, ticks = np.abs(qpos - window.start), window.distance + distance, window.ticks + 1
        chatters = alike & ((moved < _PROGRESS * covered) | (ticks < TICKS))
        long = chatters & (ticks >= TICKS) & (ticks * seconds >= DURATION)
        if self.found is None and long.any():
            env, joint = np.argwhere(long)[0]
            self.found = int(env), int(joint)
        self._window = _Window(
            np.where(chatters, window.start, qpos), np.where(chatters, covered, 0.0), np.where(chatters, ticks, 0)
        )

    def warn(self) -> None:
        """Warn, once, if a joint was found to chatter."""
        if self.found is None or self._has_warned:
            return
        self._has_warned = True
        env, joint = self.found
        warn(
            f"env {env}, joint {self._robot.joint_names[joint]!r}: its drive alternates between its effort limits from "
            f"step to step, and the joint sticks: a force at its limit is not implicit in MuJoCo, and the damping is "
            f"too large for the joint's inertia at a time step of {self._timestep:g} s; lower kd and kp, raise the "
            "effort limit, reduce the time step, give the joint armature, or use engine='sapien'",
            StabilityWarning,
        )
