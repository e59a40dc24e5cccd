"""Commands of a Runner: each makes one request to the workers, and the state of the runner after it.

A command holds checked arguments and changes nothing by itself. The runner executes its request, and then replaces its
state by the result of :meth:`RunnerCommand.committed`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64
from batchpid.checks.validate import env_mask
from batchpid.errors import InvalidArgumentError
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.custom import initial_state
from batchpid.sim.loop.snapshot import EnvStates, Snapshot, initial_actuators
from batchpid.sim.observation import untouched
from batchpid.sim.options import IDEAL, RunnerOptions
from batchpid.sim.randomization.distributions import NOTHING, Draws
from batchpid.sim.robot.run_checks import SetpointCheck
from batchpid.sim.runner_arguments import accelerated, base_rows, joint_rows
from batchpid.sim.runner_state import RunnerState
from batchpid.sim.workers.pool import Outcome
from batchpid.sim.workers.requests import Request, Reset, Restore, Run, SetActuators, SetParams, TakeSnapshot


class RunnerCommand(ABC):
    """Base of all commands, which are frozen dataclasses."""

    changes_loops = True
    """True if an error in the loops leaves them in no valid state."""

    @abstractmethod
    def request(self, state: RunnerState) -> Request:
        """Return the request to the workers for this command after ``state``."""

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        """Return the state after the command, from the state before it and the outcome in the workers."""
        return state


@dataclass(frozen=True)
class Read(RunnerCommand):
    """Read from the loops, without a change of state."""

    what: Request
    changes_loops = False

    def request(self, state: RunnerState) -> Request:
        return self.what


@dataclass(frozen=True)
class ResetEnvs(RunnerCommand):
    """Place the envs of ``mask`` (envs,) at ``qpos``, ``qvel`` (envs, dof), floating bases at ``base`` (envs, 13)."""

    mask: Bool
    qpos: Float64
    qvel: Float64
    base: Float64 | None
    draws: Draws

    @classmethod
    def read(
        cls,
        options: RunnerOptions,
        state: RunnerState,
        limits: SetpointCheck,
        pose: tuple[ArrayLike | None, ArrayLike | None],
        mask: ArrayLike | None,
        seed: int | ArrayLike | None,
        base: tuple[ArrayLike | None, ArrayLike | None],
    ) -> Self:
        """Return the command for arguments of :meth:`batchpid.sim.Runner.reset`."""
        robot, num_envs, randomization, draws = options.robot, options.num_envs, options.randomization, state.draws
        qpos = joint_rows(options, "qpos", robot.start if pose[0] is None else pose[0])
        qvel = joint_rows(options, "qvel", 0.0 if pose[1] is None else pose[1])
        chosen = np.ones(num_envs, bool) if mask is None else env_mask("mask", mask, num_envs)
        limits.check("qpos", robot.coupled(qpos), chosen)
        if randomization is not None:
            draws = randomization.redraw(robot, draws, chosen, seed, options.first_env)
            qpos, qvel = randomization.start(qpos, qvel, draws, robot)
        elif seed is not None:
            raise InvalidArgumentError("seed", "has no effect without a randomization", remedy="leave it out")
        qpos, qvel = robot.coupling.positions(qpos), robot.coupling.rates(qvel)
        return cls(chosen, qpos, qvel, base_rows(options, *base, qpos, chosen), draws)

    def request(self, state: RunnerState) -> Reset:
        return Reset(self.mask, self.qpos, self.qvel, self.draws, self.base)

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        chosen, motion = self.mask[:, None], state.motion
        if motion is not None:
            setpoint, rate = motion
            rate = np.where(chosen, self.qvel, 0.0 if rate is None else rate)
            motion = np.where(chosen, self.qpos, setpoint), rate
        faults = state.faults.without(self.mask).with_faults(outcome.present)
        return state._replace(faults=faults, draws=self.draws, motion=motion)


@dataclass(frozen=True)
class RunTicks(RunnerCommand):
    """Run the ticks of ``command`` (ticks, envs, ...), each of ``substeps`` sim steps of ``timestep`` [s]."""

    command: Command
    substeps: int
    timestep: float

    def request(self, state: RunnerState) -> Run:
        command = self.command
        if command.setpoint_rate is not None and state.motion is not None and state.params.gain_units is not None:
            command = accelerated(command, state.motion, self.substeps * self.timestep)
        return Run(len(command.setpoint), self.substeps, command)

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        setpoint, rate, *_ = self.command
        faults, contacts, motion = state.faults, state.contacts, state.motion
        count = outcome.num_ticks
        are_ok = np.logical_and.reduce(outcome.ticks.arrays.observation.ok[:count], axis=None)
        if not are_ok or contacts is not None:
            for arrays in outcome.completed:
                faults = faults.with_faults(arrays)
                contacts = None if contacts is None else contacts.with_contacts(arrays)
        if motion is not None and count:
            motion = setpoint[count - 1], None if rate is None else rate[count - 1]
        steps = count * self.substeps
        return RunnerState(  # not _replace(): it is one more Python call per tick
            state.params,
            state.actuators,
            state.draws,
            faults,
            contacts,
            motion,
            state.steps + steps,
            state.steps_since_checkpoint + steps,
            state.work if outcome.failure else (tuple(outcome.results), count),
        )


@dataclass(frozen=True)
class ChangeParams(RunnerCommand):
    """Change the params between ticks."""

    params: bp.PIDParams

    def request(self, state: RunnerState) -> SetParams:
        return SetParams(self.params)

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        return state._replace(params=self.params)


@dataclass(frozen=True)
class ChangeActuators(RunnerCommand):
    """Change the actuators between ticks."""

    actuators: bp.Actuators | None

    def request(self, state: RunnerState) -> SetActuators:
        return SetActuators(self.actuators)

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        return state._replace(actuators=self.actuators)


@dataclass(frozen=True)
class MakeSnapshot(RunnerCommand):
    """Read the state of all envs; they continue from this state."""

    def request(self, state: RunnerState) -> TakeSnapshot:
        return TakeSnapshot()

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        return state._replace(steps_since_checkpoint=0)


@dataclass(frozen=True)
class GoBack(RunnerCommand):
    """Put all envs into the state of a snapshot."""

    restore: Restore

    def request(self, state: RunnerState) -> Restore:
        return self.restore

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        snapshot = self.restore.snapshot
        return state._replace(
            params=snapshot.params,
            actuators=snapshot.actuators,
            draws=self.restore.draws,
            faults=state.faults.restored(snapshot.states.containment["step"]),
            motion=None if snapshot.motion is None else (snapshot.motion[0], snapshot.motion[1]),
            steps=snapshot.steps,
            steps_since_checkpoint=0,
        )


def snapshot_of(options: RunnerOptions, state: RunnerState, results: list[EnvStates]) -> Snapshot:
    """Return the snapshot of a runner in ``state``, with the states of its envs that the workers have read."""
    motion = None
    if state.motion is not None:
        last, rate = state.motion
        motion = np.stack([last, np.zeros_like(last) if rate is None else rate])
    episodes = None if options.randomization is None else state.draws.episodes.copy()
    about, states = options.describe(), EnvStates.join(results)
    return Snapshot(about, state.steps, state.params, states, state.actuators, episodes, motion)


def restored(options: RunnerOptions, snapshot: Snapshot, sizes: list[int]) -> Restore:
    """Return the request that restores a snapshot, checked and copied.

    ``sizes`` are the numbers of values in the engine's state of each env.
    """
    robot, randomization, draws = options.robot, options.randomization, NOTHING
    params = options.check_params(snapshot.params)
    acting = actuators = options.check_actuators(IDEAL if snapshot.actuators is None else snapshot.actuators)
    if randomization is not None and snapshot.episodes is not None:
        draws = randomization.draw(robot, snapshot.episodes)
        acting = randomization.randomized_actuators(actuators, draws, robot)
    snapshot.states.check(
        options.num_envs,
        robot.dof,
        initial_state(options, params),
        options.has_stiction(acting),
        initial_actuators(acting, options.num_envs, robot.dof, options.timestep),
        options.guard is not None,
        sizes,
        options.command.size,
        untouched(options.num_envs, options.observed),
        options.has_pushes,
    )
    return Restore(replace(snapshot, params=params, actuators=actuators), draws).copy()
