"""State of a runner that its commands change."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.faults import CAUSES, COMMAND_CAUSES, Fault, FaultLog
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import NOTHING, Draws

ALL = slice(None)
"""All envs."""
Motion = tuple[Float64, Float64 | None]
"""Setpoints of joints and their rates (envs, dof); None for 0."""


class RunnerState(NamedTuple):
    """Everything about a runner that its commands change, apart from the workers. Replaced once by
    each command.
    """

    params: bp.PIDParams
    actuators: bp.Actuators | None
    draws: Draws
    faults: FaultLog
    motion: Motion | None
    """Setpoint of the last tick and its rate, or position and velocity after a reset. None for
    other setpoints.
    """
    steps: int = 0
    steps_since_checkpoint: int = 0
    work: tuple[tuple[float, ...], int] = ((), 1)
    """Seconds of each worker in the last run, and the ticks of that run."""
    changes: Rows | None = None
    """Changes of each env since the last tick (envs,): :attr:`batchpid.sim.Rollout.changes`."""

    def changed(self, change: int, envs: Bool | slice = ALL, **values: Any) -> RunnerState:
        """Return a state with other ``values``, which notes a ``change`` of some envs."""
        changes = np.zeros(len(self.faults), np.uint8) if self.changes is None else self.changes
        changes = changes.copy()
        changes[envs] |= change
        return self._replace(changes=changes, **values)

    @classmethod
    def first(cls, options: RunnerOptions) -> RunnerState:
        """Return the state before the first reset, which places all envs."""
        robot = options.robot
        count = options.num_envs
        draws = NOTHING
        if options.randomization is not None:
            draws = options.randomization.first(robot, count, options.first_env)
        faults = FaultLog(count, partial(_fault, options))
        motion = None
        if options.sets_positions:
            motion = (np.tile(robot.start, (count, 1)), None)
        return cls(options.params, options.actuators, draws, faults, motion)


def _fault(options: RunnerOptions, env: int, arrays: Arrays) -> Fault:
    """Return the last fault of an env in the arrays of a tick."""
    step = int(arrays.fault.step[env])
    cause = CAUSES[arrays.fault.cause[env]]
    command = options.own_command
    kind, names = "joint", options.robot.joint_names
    if command is not None and cause in COMMAND_CAUSES:
        kind, names = "entry", command.names
    joint = names[arrays.fault.joint[env]]
    return Fault(env, step, step * options.timestep, joint, cause, options.on_fault, kind)
