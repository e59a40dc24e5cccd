r"""Warnings of a run: setpoints outside the limits, or moving without rates under gains that lag; drives that chatter.

In MuJoCo a stiff drive may chatter between its effort limits. MuJoCo integrates a drive's damping implicitly, but a
force at its limit is a constant, so that a drive that saturates acts as an explicit one. With inertia I, joint damping
b, effort limit L and time step dt, a force that alternates between L and -L keeps a joint where it is, at velocities
that alternate between w and -w::

    (I + dt b) w = -I w + dt L        so that        w = dt L / (2 I + dt b)

Such a drive, with damping d = kd + dt kp, keeps alternating if it passes from one limit to the other within a step:
d w > L, or d dt / (2 I + dt b) > 1, which is the stability bound of the explicit law. The joint then sticks wherever
the error is at most (d w - L) / kp. (This is also so for MuJoCo's own servos with ``forcerange``.)
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.checks.warn import warn
from batchpid.sim.observation import Observation
from batchpid.sim.robot.description import LIMIT_TOLERANCE, RobotDescription
from batchpid.sim.robot.loop_stability import StabilityWarning

LISTED = 4
"""Envs that a warning lists for each joint."""
LAG, MOVING = 0.05, 0.5
"""Lag above which a moving setpoint needs its rate, and how long it moves until a warning [s]."""


class SetpointWarning(UserWarning):
    """A setpoint or start pose lies outside a joint's limits."""


class MovingSetpointWarning(UserWarning):
    """Setpoints move in every tick, without rates, under gains that follow such a motion with a lag."""


class SetpointCheck:
    """Check of positions against the limits of ``robot``, which warns once for each argument and joint."""

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._low, self._high = robot.lower - LIMIT_TOLERANCE, robot.upper + LIMIT_TOLERANCE
        self._warned: set[tuple[str, int]] = set()

    def check(self, argument: str, positions: Rows, envs: NDArray[np.bool_] | None = None) -> None:
        """Warn of finite ``positions`` (..., envs, dof) [rad or m] outside the limits.

        One warning names all joints, each with its worst position and its envs; ``envs`` (envs,) masks those to check.
        """
        outside = (positions < self._low) | (positions > self._high)
        if not np.logical_or.reduce(outside, axis=None):  # outside.any() takes a call of Python
            return
        outside &= np.isfinite(positions)
        if envs is not None:
            outside &= envs[:, None]
        new = [
            joint
            for joint in np.flatnonzero(outside.reshape(-1, self._robot.dof).any(0)).tolist()
            if (argument, joint) not in self._warned
        ]
        if not new:
            return
        self._warned.update((argument, joint) for joint in new)
        found = "; ".join(self._describe(joint, positions[..., joint], outside[..., joint]) for joint in new)
        warn(
            f"{argument} is outside the joint limits, where no joint can follow: {found}; move it inside",
            SetpointWarning,
        )

    def _describe(self, index: int, positions: Rows, outside: NDArray[np.bool_]) -> str:
        """Return joint, limits, worst position and envs of ``positions`` (..., envs), of which some are outside."""
        joint = self._robot.joints[index]
        beyond = np.where(outside, np.maximum(joint.lower - positions, positions - joint.upper), 0.0)
        worst = positions.flat[np.argmax(beyond)]
        envs = np.flatnonzero(outside.reshape(-1, outside.shape[-1]).any(0)).tolist()
        listed = ", ".join(map(str, envs[:LISTED])) + (f" and {len(envs) - LISTED} more" if len(envs) > LISTED else "")
        of_envs = "" if outside.shape[-1] == 1 else f" (env{'s' * (len(envs) > 1)} {listed})"
        return f"joint {joint.name!r} at {worst:g} {joint.unit}, not in [{joint.lower:g}, {joint.upper:g}]{of_envs}"


