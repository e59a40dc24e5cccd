"""Warnings of a run: setpoints outside the limits, or moving without rates under gains that lag."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Rows
from batchpid.checks.warn import warn
from batchpid.sim.robot.description import LIMIT_TOLERANCE, RobotDescription

LISTED = 4
"""Envs that a warning lists for each joint."""
LAG, MOVING = 0.05, 0.5
"""Lag above which a moving setpoint needs its rate, and how long it moves until a warning [s]."""


class SetpointWarning(UserWarning):
    """A setpoint or start pose lies outside a joint's limits."""


class MovingSetpointWarning(UserWarning):
    """Setpoints move in every tick, without rates, under gains that follow such a motion with a
    lag.
    """


class SetpointCheck:
    """Check of positions against the limits of ``robot``, which warns once for each argument and
    joint.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._low, self._high = robot.lower - LIMIT_TOLERANCE, robot.upper + LIMIT_TOLERANCE
        self._warned: set[tuple[str, int]] = set()

    def check(self, argument: str, positions: Rows, envs: NDArray[np.bool_] | None = None) -> None:
        """Warn of finite ``positions`` (..., envs, dof) [rad or m] outside the limits.

        One warning names all joints, each with its worst position and its envs; ``envs`` (envs,)
        masks those to check.
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
        found = "; ".join(
            self._describe(joint, positions[..., joint], outside[..., joint]) for joint in new
        )
        warn(
            f"{argument} is outside the joint limits, where no joint can follow: {found}; move it"
            " inside",
            SetpointWarning,
        )

    def _describe(self, index: int, positions: Rows, outside: NDArray[np.bool_]) -> str:
        """Return joint, limits, worst position and envs of ``positions`` (..., envs), of which some
        are outside.
        """
        joint = self._robot.joints[index]
        beyond = np.where(
            outside, np.maximum(joint.lower - positions, positions - joint.upper), 0.0
        )
        worst = positions.flat[np.argmax(beyond)]
        envs = np.flatnonzero(outside.reshape(-1, outside.shape[-1]).any(0)).tolist()
        listed = ", ".join(map(str, envs[:LISTED])) + (
            f" and {len(envs) - LISTED} more" if len(envs) > LISTED else ""
        )
        of_envs = "" if outside.shape[-1] == 1 else f" (env{'s' * (len(envs) > 1)} {listed})"
        return (
            f"joint {joint.name!r} at {worst:g} {joint.unit}, not in [{joint.lower:g},"
            f" {joint.upper:g}]{of_envs}"
        )


class MovingSetpointCheck:
    """Check for setpoints that move without rates under gains with a large lag. It warns once.

    A joint's lag is kp (1 - b) / ki: with setpoint weight b, the integral alone follows a ramp.
    Setpoints move in a tick if they change by no more than the velocity limits allow; larger
    changes are steps.
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
        """False where no joint lags, and after the warning: :meth:`see` then has nothing to
        find.
        """
        return self._lag is not None and not self._has_warned

    def set_params(self, params: bp.PIDParams) -> None:
        """Find the lags of these gains."""
        self._lag = None
        b = params.setpoint_weight
        ki = params.ki
        if b is None or ki is None or self.found is not None:
            return
        lag = np.max(params.kp * (1 - b) / np.where(ki > 0, ki, np.inf), axis=0)
        self._lags = lag > LAG
        if self._lags.any():
            self._lag = np.broadcast_to(lag, (self._robot.dof,))

    def see(self, setpoints: NDArray[np.float64], rated: bool, seconds: float) -> None:
        """Look at the setpoints of ticks (ticks, envs, dof) of ``seconds`` each, which are
        ``rated`` or not.
        """
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
            f"setpoint moves in every tick without its rate: under these gains joint {joint!r}"
            f" follows {1e3 * lag:.0f} ms behind (kp (1 - b) / ki); pass setpoint_rate, such as the"
            " change over a tick by the tick, or use gains with setpoint_weight=1",
            MovingSetpointWarning,
        )
