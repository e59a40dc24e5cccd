"""Warnings of setpoints and start poses outside the joint limits."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.robot.description import LIMIT_TOLERANCE, RobotDescription


class SetpointWarning(UserWarning):
    """A setpoint or start pose lies outside a joint's limits."""


class SetpointCheck:
    """Check of positions against the limits of ``robot``, which warns once for each argument and joint."""

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._low, self._high = robot.lower - LIMIT_TOLERANCE, robot.upper + LIMIT_TOLERANCE
        self._warned: set[tuple[str, int]] = set()

    def check(self, argument: str, positions: NDArray[Any], stacklevel: int = 3) -> None:
        """Warn of finite ``positions`` (..., dof) [rad or m] outside the limits, ``stacklevel`` frames up."""
        below, above = positions < self._low, positions > self._high
        if not (np.count_nonzero(below) or np.count_nonzero(above)):
            return
        outside = below | above
        positions = np.where(np.isfinite(positions), positions, np.nan)
        outside &= np.isfinite(positions)
        for index in np.flatnonzero(outside.reshape(-1, self._robot.dof).any(0)).tolist():
            if (argument, index) in self._warned:
                continue
            self._warned.add((argument, index))
            joint, column = self._robot.joints[index], positions[..., index]
            worst = column.flat[np.nanargmax(np.maximum(joint.lower - column, column - joint.upper))]
            warnings.warn(
                f"{argument} of joint {joint.name!r} is {worst:g} {joint.unit}, outside its limits "
                f"[{joint.lower:g}, {joint.upper:g}]: the joint cannot reach it; move it inside",
                SetpointWarning,
                stacklevel=stacklevel,
            )
