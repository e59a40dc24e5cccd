"""Commands of a Runner: each makes one request to the workers, and the state of the runner after it.

A command holds checked arguments and changes nothing by itself. The runner executes its request, and then replaces its
state by the result of :meth:`RunnerCommand.committed`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64
from batchpid.checks.validate import array, env_mask, read_array, within
from batchpid.errors import InvalidArgumentError
from batchpid.sim.command import POSE_UNITS, TWIST_UNITS
from batchpid.sim.engine.robot_model import robot_model
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.custom import initial_state
from batchpid.sim.loop.faults import FARTHEST, ORIGIN, FaultLog
from batchpid.sim.loop.snapshot import EnvStates, Snapshot, initial_actuators
from batchpid.sim.observation import untouched
from batchpid.sim.options import IDEAL, RunnerOptions
from batchpid.sim.randomization.draws import NOTHING, Draws
from batchpid.sim.robot.limits import SetpointCheck
from batchpid.sim.workers.contact_log import MissedContactLog
from batchpid.sim.workers.pool import Outcome
from batchpid.sim.workers.requests import Request, Reset, Restore, Run, SetActuators, SetParams, TakeSnapshot

Motion = tuple[Float64, Float64 | None]
"""Setpoints of joints and their rates (envs, dof); None for 0."""


class RunnerState(NamedTuple):
    """Everything about a runner that its commands change, apart from the workers. Replaced once by each command."""

    params: bp.PIDParams
    actuators: bp.Actuators | None
    draws: Draws
    faults: FaultLog
    contacts: MissedContactLog | None
    """None with collisions."""
    targets: Float64 | None
    """Last joint setpoints (envs, dof), where searches for poses of the tool start; None without such poses."""
    motion: Motion | None
    """Setpoint of the last tick and its rate, or position and velocity after a reset. None for other setpoints."""
    steps: int = 0
    steps_since_checkpoint: int = 0
    work: tuple[tuple[float, ...], int] = ((), 1)
    """Seconds of each worker in the last run, and the ticks of that run."""

    @classmethod
    def first(cls, options: RunnerOptions, params: bp.PIDParams) -> RunnerState:
        """Return the state before the first reset, which places all envs."""
        robot, own, count = options.robot, options.own_command, options.num_envs
        draws = NOTHING
        if options.randomization is not None:
            draws = options.randomization.first(robot, count, options.first_env)
        names = None if own is None else own.names
        faults, contacts = FaultLog(count, robot.joint_names, options.timestep, options.on_fault, names), None
        if not options.collisions:
            nearest = lambda qpos: robot_model(robot).nearest_links(qpos)  # noqa: E731
            contacts = MissedContactLog(count, options.timestep, nearest)
        start = np.tile(robot.start, (count, 1))
        targets = None if options.tool_setpoints is None else start
        motion = (start, None) if options.sets_positions else None
        return cls(params, options.actuators, draws, faults, contacts, targets, motion)


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
        qpos = _joint_rows(options, "qpos", robot.start if pose[0] is None else pose[0])
        qvel = _joint_rows(options, "qvel", 0.0 if pose[1] is None else pose[1])
        chosen = np.ones(num_envs, bool) if mask is None else env_mask("mask", mask, num_envs)
        limits.check("qpos", robot.coupled(qpos), chosen)
        if randomization is not None:
            draws = randomization.redraw(robot, draws, chosen, seed, options.first_env)
            qpos, qvel = randomization.start(qpos, qvel, draws, robot)
        elif seed is not None:
            raise InvalidArgumentError("seed", "has no effect without a randomization", remedy="leave it out")
        qpos, qvel = robot.coupling.positions(qpos), robot.coupling.rates(qvel)
        return cls(chosen, qpos, qvel, _base_rows(options, *base, qpos, chosen), draws)

    def request(self, state: RunnerState) -> Reset:
        return Reset(self.mask, self.qpos, self.qvel, self.draws, self.base)

    def committed(self, state: RunnerState, outcome: Outcome) -> RunnerState:
        chosen, targets, motion = self.mask[:, None], state.targets, state.motion
        if targets is not None:
            targets = np.where(chosen & np.isfinite(self.qpos), self.qpos, targets)
        if motion is not None:
            setpoint, rate = motion
            rate = np.where(chosen, self.qvel, 0.0 if rate is None else rate)
            motion = np.where(chosen, self.qpos, setpoint), rate
        faults = state.faults.without(self.mask).with_faults(outcome.present)
        return state._replace(faults=faults, draws=self.draws, targets=targets, motion=motion)


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
        faults, contacts, targets, motion, count = (
            state.faults,
            state.contacts,
            state.targets,
            state.motion,
            outcome.num_ticks,
        )
        are_ok = np.logical_and.reduce(outcome.ticks.arrays.observation.ok[:count], axis=None)
        if not are_ok or contacts is not None:
            for arrays in outcome.completed:
                faults = faults.with_faults(arrays)
                contacts = None if contacts is None else contacts.with_contacts(arrays)
        if targets is not None:
            for rows in setpoint[:count]:
                targets = np.where(np.isfinite(rows).all(1, keepdims=True), rows, targets)
        if motion is not None and count:
            motion = setpoint[count - 1], None if rate is None else rate[count - 1]
        steps = count * self.substeps
        return RunnerState(  # not _replace(): it is one more Python call per tick
            state.params,
            state.actuators,
            state.draws,
            faults,
            contacts,
            targets,
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
            targets=snapshot.targets,
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
    targets = None if state.targets is None else state.targets.copy()
    about, states = options.describe(), EnvStates.join(results)
    return Snapshot(about, state.steps, state.params, states, state.actuators, episodes, targets, motion)


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


# -- arguments ---------------------------------------------------------------------------------------------------------


def read_command(
    options: RunnerOptions,
    state: RunnerState,
    limits: SetpointCheck | None,
    given: Mapping[str, ArrayLike | None],
    ticks: int | None = None,
) -> Command:
    """Return the command (ticks, envs, ...) of one tick, or of ``ticks``, as a copy.

    ``given`` has its arrays by the names of their arguments, in the order of :class:`Command`. Positions of followers
    are computed from their leaders; the loop passes efforts on to the leaders. ``limits`` warns of setpoints.
    """
    if options.tool_setpoints is not None:
        given = _joint_setpoints(options, state, given, ticks)
    _, _, acceleration, _ = given.values()
    if acceleration is not None:
        _check_acceleration(state.params, given)
    table = (options.num_envs,) if ticks is None else (ticks, options.num_envs)
    finite, rows = options.on_invalid_input == "raise", list[Any]()
    for (name, value), (kind, names) in zip(given.items(), options.command_columns, strict=True):
        if value is None and rows:  # the setpoint, which is first, must be given
            rows.append(None)
            continue
        each: Any = value
        if ticks is not None:
            each = read_array(name, each)
            each = each[:, None] if each.ndim == 2 else each
        own = array(name, each, (*table, len(names)), names, finite=finite, kind=kind).copy()
        rows.append(own[None] if ticks is None else own)
    coupling = options.command_coupling
    if coupling is not None:
        rows[0] = coupling.positions(rows[0])
        rows[1:3] = [None if each is None else coupling.rates(each) for each in rows[1:3]]
    if limits is not None:
        limits.check("setpoint", rows[0])
    return Command(*rows)


def accelerated(command: Command, motion: Motion, seconds: float) -> Command:
    """Return ``command`` (ticks, envs, ...) with the mean accelerations in ticks of ``seconds`` with rates.

    The mean is the change of the rate over the tick, from ``motion`` before the first. It is taken where the setpoints
    confirm that rates (and given accelerations) are those at the tick's end, since they change by the mean of the old
    and the new rate rather than by the new one, as increments do. Elsewhere the given acceleration is kept, or 0.
    """
    setpoint, rate, given, _ = command
    before = [0.0 * rate[0] if rows is None else rows for rows in motion]
    with np.errstate(invalid="ignore"):  # non-finite rates become faults
        moved, change = (
            np.diff(rows, axis=0, prepend=first[None]) for rows, first in zip((setpoint, rate), before, strict=True)
        )
        ahead = moved - seconds * rate  # of increments 0, else minus half the change
        fits = np.abs(ahead + 0.5 * seconds * change) < 4 * np.abs(ahead)
        if given is not None:  # with the jerk (given - mean) / (seconds / 2), where the rate is at its largest, too
            end = seconds**2 * given
            fits |= np.abs(ahead + end / 6 + seconds * change / 3) < np.abs(end) / 24
    return command._replace(setpoint_acceleration=np.where(fits, change / seconds, 0.0 if given is None else given))


def count_ticks(options: RunnerOptions, setpoints: ArrayLike) -> int:
    """Return the number of ticks of a rollout, from the shape of its setpoints."""
    rows, num_envs = read_array("setpoints", setpoints), options.num_envs
    size = len(options.command_columns[0][1])
    if options.tool_setpoints is None and (rows.ndim not in (2, 3) or len(rows) == 0):
        raise InvalidArgumentError(
            "setpoints",
            f"must have shape (ticks, {num_envs}, {size}) or (ticks, {size})",
            value=rows.shape,
            remedy=f"repeat a constant setpoint with np.broadcast_to(setpoint, (ticks, {size}))",
        )
    return len(np.atleast_1d(rows))


def _check_acceleration(params: bp.PIDParams, given: Mapping[str, ArrayLike | None]) -> None:
    """Raise InvalidArgumentError for an acceleration that the law does not take."""
    _, (rate, given_rate), (name, _), _ = given.items()
    if params.gain_units is None:
        remedy = "give M(q) times it as feedforward, or use gains in accelerations, such as robot.designed()"
        raise InvalidArgumentError(name, "is for gains in accelerations, and these are efforts", remedy=remedy)
    if given_rate is None:
        raise InvalidArgumentError(name, f"is given without {rate}", remedy=f"give {rate}, too")


def _joint_setpoints(
    options: RunnerOptions, state: RunnerState, given: Mapping[str, ArrayLike | None], ticks: int | None
) -> dict[str, ArrayLike | None]:
    """Return ``given`` with joint setpoints and their rates for poses of the tool and its twists."""
    (name, poses), (rate_name, twists), (acceleration_name, acceleration), _ = given.items()
    if acceleration is not None:
        problem = "is for joint setpoints, and setpoints are poses"
        raise InvalidArgumentError(acceleration_name, problem, remedy="leave it out")
    tool, finite = options.tool_setpoints, options.on_invalid_input == "raise"
    assert tool is not None
    assert state.targets is not None
    qpos = tool.joints(name, poses, state.targets, finite, ticks)
    rates = None if twists is None else tool.rates(rate_name, twists, qpos, finite)
    return dict(given) | {name: qpos, rate_name: rates}


def _joint_rows(options: RunnerOptions, name: str, value: ArrayLike) -> Float64:
    """Return positions or velocities (envs, dof) to reset to."""
    robot, is_finite = options.robot, options.on_invalid_input == "raise"
    rows = array(name, value, (options.num_envs, robot.dof), robot.joint_names, finite=is_finite).copy()
    if is_finite:
        return within(name, rows, FARTHEST, robot.joint_names)
    return np.where(np.abs(rows) > FARTHEST, np.nan, rows)


def _base_rows(
    options: RunnerOptions, pose: ArrayLike | None, twist: ArrayLike | None, qpos: NDArray[np.float64], mask: Bool
) -> Float64 | None:
    """Return poses and twists (envs, 13) of floating bases to reset to, at joint positions ``qpos``.

    By default a base is at rest, upright, and so high that the robot's lowest point is on the ground.
    """
    robot, num_envs = options.robot, options.num_envs
    if robot.fixed_base:
        for name, value in (("base_pose", pose), ("base_twist", twist)):
            if value is not None:
                remedy = "leave it out, or load the robot with fixed_base=False"
                raise InvalidArgumentError(name, "is for a floating base, and this one is fixed", remedy=remedy)
        return None
    rows = np.tile(ORIGIN, (num_envs, 1))
    if twist is not None:
        rows[:, 7:] = array("base_twist", twist, (num_envs, 6), tuple(TWIST_UNITS), kind="entry")
    if pose is not None:
        rows[:, :7] = array("base_pose", pose, (num_envs, 7), tuple(POSE_UNITS), kind="entry")
        length = np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
        if not length.all():
            problem = f"env {int(np.flatnonzero(length == 0)[0])} has a quaternion of length 0"
            raise InvalidArgumentError("base_pose", problem, remedy="give (w, x, y, z), (1, 0, 0, 0) upright")
        rows[:, 3:7] /= length
    elif options.ground:
        heights: dict[bytes, float] = {}
        for env in np.flatnonzero(mask).tolist():
            key = qpos[env].tobytes()
            if key not in heights:
                heights[key] = robot_model(robot).height(np.nan_to_num(qpos[env]), base_too=True)
            rows[env, 2] = -heights[key] if np.isfinite(heights[key]) else 0.0
    return rows
