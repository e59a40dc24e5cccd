"""Warnings of a run: setpoints outside the limits, or moving without rates under gains that lag."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.errors import warn
from batchpid.sim.robot.description import LIMIT_TOLERANCE, RobotDescription

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
        self._low = robot.lower - LIMIT_TOLERANCE
        self._high = robot.upper + LIMIT_TOLERANCE
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
        sentences = []
        for joint in np.flatnonzero(outside.reshape(-1, self._robot.dof).any(0)).tolist():
            if (argument, joint) not in self._warned:
                self._warned.add((argument, joint))
                sentences.append(self._describe(joint, positions[..., joint], outside[..., joint]))
        if sentences:
            warn(
                f"{argument} is outside the joint limits, where no joint can follow:"
                f" {'; '.join(sentences)}; move it inside",
                SetpointWarning,
            )

    def _describe(self, index: int, positions: Rows, outside: NDArray[np.bool_]) -> str:
        """Return joint, limits, worst position and envs of ``positions`` (..., envs)."""
        joint = self._robot.joints[index]
        excess = np.where(
            outside,
            np.abs(positions - (joint.lower + joint.upper) / 2),
            0.0,
        )
        worst = positions.flat[np.argmax(excess)]
        place = f"joint {joint.name!r} at {worst:g} {joint.unit}"
        limits = f"[{joint.lower:g}, {joint.upper:g}]"
        size = outside.shape[-1]
        if size == 1:
            return f"{place}, not in {limits}"
        env = int(outside.reshape(-1, size).any(0).argmax())
        return f"{place}, not in {limits} (env {env} first)"


class MovingSetpointCheck:
    """Check for setpoints that move without rates under gains with a large lag. It warns once.

    A joint's lag is kp (1 - b) / ki: with setpoint weight b, the integral alone follows a ramp.
    Setpoints move in a tick if they change by no more than the velocity limits allow; larger
    changes are steps.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._fastest = robot.velocity_limit
        self._lag: Float64 = np.zeros(robot.dof)
        self._last: Float64 | None = None
        self._moved: Any = 0.0  # seconds, of each env
        self._has_warned = False
        self.is_watching = False
        """False where no joint lags, and after the warning: :meth:`see` then finds nothing."""

    def set_params(self, params: bp.PIDParams) -> None:
        """Find the lags of these gains."""
        b = params.setpoint_weight
        ki = params.ki
        self._lag = np.zeros(self._robot.dof)
        if b is not None and ki is not None:
            self._lag += np.max(params.kp * (1 - b) / np.where(ki > 0, ki, np.inf), axis=0)
        self.is_watching = not self._has_warned and bool((self._lag > LAG).any())

    def see(self, setpoints: Float64, rated: bool, seconds: float) -> None:
        """Check the setpoints of ticks (ticks, envs, dof) of ``seconds`` each; warn of moving
        setpoints without rates (``rated`` False).
        """
        if not self.is_watching:
            return
        # Rates tell the law where the setpoint goes.
        if rated:
            self._last = None
            self._moved = 0.0
            return
        reduce = np.logical_or.reduce  # methods of arrays take calls of Python
        for rows in setpoints:
            last = self._last
            self._last = rows
            if last is None:
                continue
            if not reduce(rows != last, None):
                self._moved = 0.0
                continue
            change = np.abs(rows - last)
            moves = reduce((change > 0) & (self._lag > LAG), axis=1)
            moves &= ~reduce(change > self._fastest * seconds, axis=1)
            self._moved = (self._moved + seconds) * moves
            if reduce(self._moved >= MOVING):
                self._warn(change[self._moved >= MOVING][0] > 0)
                return

    def _warn(self, moves: Bool) -> None:
        """Warn of the joint with the largest lag of those that move (dof,)."""
        self._has_warned = True
        self.is_watching = False
        joint = int(np.where(moves, self._lag, 0.0).argmax())
        warn(
            "setpoint moves in every tick without its rate: under these gains joint"
            f" {self._robot.joint_names[joint]!r} follows {1e3 * self._lag[joint]:.0f} ms behind"
            " (kp (1 - b) / ki); pass setpoint_rate, such as (setpoint - last setpoint) / tick, or"
            " use gains with setpoint_weight=1",
            MovingSetpointWarning,
        )
