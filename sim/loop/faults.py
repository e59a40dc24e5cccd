"""Divergence is contained: an env that fails is stopped, flagged and held or reset; the others never notice.

Envs that share a pack stay bit-identical beside one whose state is NaN, so that all there is to do is to see it in
time and to put that env back to where it can be simulated.
"""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.loop.arrays import Arrays

CAUSES = ("state", "speed", "setpoint", "setpoint_rate", "feedforward", "qpos", "qvel")
"""What can fail: the state is not finite, a joint is too fast, or what the caller gave is not finite."""

ACTIONS = ("hold", "reset")

Bool = NDArray[np.bool_]


class Fault(NamedTuple):
    """One env that was stopped."""

    env: int
    step: int
    """Sim steps from the start of the runner up to the one that failed, that one included."""
    time: float
    """The same in seconds."""
    joint: str
    """The first joint that failed."""
    cause: str
    """One of :data:`CAUSES`."""
    action: str
    """What was done: ``"hold"`` or ``"reset"``."""

    def __str__(self) -> str:
        what = {
            "state": "its state is no longer finite",
            "speed": "it is faster than speed_limit",
        }.get(self.cause, f"the {self.cause} given for it is not finite")
        done = "held until it is reset" if self.action == "hold" else "reset"
        return f"env {self.env}, joint {self.joint!r}: {what}, at step {self.step} ({self.time:g} s); {done}"


class FaultWarning(UserWarning):
    """An env failed: its state is no longer finite, or a joint is too fast."""


class FaultLog:
    """The faults of a runner's envs, as they are seen tick by tick; the first is worth a warning."""

    def __init__(self, num_envs: int, joint_names: Sequence[str], timestep: float, action: str) -> None:
        self.faults: deque[Fault] = deque(maxlen=10_000)
        self._joint_names, self._timestep, self._action = joint_names, timestep, action
        self._steps = np.full(num_envs, -1)
        self._warned = False

    def forget(self, mask: Bool) -> None:
        """Envs ``mask`` (envs,) start over."""
        self._steps[mask] = -1

    def restore(self, steps: NDArray[Any]) -> None:
        """Take these steps (envs,) of the envs' last faults as known."""
        self._steps = steps.copy()

    def note(self, arrays: Arrays, stacklevel: int = 4) -> None:
        """Add what failed since the last look."""
        fault = arrays.fault
        if arrays.observation.ok.all():
            return
        steps = fault.step.copy()
        for env in np.flatnonzero((steps >= 0) & (steps != self._steps)).tolist():
            step = int(steps[env])
            joint, cause = self._joint_names[fault.joint[env]], CAUSES[fault.cause[env]]
            self.faults.append(Fault(env, step, step * self._timestep, joint, cause, self._action))
        self._steps = steps
        if self.faults and not self._warned:
            self._warned = True
            warnings.warn(
                f"{self.faults[0]}; see runner.faults for more, of which there is no further warning",
                FaultWarning,
                stacklevel=stacklevel,
            )


class Containment:
    """Which of the M envs of a pack have failed, where they are held, and where each starts over.

    ``flagged`` (M,) are the envs that failed in this tick or are stopped; ``step`` (-1: none), ``joint`` and ``cause``
    tell of each env's last fault; positions and velocities are (M, dof).
    """

    def __init__(self, size: int, dof: int, action: str, speed_limit: NDArray[np.float64] | None) -> None:
        self.holds, self.speed_limit = action == "hold", speed_limit
        self.stopped: Bool = np.zeros(size, bool)
        self.flagged: Bool = np.zeros(size, bool)
        self.home_qpos, self.home_qvel, self.held_qpos = (np.zeros((size, dof)) for _ in range(3))
        self.step = np.full(size, -1)
        self.joint, self.cause = np.zeros(size, int), np.zeros(size, int)
        self._failed: Bool = np.zeros(size, bool)

    def start(self, mask: Bool, sound: Bool, qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> None:
        """Envs ``mask`` start over; those of ``sound`` at ``qpos``, ``qvel``, the others where they did last."""
        self.home_qpos[sound], self.home_qvel[sound] = qpos[sound], qvel[sound]
        self.stopped[mask] = self.flagged[mask] = False
        self.step[mask] = -1

    def fail(self, bad: Bool, cause: str, step: int, held: NDArray[np.float64]) -> None:
        """Envs with a True entry in ``bad`` (M, dof) failed; where envs are held, they are at ``held``."""
        failed = bad.any(1)
        if not failed.any():
            return
        new = failed & ~self.flagged
        self.step[new], self.joint[new], self.cause[new] = step, bad.argmax(1)[new], CAUSES.index(cause)
        self.flagged |= failed
        self._failed |= failed
        if self.holds:
            self.held_qpos[new] = np.where(np.isfinite(held), held, self.home_qpos)[new]
            self.stopped |= failed

    def take_failed(self) -> Bool:
        """The envs that failed since this was last asked."""
        failed, self._failed = self._failed, np.zeros_like(self._failed)
        return failed

    def read(self) -> dict[str, NDArray[Any]]:
        """All that is to be kept, one row per env."""
        return {name: getattr(self, name).copy() for name in _KEPT}

    def write(self, tables: dict[str, NDArray[Any]]) -> None:
        """Take what :meth:`read` gave."""
        for name in _KEPT:
            getattr(self, name)[...] = tables[name]


_KEPT = ("stopped", "flagged", "home_qpos", "home_qvel", "held_qpos", "step", "joint", "cause")


def finite(*arrays: NDArray[Any] | None) -> bool:
    """Whether all entries are finite, and not huge, in one pass: a sum of squares is NaN or inf if one is not."""
    return all(array is None or math.isfinite(np.vdot(array, array)) for array in arrays)
