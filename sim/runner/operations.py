"""Requests of a Runner to its workers, and its state after each.

A request holds checked arguments for all envs and changes nothing by itself. The runner sends it to
the workers, and then replaces its state by the result of :func:`committed`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.checks import env_mask
from batchpid.errors import InvalidArgumentError
from batchpid.sim.loop.arrays import Arrays, Snapshot
from batchpid.sim.loop.faults import CAUSES, MOST_EVENTS, NO_STEP, Fault
from batchpid.sim.options.options import IDEAL, RunnerOptions
from batchpid.sim.randomization.distributions import NOTHING, Draws
from batchpid.sim.rollout import PARAMS, RESET, RESTORE
from batchpid.sim.runner.arguments import base_rows, joint_rows
from batchpid.sim.workers.pool import Outcome
from batchpid.sim.workers.requests import Request
from batchpid.stages.values import Command

READ = Request("read", changes_loop=False)
"""Read the state of every env."""
SNAPSHOT = Request("snapshot")
"""Read the state of every env, and go on as if restored from it."""
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
    faults: tuple[Fault, ...]
    """The last :data:`batchpid.sim.loop.faults.MOST_EVENTS` faults, latest last."""
    fault_steps: Rows
    """Sim step of the last fault of each env (envs,)."""
    motion: Motion | None
    """Setpoint of the last tick and its rate, or position and velocity after a reset. None for
    other setpoints.
    """
    steps: int = 0
    steps_since_checkpoint: int = 0
    changes: Rows | None = None
    """Changes of each env since the last tick (envs,): :attr:`batchpid.sim.Rollout.changes`."""

    def changed(self, change: int, envs: Bool | slice = ALL, **values: Any) -> RunnerState:
        """Return a state with other ``values``, which notes a ``change`` of some envs."""
        changes = (
            np.zeros(len(self.fault_steps), np.uint8) if self.changes is None else self.changes
        )
        changes = changes.copy()
        changes[envs] |= change
        return self._replace(changes=changes, **values)

    @classmethod
    def first(cls, options: RunnerOptions) -> RunnerState:
        """Return the state before the first reset, which draws for all envs and places them."""
        count = options.num_envs
        motion = None
        if options.sets_positions:
            motion = (np.tile(options.robot.start, (count, 1)), None)
        steps = np.full(count, NO_STEP)
        return cls(options.params, options.actuators, NOTHING, (), steps, motion)


# -- requests


def reset_request(
    options: RunnerOptions,
    state: RunnerState,
    pose: tuple[ArrayLike | None, ArrayLike | None],
    mask: ArrayLike | None,
    seed: int | ArrayLike | None,
    base: Mapping[str, ArrayLike | None],
) -> Request:
    """Return the request for arguments of :meth:`batchpid.sim.Runner.reset`."""
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
    inputs = chosen, qpos, qvel, draws, base_rows(options, base, qpos, chosen)
    return Request("reset", inputs, ticks=1)


def run_request(ticks: int, substeps: int, command: Command) -> Request:
    """Return the request to run ``ticks`` of ``substeps`` sim steps under ``command`` (ticks, envs,
    ...).
    """
    return Request("run", (ticks, substeps, command.given), ticks, substeps, command)


def restore_request(snapshot: Snapshot, draws: Draws) -> Request:
    """Return the request to put every env into its state in ``snapshot``, with its params and
    ``draws``.
    """
    return Request("restore", (snapshot, draws), ticks=1)


def goal_of(chunk: Float64, latency: Float64, before: Float64) -> Float64:
    """Return the last row of each env's chunk (envs, dof), NaN where a row is not finite, or
    ``before`` without a chunk: where the latency is infinite.
    """
    is_finite = np.isfinite(chunk).all(1)
    goal = np.where(is_finite, chunk[:, -1], np.nan)
    return np.where(np.isfinite(latency)[:, None], goal, before)


# -- the state after them


def committed(options: RunnerOptions, state: RunnerState, outcome: Outcome) -> RunnerState:
    """Return the state after a request, from the state before it and the outcome in the workers."""
    method, arguments = outcome.request.method, outcome.request.arguments
    if method == "run":
        return _after_run(options, state, outcome)
    if method == "reset":
        return _after_reset(state, outcome.request)
    if method == "restore":
        return _after_restore(state, *arguments)
    if method == "set_params":
        return state.changed(PARAMS, params=arguments[0])
    if method == "snapshot":
        return state._replace(steps_since_checkpoint=0)
    return state


def _after_reset(state: RunnerState, request: Request) -> RunnerState:
    mask, qpos, qvel, draws, _ = request.arguments
    motion = state.motion
    if motion is not None:
        setpoint, rate = motion
        rate = np.where(mask[:, None], qvel, 0.0 if rate is None else rate)
        motion = np.where(mask[:, None], qpos, setpoint), rate
    return state.changed(
        RESET,
        mask,
        fault_steps=np.where(mask, NO_STEP, state.fault_steps),
        draws=draws,
        motion=motion,
    )


def _after_run(options: RunnerOptions, state: RunnerState, outcome: Outcome) -> RunnerState:
    request, arrays = outcome.request, outcome.arrays
    setpoint, rate, *_ = request.command
    motion = state.motion
    ok = arrays.observation.ok[: request.ticks]
    if np.count_nonzero(ok) < ok.size:
        for tick in range(request.ticks):
            state = _with_faults(options, state, arrays.at(tick))
    if motion is not None:
        motion = setpoint[-1], None if rate is None else rate[-1]
    steps = request.ticks * request.substeps
    return state._replace(
        motion=motion,
        steps=state.steps + steps,
        steps_since_checkpoint=state.steps_since_checkpoint + steps,
        changes=None,
    )


def _after_restore(state: RunnerState, snapshot: Snapshot, draws: Draws) -> RunnerState:
    motion = state.motion
    if motion is not None:
        setpoint, rate = snapshot.rows["motion"].swapaxes(0, 1)
        motion = setpoint, rate
    return state.changed(
        RESTORE,
        params=snapshot.params,
        actuators=snapshot.actuators,
        draws=draws,
        fault_steps=snapshot.rows["containment/step"],
        motion=motion,
        steps=snapshot.steps,
        steps_since_checkpoint=0,
    )


def _with_faults(options: RunnerOptions, state: RunnerState, arrays: Arrays) -> RunnerState:
    """Return the state with the faults in the arrays of a tick that it does not have yet."""
    steps = arrays.fault.step
    # A fault is new if it has another step than the env's last one.
    new = np.flatnonzero((steps != NO_STEP) & (steps != state.fault_steps)).tolist()
    if not new:
        return state
    faults = state.faults + tuple([_fault(options, env, arrays) for env in new])
    return state._replace(faults=faults[-MOST_EVENTS:], fault_steps=steps.copy())


# -- snapshots


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


def restored(options: RunnerOptions, snapshot: Snapshot, present: Snapshot) -> Request:
    """Return the request that restores a snapshot, checked and copied.

    ``present`` is any snapshot of this runner.
    """
    params = options.check_params(snapshot.params)
    actuators = options.check_actuators(IDEAL if snapshot.actuators is None else snapshot.actuators)
    draws = NOTHING
    if options.randomization is not None:
        draws = options.randomization.draw(options.robot, snapshot.rows["episodes"])
    snapshot.check_rows(present.rows)
    return restore_request(replace(snapshot.copy(), params=params, actuators=actuators), draws)


def _fault(options: RunnerOptions, env: int, arrays: Arrays) -> Fault:
    """Return the last fault of an env in the arrays of a tick."""
    step = int(arrays.fault.step[env])
    cause = CAUSES[arrays.fault.cause[env]]
    names = options.robot.joint_names
    if cause in Command._fields:
        _, names = options.command_columns[Command._fields.index(cause)]
    joint = names[arrays.fault.joint[env]]
    return Fault(
        env,
        step,
        step * options.timestep,
        joint,
        cause,
        options.on_fault,
    )
