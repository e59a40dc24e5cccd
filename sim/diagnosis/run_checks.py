"""Warnings of setpoints outside the limits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Rows
from batchpid.errors import warn
from batchpid.sim.findings import LIMIT_TOLERANCE

if TYPE_CHECKING:
    from batchpid.sim.robot.robot import Robot


class SetpointWarning(UserWarning):
    """A setpoint or start pose lies outside a joint's limits."""


class SetpointCheck:
    """Check of positions against the limits of ``robot``, which warns once for each argument and
    joint.
    """

    def __init__(self, robot: Robot) -> None:
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
