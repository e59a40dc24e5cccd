"""Faults of single envs: detected, reported, and contained, while the other envs are bit-identical
to a run without.

Envs that share a pack are not influenced by one whose state is NaN. So containment is to notice a
fault in time, and to put that env into a state from which it can be simulated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.sim.engine.native import FARTHEST
from batchpid.sim.engine.protocol import BASE_AT_REST, EnginePack
from batchpid.sim.loop.arrays import Arrays, FaultArrays
from batchpid.sim.options.options import RunnerOptions
from batchpid.stages.values import Command

CAUSES = ("state", "effort", *Command._fields)
"""Causes of faults: the state is not finite or a position beyond :data:`FARTHEST`, or the array of
that name was not finite. "effort" is the effort that the caller's own controller returned.
"""
MOST_EVENTS = 10_000
"""Largest number of faults that a runner keeps."""
NO_STEP = -1
"""Sim step of the last fault of an env that has none."""


class Fault(NamedTuple):
    """Fault of one env."""

    env: int
    step: int
    """Sim steps from the start of the runner up to and including the one that failed."""
    time: float
    """Time of that step [s]."""
    joint: str
    """First joint that failed, or first entry of a command that is not finite."""
    cause: str
    """One of :data:`CAUSES`."""
    action: str
    """``on_fault`` of the runner: "hold" or "reset"."""

    def __str__(self) -> str:
        texts = {
            "state": f"its state is not finite, or a position is beyond {FARTHEST:,.0f} rad or m",
            "effort": "the effort that its controller returned is not finite",
        }
        cause = texts.get(self.cause, f"its {self.cause} is not finite")
        if self.action == "hold":
            action = "held until it is reset"
        else:
            action = "reset"
        return (
            f"env {self.env}, {self.joint!r}: {cause}, at step {self.step}"
            f" ({self.time:g} s); {action}"
        )


class FaultWarning(UserWarning):
    """An env failed: its state is not finite, or a position is beyond :data:`FARTHEST`."""


class FaultContainment:
    """Last fault of each of M envs, and the state in which a failed env goes on.

    Attributes
    ----------
    suspends
        Whether failed envs are suspended; otherwise they are reset.
    suspended, failed
        Envs that are suspended, and those that failed in this tick or are suspended (M,).
    start_qpos, start_qvel, suspended_qpos
        State to which each env is reset, and pose in which it is suspended (M, dof).
    start_base
        Pose and twist of the base (M, 13) to which each env is reset, and where it is suspended;
        unused on fixed ones.
    rows
        Last faults (M,).
    """

    def __init__(self, size: int, options: RunnerOptions) -> None:
        self._options = options
        self.suspends = options.on_fault == "hold"
        self.suspended, self.failed, self._unplaced = (np.zeros(size, bool) for _ in range(3))
        self.start_qpos, self.start_qvel, self.suspended_qpos = np.zeros(
            (3, size, options.robot.dof)
        )
        self.start_base = np.tile(BASE_AT_REST, (size, 1))
        self.rows = FaultArrays(np.full(size, NO_STEP), *np.zeros((2, size), int))

    def begin_tick(self) -> bool:
        """Forget the failures of the last tick; return whether no env is suspended."""
        self.failed[...] = self.suspended
        return not np.count_nonzero(self.suspended)

    def clear(self, mask: Bool) -> None:
        """Clear the faults of the envs of ``mask`` (M,), which are reset."""
        self.suspended[mask] = self.failed[mask] = False
        self.rows.step[mask] = NO_STEP

    def take_starts(
        self,
        mask: Bool,
        qpos: Float64,
        qvel: Float64,
        base: Float64 | None,
    ) -> None:
        """Take the states (M, ...) to which the envs of ``mask`` (M,) are reset."""
        self.start_qpos[mask], self.start_qvel[mask] = qpos[mask], qvel[mask]
        if base is not None:
            self.start_base[mask] = base[mask]

    def contained(self, command: Command, step: int, qpos: Float64) -> Command:
        """Record a fault in sim step ``step`` of the envs whose commands are not finite; return the
        command with neutral values for all failed envs, which are at ``qpos`` (M, dof).
        """
        for cause, rows in command._asdict().items():
            self.fail(~np.isfinite(rows), cause, step, qpos)
        options = self._options
        setpoint = qpos if options.sets_positions else options.command.neutral
        neutral = Command(setpoint, 0.0, 0.0, 0.0)
        failed = self.failed[:, None]
        return Command(*map(np.where, [failed] * len(neutral), neutral, command))

    def places(self) -> tuple[Float64, Float64]:
        """Return positions and velocities (M, dof) in which failed envs go on: suspended, or at
        their start.
        """
        if self.suspends:
            return self.suspended_qpos, np.zeros_like(self.start_qvel)
        return self.start_qpos, self.start_qvel

    def fail(
        self,
        bad: Bool,
        cause: str,
        step: int,
        qpos: NDArray[np.float64],
    ) -> None:
        """Record a fault of the envs with a True entry in ``bad`` (M, dof); suspended envs stay at
        ``qpos`` (M, dof).
        """
        failed = bad.any(1)
        if not failed.any():
            return
        # The first fault of an env in a tick is the one that counts.
        new = failed & ~self.failed
        self.rows.step[new] = step
        self.rows.joint[new] = bad.argmax(1)[new]
        self.rows.cause[new] = CAUSES.index(cause)
        self.failed |= failed
        self._unplaced |= failed
        if self.suspends:
            self.suspended_qpos[new] = np.where(np.isfinite(qpos), qpos, self.start_qpos)[new]
            self.suspended |= failed

    def fail_state(
        self,
        pack: EnginePack,
        step: int,
        before: Float64,
        returned: Float64 | None,
    ) -> None:
        """Record the faults of envs whose state is not finite or too far after sim step ``step``;
        ``before`` are the positions before it (M, dof).

        ``returned`` is the effort of the caller's own controller, within the limits; or None.
        """
        # The comparison is also false for NaN.
        qpos = pack.read_qpos()
        qvel = pack.read_qvel()
        bad = ~(np.abs(qpos) <= FARTHEST) | ~np.isfinite(qvel) | pack.strays()[:, None]
        failed = bad.any(1, keepdims=True)
        if returned is not None:
            # One step after a NaN effort at one joint, all joints are NaN. Actuators may have
            # delayed it.
            wrong = ~np.isfinite(returned) | ~np.isfinite(pack.qf)
            self.fail(wrong & failed, "effort", step, before)
        self.fail(bad, "state", step, before)

    def pop_unplaced(self) -> Bool:
        """Return the envs that failed since the last call (M,), which are to be placed."""
        unplaced = self._unplaced
        # A new array, since the caller keeps the old one.
        self._unplaced = np.zeros_like(self._unplaced)
        return unplaced

    def observe(self, rows: Arrays) -> None:
        """Write the faults into the rows of a tick, and the observation of suspended envs."""
        observation = rows.observation
        observation.ok[...] = ~self.failed
        for table, faults in zip(rows.fault, self.rows, strict=True):
            table[...] = faults
        if not (envs := self.suspended).any():
            return
        observation.qpos[envs] = self.suspended_qpos[envs]
        observation.qvel[envs] = observation.effort[envs] = 0
        observation.saturated[envs] = observation.guarded[envs] = False
        if observation.base_twist is not None:
            observation.base_twist[envs] = 0

    @property
    def state(self) -> dict[str, Rows]:
        """Arrays that a snapshot holds (M, ...), by name."""
        names = "suspended", "failed", "start_qpos", "start_qvel", "start_base", "suspended_qpos"
        return {name: getattr(self, name) for name in names} | self.rows._asdict()


def is_near(qpos: NDArray[np.float64]) -> bool:
    """Return whether all positions are certainly finite and below :data:`FARTHEST`, in one pass.

    The sum of squares may be larger although each position is near.
    """
    return bool(np.vdot(qpos, qpos) <= FARTHEST**2)


def are_finite(*arrays: Rows) -> bool:
    """Return whether all entries are finite and below 1e150, in one pass: otherwise a sum of
    squares is inf or NaN.
    """
    for array in arrays:  # noqa: SIM110
        if not math.isfinite(np.vdot(array, array)):
            return False
    return True
