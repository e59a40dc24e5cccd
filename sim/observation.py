"""What a runner tells of its envs: after a tick, and over a rollout."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]


class Observation(NamedTuple):
    """State of every env after a tick. (envs, dof) in the robot's joint order, ``ok`` (envs,).

    ``qpos`` [rad or m], ``qvel`` [rad/s or m/s]; ``effort`` [N m or N] and ``saturated`` as applied in the last
    substep (under control "drive" the effort is the qf beside the drive, which PhysX keeps to itself).
    ``ok`` is False for an env that failed in this tick, or is held since it did: see :attr:`Runner.faults`.
    """

    qpos: Float32
    qvel: Float32
    effort: Float32
    saturated: Bool
    ok: Bool


class Rollout(NamedTuple):
    """Observations of a rollout, stacked: (ticks, envs, dof), ``ok`` (ticks, envs), ``time`` (ticks,) [s].

    Row k is the state at the end of tick k, at ``time[k]``.
    """

    time: NDArray[np.float64]
    setpoint: NDArray[np.float64]
    qpos: Float32
    qvel: Float32
    effort: Float32
    saturated: Bool
    ok: Bool

    def envs(self, envs: slice | Any) -> Rollout:
        """The rollout of some envs (a slice or an index array)."""
        return Rollout._make([self.time, *(field[:, envs] for field in self[1:])])