class MovingSetpointCheck:
    """Check for setpoints that move without rates under gains with a large lag. It warns once.

    A joint's lag is kp (1 - b) / ki: with setpoint weight b, the integral alone follows a ramp. Setpoints move in a
    tick if they change by no more than the velocity limits allow; larger changes are steps.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self._robot, self._fastest = robot, robot.velocity_limit
        self._lag: NDArray[np.float64] | None = None
        self._last: NDArray[np.float64] | None = None
        self._moved: Any = 0.0  # seconds, of each env
        self._has_warned = False
        self.found: int | None = None
        """Joint with such a setpoint, once there is one; no other is looked for."""

    @property
    def is_watching(self) -> bool:
        """False where no joint lags, and after the warning: :meth:`see` then has nothing to find."""
        return self._lag is not None and not self._has_warned

    def set_params(self, params: bp.PIDParams) -> None:
        """Find the lags of these gains."""
        self._lag, b, ki = None, params.setpoint_weight, params.ki
        if b is None or ki is None or self.found is not None:
            return
        lag = np.max(params.kp * (1 - b) / np.where(ki > 0, ki, np.inf), axis=0)
        self._lags = lag > LAG
        if self._lags.any():
            self._lag = np.broadcast_to(lag, (self._robot.dof,))

    def see(self, setpoints: NDArray[np.float64], rated: bool, seconds: float) -> None:
        """Look at the setpoints of ticks (ticks, envs, dof) of ``seconds`` each, which are ``rated`` or not."""
        if self._lag is None or self.found is not None:
            return
        if rated:
            self._last, self._moved = None, 0.0
            return
        for rows in setpoints:
            last, self._last = self._last, rows
            if last is None:
                continue
            reduce = np.logical_or.reduce  # methods of arrays take calls of Python
            if not reduce(rows != last, None):
                self._moved = 0.0
                continue
            change = np.abs(rows - last)
            moves = reduce((change > 0) & self._lags, axis=1)
            moves &= ~reduce(change > self._fastest * seconds, axis=1)
            self._moved = (self._moved + seconds) * moves
            long = self._moved >= MOVING
            if reduce(long):
                self.found = int(np.where(change[long][0] > 0, self._lag, 0.0).argmax())
                return

    def warn(self) -> None:
        """Warn of the setpoints that were found, if there are some, and only once."""
        if self.found is None or self._has_warned:
            return
        assert self._lag is not None
        self._has_warned = True
        joint, lag = self._robot.joint_names[self.found], self._lag[self.found]
        warn(
            f"setpoint moves in every tick without its rate: under these gains joint {joint!r} follows {1e3 * lag:.0f} "
            "ms behind (kp (1 - b) / ki); pass setpoint_rate, such as the change over a tick by the tick, or use gains "
            "with setpoint_weight=1",
            MovingSetpointWarning,
        )


DURATION, TICKS = 0.1, 12
"""Time [s] and number of ticks for which a joint must chatter before a warning."""
_FASTEST, _SLOWEST = 1.5, 0.5
"""Velocities of a chattering joint, as shares of w: other joints change its inertia."""
_PROGRESS = 0.1
"""Largest share of the distance at these velocities that a chattering joint moves."""


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
        self._seen: tuple[Float64, Float64, NDArray[np.int64]] | None = None
        """Of every joint since it began to look like chatter (envs, dof): its position at the beginning [rad or m], the
        distance that it would have moved at the magnitudes of its velocities, and ticks."""
        self.found: tuple[int, int] | None = None
        """Env and joint that chatters."""
        self._has_warned = False

    def set_gains(self, params: bp.PIDParams, actuators: bp.Actuators | None) -> None:
        """Find the joints that may chatter with these gains, effort limits and armature."""
        self._speed = self._seen = None
        kp, kd = (np.zeros((1, self._robot.dof)) if leaf is None else leaf for leaf in (params.kp, params.kd))
        armature = None if actuators is None else actuators.armature
        least = 0.0 if armature is None else armature.min(0)
        robot, coupling = self._robot, self._robot.coupling
        matrix = coupling.reduced(robot.mass_matrix(robot.start) + least * np.eye(robot.dof))[0]
        matrix = matrix + 0.5 * self._timestep * np.diag(coupling.reduced_damping(robot.damping))
        try:
            inertia = coupling.of_all(1 / np.diagonal(np.linalg.inv(matrix)))
        except np.linalg.LinAlgError:
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
        """Check the ticks (ticks, envs, ...) of ``observation``, each of ``seconds``."""
        if self._speed is None or self._has_warned:
            return
        for tick in range(len(observation.ok)):
            qpos, speed = observation.qpos[tick].astype(float), np.abs(observation.qvel[tick]).astype(float)
            alike = (speed > _SLOWEST * self._speed) & (speed < _FASTEST * self._speed)
            self._advance(qpos, speed * seconds, alike & observation.ok[tick][:, None], seconds)

    def _advance(self, qpos: Float64, distance: Float64, alike: Bool, seconds: float) -> None:
        start, covered, ticks = self._seen or (qpos, np.zeros_like(qpos), np.zeros(qpos.shape, int))
        covered, ticks = covered + distance, ticks + 1
        chatters = alike & ((np.abs(qpos - start) < _PROGRESS * covered) | (ticks < TICKS))
        long = chatters & (ticks >= TICKS) & (ticks * seconds >= DURATION)
        if self.found is None and long.any():
            env, joint = np.argwhere(long)[0]
            self.found = int(env), int(joint)
        self._seen = np.where(chatters, start, qpos), np.where(chatters, covered, 0.0), np.where(chatters, ticks, 0)

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
