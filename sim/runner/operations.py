"""Operations of a Runner: the change of each worker's loop, and the state of the runner after it.

An operation holds checked arguments for all envs and changes nothing by itself. The runner sends it
to the workers, and then replaces its state by the result of :meth:`Operation.committed`.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from operator import itemgetter
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.arrays.trees import flatten
from batchpid.checks.validate import env_mask
from batchpid.errors import InvalidArgumentError
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.group_control import empty_states
from batchpid.sim.loop.loop import Loop
from batchpid.sim.loop.snapshot import Snapshot, join_rows
from batchpid.sim.options.options import IDEAL, RunnerOptions
from batchpid.sim.randomization.distributions import NOTHING, Draws
from batchpid.sim.rollout import ACTUATORS, PARAMS, RESET, RESTORE
from batchpid.sim.runner.arguments import base_rows, joint_rows
from batchpid.sim.runner.runner_state import RunnerState
from batchpid.sim.workers.pool import Outcome
from batchpid.sim.workers.requests import Request
from batchpid.stages.stage import by_name
from batchpid.stages.values import Command


class Operation(Request):
    """Base of all operations, which are frozen dataclasses."""

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        """Return the state after the operation, from the state before it and the outcome in the
        workers.
        """
        return state


@dataclass(frozen=True)
class Reset(Operation):
    """Place the envs of ``mask`` (envs,) at ``qpos``, ``qvel`` (envs, dof), floating bases at
    ``base`` (envs, 13).
    """

    mask: Bool
    qpos: Float64
    qvel: Float64
    draws: Draws
    base: Float64 | None
    ticks = 1

    @property
    def placed(self) -> Bool:
        return self.mask

    @classmethod
    def read(
        cls,
        options: RunnerOptions,
        state: RunnerState,
        pose: tuple[ArrayLike | None, ArrayLike | None],
        mask: ArrayLike | None,
        seed: int | ArrayLike | None,
        base: Mapping[str, ArrayLike | None],
    ) -> Self:
        """Return the operation for arguments of :meth:`batchpid.sim.Runner.reset`."""
        robot = options.robot
        num_envs = options.num_envs
        randomization = options.randomization
        draws = state.draws
        qpos = joint_rows(options, "qpos", robot.start if pose[0] is None else pose[0])
        qvel = joint_rows(options, "qvel", 0.0 if pose[1] is None else pose[1])
        if mask is None:
            chosen = np.ones(num_envs, bool)
        else:
            chosen = env_mask("mask", mask, num_envs)
        if randomization is not None:
            draws = randomization.redraw(robot, draws, chosen, seed, options.first_env)
            qpos, qvel = randomization.start(qpos, qvel, draws, robot)
        elif seed is not None:
            raise InvalidArgumentError(
                "seed", "has no effect without a randomization", remedy="leave it out"
            )
        qpos = robot.coupling.positions(qpos)
        qvel = robot.coupling.rates(qvel)
        return cls(chosen, qpos, qvel, draws, base_rows(options, base, qpos, chosen))

    def apply(self, loop: Loop) -> None:
        loop.reset(self.mask, self.qpos, self.qvel, self.draws, self.base)

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        chosen = self.mask[:, None]
        motion = state.motion
        if motion is not None:
            setpoint, rate = motion
            rate = np.where(chosen, self.qvel, 0.0 if rate is None else rate)
            motion = np.where(chosen, self.qpos, setpoint), rate
        faults = state.faults.without(self.mask).with_events(outcome.at(0))
        return state.changed(RESET, self.mask, faults=faults, draws=self.draws, motion=motion)


@dataclass(frozen=True)
class Run(Operation):
    """Run ``ticks`` of ``substeps`` sim steps under ``command`` (ticks, envs, ...), which travels
    in the arrays.
    """

    ticks: int = field()  # without the default of the base class
    substeps: int = field()
    command: Command = field()
    counts_ticks = True

    def for_envs(self, envs: slice) -> Self:
        return replace(self, command=self.command.map(itemgetter((slice(None), envs))))

    def write(self, arrays: Arrays, envs: slice) -> None:
        for table, rows in zip(arrays.command, self.command, strict=True):
            if rows is not None:
                table[: self.ticks, envs] = rows[:, envs]

    def encode(self, envs: slice) -> bytes:
        return pickle.dumps((self.ticks, self.substeps, self.command.given))

    def apply(self, loop: Loop) -> float:
        return loop.run(self.ticks, self.substeps, self.command.given)

    def join(self, results: list[float]) -> float:
        return max(results)

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        setpoint, rate, *_ = self.command
        faults = state.faults
        motion = state.motion
        count = outcome.num_ticks
        are_ok = np.logical_and.reduce(outcome.arrays.observation.ok[:count], axis=None)
        if not are_ok:
            for arrays in outcome.completed:
                faults = faults.with_events(arrays)
        if motion is not None and count:
            motion = setpoint[count - 1], None if rate is None else rate[count - 1]
        steps = count * self.substeps
        if outcome.failure:
            work = state.work
        else:
            work = (tuple(outcome.results), count)
        since = state.steps_since_checkpoint + steps
        changes = None if count else state.changes
        return state._replace(
            faults=faults,
            motion=motion,
            steps=state.steps + steps,
            steps_since_checkpoint=since,
            work=work,
            changes=changes,
        )


@dataclass(frozen=True)
class SetParams(Operation):
    """Change gains, limits and times between ticks."""

    params: bp.PIDParams

    def apply(self, loop: Loop) -> None:
        loop.set_params(self.params)

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        return state.changed(PARAMS, params=self.params)


@dataclass(frozen=True)
class SetActuators(Operation):
    """Change the actuators between ticks; None removes them."""

    actuators: bp.Actuators | None

    def apply(self, loop: Loop) -> None:
        loop.set_actuators(self.actuators)

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        return state.changed(ACTUATORS, actuators=self.actuators)


@dataclass(frozen=True)
class AddChunk(Operation):
    """Add a chunk (envs, rows, dof) that is ``latency`` (envs,) [s] old to the plans; infinite for
    no chunk.
    """

    chunk: Float64
    latency: Float64

    def goal(self, before: Float64) -> Float64:
        """Return the last row of each env (envs, dof), NaN where a row is not finite, or ``before``
        without a chunk.
        """
        is_finite = np.isfinite(self.chunk).all(1)
        goal = np.where(is_finite, self.chunk[:, -1], np.nan)
        return np.where(np.isfinite(self.latency)[:, None], goal, before)

    def apply(self, loop: Loop) -> None:
        loop.add_chunk(self.chunk, self.latency)


@dataclass(frozen=True)
class ReadRows(Operation):
    """Read the state of every env."""

    changes_loop = False

    def apply(self, loop: Loop) -> dict[str, Rows]:
        return loop.read()

    def join(self, results: list[dict[str, Rows]]) -> dict[str, Rows]:
        return join_rows(results)


@dataclass(frozen=True)
class TakeSnapshot(ReadRows):
    """Read the state of every env, and go on as if restored from it."""

    changes_loop = True

    def apply(self, loop: Loop) -> dict[str, Rows]:
        return loop.snapshot()

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        return state._replace(steps_since_checkpoint=0)


@dataclass(frozen=True)
class Restore(Operation):
    """Put every env into its state in ``snapshot``, with its params and ``draws``."""

    snapshot: Snapshot
    draws: Draws
    ticks = 1

    def apply(self, loop: Loop) -> None:
        loop.restore(self.snapshot, self.draws)

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        snapshot = self.snapshot
        motion = state.motion
        if motion is not None:
            setpoint, rate = snapshot.rows["motion"].swapaxes(0, 1)
            motion = setpoint, rate
        return state.changed(
            RESTORE,
            params=snapshot.params,
            actuators=snapshot.actuators,
            draws=self.draws,
            faults=state.faults.restored(snapshot.rows["containment/step"]),
            motion=motion,
            steps=snapshot.steps,
            steps_since_checkpoint=0,
        )


@dataclass(frozen=True)
class ReadPoses(Operation):
    """Read the poses of the entities that ``build`` returned, or of the bodies ``names`` of a
    file.
    """

    names: tuple[str, ...] | None = None
    changes_loop = False

    def for_envs(self, envs: slice) -> Self:
        return self

    def apply(self, loop: Loop) -> list[Rows]:
        return loop.poses(self.names)

    def join(self, results: list[list[Rows]]) -> list[Rows]:
        return [*chain.from_iterable(results)]


def snapshot_of(options: RunnerOptions, state: RunnerState, rows: dict[str, Rows]) -> Snapshot:
    """Return the snapshot of a runner in ``state``, with the ``rows`` that the workers have read."""
    rows = dict(rows)
    if state.motion is not None:
        setpoint, rate = state.motion
        if rate is None:
            rate = np.zeros_like(setpoint)
        rows["motion"] = np.stack([setpoint, rate], axis=1)
    if options.randomization is not None:
        rows["episodes"] = state.draws.episodes.copy()
    return Snapshot(options.described, state.steps, state.params, rows, state.actuators)


def restored(options: RunnerOptions, snapshot: Snapshot, present: Snapshot) -> Restore:
    """Return the operation that restores a snapshot, checked and copied.

    ``present`` is any snapshot of this runner; only the shapes of its ``control/`` arrays may
    differ, since params and actuators decide them.
    """
    num_envs = options.num_envs
    randomization = options.randomization
    params = options.check_params(snapshot.params)
    acting = actuators = options.check_actuators(
        IDEAL if snapshot.actuators is None else snapshot.actuators
    )
    draws = NOTHING
    if randomization is not None:
        # Delays of drawn actuators say how long the histories are.
        draws = randomization.draw(options.robot, snapshot.episodes(num_envs))
        acting = randomization.randomized("actuators", actuators, draws, options.robot)
    empty = empty_states(options, params, acting, options.has_stiction(acting))
    control = by_name(*empty)
    rows = {name: table for name, table in present.rows.items() if "control/" not in name}
    snapshot.check_rows(rows | flatten({"control": control}))
    return Restore(replace(snapshot.copy(), params=params, actuators=actuators), draws)
