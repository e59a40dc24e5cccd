"""State of a runner that its commands change."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.sim.loop.faults import FaultLog
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import NOTHING, Draws
from batchpid.sim.workers.contact_log import MissedContactLog

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
    contacts: MissedContactLog | None
    """None if contacts are not watched: the robots have collision shapes."""
    motion: Motion | None
    """Setpoint of the last tick and its rate, or position and velocity after a reset. None for
    other setpoints.
    """
    steps: int = 0
    steps_since_checkpoint: int = 0
    work: tuple[tuple[float, ...], int] = ((), 1)
    """Seconds of each worker in the last run, and the ticks of that run."""

    @classmethod
    def first(cls, options: RunnerOptions) -> RunnerState:
        """Return the state before the first reset, which places all envs."""
        robot = options.robot
        command = options.own_command
        count = options.num_envs
        draws = NOTHING
        if options.randomization is not None:
            draws = options.randomization.first(robot, count, options.first_env)
        names = None if command is None else command.names
        faults = FaultLog(count, robot.joint_names, options.timestep, options.on_fault, names)
        contacts = None
        if options.misses_contacts:
            nearest = lambda qpos: robot.dynamics().contacts.nearest_links(qpos)  # noqa: E731
            contacts = MissedContactLog(count, options.timestep, nearest)
        if options.sets_positions:
            motion = (np.tile(robot.start, (count, 1)), None)
        else:
            motion = None
        return cls(options.params, options.actuators, draws, faults, contacts, motion)
