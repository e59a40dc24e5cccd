"""Warnings of setpoints and start poses outside the joint limits."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.sim.robot.description import LIMIT_TOLERANCE, RobotDescription

LISTED = 4
"""Envs that a warning lists for each joint."""


class SetpointWarning(UserWarning):
    """A setpoint or start pose lies outside a joint's limits."""


class SetpointCheck:
    """Check of positions against the limits of ``robot``, which warns once for each argument and joint."""

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._low, self._high = robot.lower - LIMIT_TOLERANCE, robot.upper + LIMIT_TOLERANCE
        self._warned: set[tuple[str, int]] = set()

    def check(
        self, argument: str, positions: NDArray[Any], envs: NDArray[np.bool_] | None = None, stacklevel: int = 3
    ) -> None:
        """Warn of finite ``positions`` (..., envs, dof) [rad or m] outside the limits, ``stacklevel`` frames up.

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
        warnings.warn(
            f"{argument} is outside the joint limits, where no joint can follow: {found}; move it inside",
            SetpointWarning,
            stacklevel=stacklevel,
        )

    def _describe(self, index: int, positions: NDArray[Any], outside: NDArray[np.bool_]) -> str:
        """Return joint, limits, worst position and envs of ``positions`` (..., envs), of which some are outside."""
        joint = self._robot.joints[index]
        beyond = np.where(outside, np.maximum(joint.lower - positions, positions - joint.upper), 0.0)
        worst = positions.flat[np.argmax(beyond)]
        envs = np.flatnonzero(outside.reshape(-1, outside.shape[-1]).any(0)).tolist()
        listed = ", ".join(map(str, envs[:LISTED])) + (f" and {len(envs) - LISTED} more" if len(envs) > LISTED else "")
        of_envs = "" if outside.shape[-1] == 1 else f" (env{'s' * (len(envs) > 1)} {listed})"
        return f"joint {joint.name!r} at {worst:g} {joint.unit}, not in [{joint.lower:g}, {joint.upper:g}]{of_envs}"
