"""Commands of a Runner as transactions, with their checkpoints, recording and warnings.

Longer than 300 lines because all commands are here, each with the change of state that it brings.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from operator import methodcaller
from pathlib import Path
from time import strftime
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.checks.validate import choice, instance
from batchpid.errors import BatchPIDError, CallOrderError, InvalidArgumentError
from batchpid.io.versions import package_versions
from batchpid.sim.arguments import Arguments
from batchpid.sim.engine.robot_model import robot_model
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.custom import initial_state
from batchpid.sim.loop.faults import FaultLog, FaultWarning
from batchpid.sim.loop.snapshot import EnvStates, Snapshot, initial_actuators
from batchpid.sim.observation import Observation, Rollout, RunInfo, empty_observation, untouched
from batchpid.sim.options import IDEAL, RunnerOptions
from batchpid.sim.randomization.draws import NOTHING
from batchpid.sim.robot.drive_chatter import DriveChatterCheck
from batchpid.sim.robot.limits import MovingSetpointCheck
from batchpid.sim.robot.loop_stability import StabilityCheck
from batchpid.sim.tool_space.osc_controller import OperationalSpace
from batchpid.sim.workers.contact_log import MissedContactLog, MissedContactWarning
from batchpid.sim.workers.pool import WorkerPool
from batchpid.sim.workers.requests import (
    ReadPoses,
    ReadStateSizes,
    Request,
    Reset,
    Restore,
    Run,
    SetActuators,
    SetParams,
    TakeSnapshot,
)
from batchpid.sim.workers.transaction import Commit, Phase, RunnerState, Transactions

_COPY = methodcaller("copy")


class TickRecorder(Protocol):
    """Receives every tick of a runner; :class:`batchpid.sim.Recorder` is one."""

    path: Path

    def append(self, time_: float, setpoint: NDArray[Any], observation: Observation, has_rates: bool) -> None:
        """Record the state at ``time_`` [s], reached under ``setpoint`` (envs, size), with rates or without.

        After an interrupt it is called again, with the same ``observation``; it is to be recorded once.
        """


class Session:
    """Commands of one :class:`batchpid.sim.Runner`, whose methods of the same names document them.

    Every command first completes one that was sent or interrupted, checks its arguments, and then is one transaction
    (:mod:`batchpid.sim.workers.transaction`). Warnings name the line that calls the runner, so the methods are called
    by its methods directly.
    """

    def __init__(self, options: RunnerOptions, params: bp.PIDParams) -> None:
        robot, own = options.robot, options.own_command
        self.options = options
        self.recorder: TickRecorder | None = None
        """Recorder of every tick."""
        self._arguments = Arguments(options)
        self._stability = StabilityCheck(robot, options.timestep) if options.control == "pid" else None
        is_checked = options.control == "drive" and options.engine == "mujoco"
        self._chatter = DriveChatterCheck(robot, options.timestep) if is_checked else None
        self._moving = MovingSetpointCheck(robot) if options.control == "pid" else None
        self._tool_pose, self._tool_setpoints = options.tool_pose, options.tool_setpoints
        self._has_warned = self._has_warned_of_contact = self._has_warned_of_motion = False
        entry_names = None if own is None else own.names
        faults = FaultLog(options.num_envs, robot.joint_names, options.timestep, options.on_fault, entry_names)
        contacts = None
        if not options.collisions:
            contacts = MissedContactLog(
                options.num_envs, options.timestep, lambda qpos: robot_model(robot).nearest_links(qpos)
            )
        randomization = options.randomization
        draws = NOTHING if randomization is None else randomization.first(robot, options.num_envs, options.first_env)
        state = RunnerState(params, faults, draws, actuators=options.actuators, contacts=contacts)
        self.pool = WorkerPool(options, params)
        self._transactions = Transactions(self.pool, state, self._record)

    def open(self) -> None:
        """Start the workers, and reset all envs."""
        self.pool.open()
        self.reset(seed=None if self.options.randomization is None else 0)
        if self._stability is not None:
            self._stability.check(self.state.params, self.options.actuators, stacklevel=4)
        if self._moving is not None:
            self._moving.set_params(self.state.params)
        if self._chatter is not None:
            self._chatter.set_gains(self.state.params, self.options.actuators)
        if isinstance(self.options.control, OperationalSpace):
            self.options.control.check_stability(stacklevel=3)

    def close(self) -> None:
        """End the workers. May be called again, as after an interrupt."""
        self._transactions.close()

    @property
    def state(self) -> RunnerState:
        """State after the last command; during a call, and after the end, after the last completed one."""
        transactions = self._transactions
        if transactions.phase is Phase.BEGUN and not (transactions.in_use or self.pool.closed):
            transactions.run()
        return transactions.state

    def settle(self) -> None:
        """Complete an unfinished command, and pass unrecorded ticks on to the recorder, also when closed."""
        self._transactions.run()

    # -- commands --------------------------------------------------------------------------------------------------

    def reset(
        self,
        qpos: ArrayLike | None = None,
        qvel: ArrayLike | None = None,
        mask: ArrayLike | None = None,
        seed: int | ArrayLike | None = None,
        base_pose: ArrayLike | None = None,
        base_twist: ArrayLike | None = None,
    ) -> Observation:
        """Place robots, with a fresh state of the controller."""
        draws = self._transactions.ready("reset").draws
        options, robot, randomization = self.options, self.options.robot, self.options.randomization
        position, velocity, chosen = self._arguments.start(qpos, qvel, mask)
        if randomization is not None:
            draws = randomization.redraw(robot, draws, chosen, seed, options.first_env)
            position, velocity = randomization.start(position, velocity, draws, robot)
        elif seed is not None:
            raise InvalidArgumentError("seed", "has no effect without a randomization", remedy="leave it out")
        position, velocity = robot.coupling.positions(position), robot.coupling.rates(velocity)
        base = self._arguments.base(base_pose, base_twist, position, chosen)

        def commit(state: RunnerState, _: list[Any]) -> tuple[RunnerState, Observation]:
            faults, targets = state.faults.without(chosen).with_faults(self.pool.present), None
            if self._tool_setpoints is not None:
                last = position if state.targets is None else state.targets
                targets = np.where(chosen[:, None] & np.isfinite(position), position, last)
            motion: Any = (position, velocity) if options.sets_positions else None
            if state.motion is not None:
                kept = [0.0 if rows is None else rows for rows in state.motion]
                motion = tuple(np.where(chosen[:, None], *rows) for rows in zip(motion, kept, strict=True))
            return state._replace(faults=faults, draws=draws, targets=targets, motion=motion), self._observation()

        observation: Observation = self._execute(Reset(chosen, position, velocity, draws, base), commit)
        return observation

    def step(
        self,
        setpoint: ArrayLike,
        setpoint_rate: ArrayLike | None,
        setpoint_acceleration: ArrayLike | None,
        feedforward: ArrayLike | None,
        substeps: int | None,
    ) -> Observation:
        """Run one tick."""
        self._transactions.ready("step")
        count = self.options.substeps if substeps is None else self._arguments.substeps(substeps)
        if self._tool_setpoints is not None:
            setpoint, setpoint_rate = self._joints("setpoint", setpoint, setpoint_rate, setpoint_acceleration, None)
        given = setpoint, setpoint_rate, setpoint_acceleration, feedforward
        command = self._arguments.tick(self._transactions.state.params, *given)
        self._transactions.run(*self._ticks(command, count))
        self._warn(stacklevel=4)
        return self._seen(self.pool.present.observation)

    def send(
        self,
        setpoint: ArrayLike,
        setpoint_rate: ArrayLike | None,
        setpoint_acceleration: ArrayLike | None,
        feedforward: ArrayLike | None,
        substeps: int | None,
    ) -> None:
        """Begin a tick."""
        self._transactions.ready("send")
        count = self._arguments.substeps(substeps)
        if self._tool_setpoints is not None:
            setpoint, setpoint_rate = self._joints("setpoint", setpoint, setpoint_rate, setpoint_acceleration, None)
        given = setpoint, setpoint_rate, setpoint_acceleration, feedforward
        command = self._arguments.tick(self._transactions.state.params, *given)
        request, commit = self._ticks(command, count)

        def commit_sent(state: RunnerState, seconds: list[Any]) -> tuple[RunnerState, None]:
            state, _ = commit(state, seconds)
            return state._replace(sent=self._observation()), None

        self._transactions.run(request, commit_sent, wait=False)

    def recv(self) -> Observation:
        """Wait for the end of the tick that was sent; return its observation."""
        sent = self._transactions.ready().sent
        if self._transactions.phase is not Phase.UNRECEIVED or sent is None:
            raise CallOrderError("recv: no tick was sent; call send(setpoint) first")
        self._transactions.phase = Phase.IDLE
        self._warn(stacklevel=4)
        return sent

    def rollout(
        self,
        setpoints: ArrayLike,
        setpoint_rates: ArrayLike | None,
        setpoint_accelerations: ArrayLike | None,
        feedforwards: ArrayLike | None,
        progress: Callable[[Iterable[int]], Iterable[int]] | None,
    ) -> Rollout:
        """Run one tick for each row of ``setpoints``."""
        steps, options = self._transactions.ready("rollout").steps, self.options
        if self._tool_setpoints is not None:
            poses = setpoints, setpoint_rates, setpoint_accelerations
            setpoints, setpoint_rates = self._joints("setpoints", *poses, len(np.atleast_1d(setpoints)))
        command = self._arguments.ticks(
            self._transactions.state.params, setpoints, setpoint_rates, setpoint_accelerations, feedforwards
        )
        ticks = len(command.setpoint)
        seen = empty_observation(ticks, options.num_envs, options.robot.dof, observed=options.observed)
        times = (steps + options.substeps * np.arange(1.0, ticks + 1)) * options.timestep
        info, done = replace(self.info(), rates=command.setpoint_rate is not None), 0
        shown = iter(range(ticks) if progress is None else progress(range(ticks)))
        for tick in range(ticks):  # not over ``shown``, which may yield anything
            next(shown, None)
            if tick == done:
                done = min(ticks, tick + self._max_ticks())
                part = slice(tick, done)
                rows_of_part = command.map(lambda rows, part=part: rows[part])
                self._transactions.run(*self._ticks(rows_of_part, options.substeps))
                self._warn(stacklevel=4)
                for name in options.observed:
                    getattr(seen, name)[part] = getattr(self.pool.arrays.observation, name)[: done - tick]
        next(shown, None)  # the end
        if self._tool_pose is not None:
            seen = seen._replace(tool_pose=self._tool_pose(seen.qpos))
        if (faults := self.state.faults.faults) is not info.faults:
            info = replace(info, faults=faults)
        return Rollout(times, command.setpoint, seen, options.timestep * options.substeps, info)

    def observe(self) -> Observation:
        """Return the state of every env."""
        self._transactions.ready()
        return self._observation()

    def poses(self) -> NDArray[np.float32]:
        """Return the poses of the entities that ``build`` returned."""
        self._transactions.ready()
        rows = [row for part in self._execute(ReadPoses()) for row in part]
        counts = [len(row) for row in rows]
        if not rows or len(set(counts)) > 1:
            raise InvalidArgumentError(
                "build",
                f"returned {sorted(set(counts))} entities, by env" if rows else "was not given",
                remedy="let build(scene, env) return as many entities for every env",
            )
        return np.stack(rows)

    def bodies(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Return the poses of bodies of an MJCF file."""
        self._transactions.ready()
        if self.options.mjcf is None:
            problem, remedy = "are those of an MJCF file in the engine 'mujoco'", "use robot.kinematic_tree() for links"
            raise InvalidArgumentError("names", problem, remedy=remedy)
        chosen = tuple([choice("names", name, self.options.mjcf.bodies) for name in names])
        return np.stack([row for part in self._execute(ReadPoses(chosen)) for row in part])

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times in flight."""
        self._transactions.ready()
        checked = self.options.check_params(params)
        self._execute(SetParams(checked), lambda state, _: (state._replace(params=checked), None))
        if self._stability is not None:
            self._stability.check(checked, self.state.actuators, stacklevel=4)
        if self._moving is not None:
            self._moving.set_params(checked)
        if self._chatter is not None:
            self._chatter.set_gains(checked, self.state.actuators)

    def set_actuators(self, actuators: bp.Actuators | None) -> None:
        """Change the actuators in flight."""
        self._transactions.ready()
        checked = self.options.check_actuators(actuators)
        self._execute(SetActuators(checked), lambda state, _: (state._replace(actuators=checked), None))
        if self._chatter is not None:
            self._chatter.set_gains(self.state.params, checked)

    def snapshot(self) -> Snapshot:
        """Return the state of all envs, from which the workers go on."""
        self._transactions.ready()

        def commit(state: RunnerState, results: list[Any]) -> tuple[RunnerState, Snapshot]:
            episodes = None if self.options.randomization is None else state.draws.episodes.copy()
            targets = None if state.targets is None else state.targets.copy()
            about, states = self.options.describe(), EnvStates.join(results)
            motion = None
            if state.motion is not None:
                last, rate = state.motion
                motion = np.stack([last, np.zeros_like(last) if rate is None else rate])
            snapshot = Snapshot(about, state.steps, state.params, states, state.actuators, episodes, targets, motion)
            self.pool.start_replay_from(Restore(snapshot, state.draws))
            return state._replace(steps_since_checkpoint=0), snapshot

        snapshot: Snapshot = self._execute(TakeSnapshot(), commit)
        return snapshot

    def restore(self, snapshot: Snapshot) -> Observation:
        """Put all envs into the state of ``snapshot``."""
        self._transactions.ready("restore")
        options, robot = self.options, self.options.robot
        instance("snapshot", snapshot, Snapshot, "take one with runner.snapshot()")
        snapshot.check(options.describe())
        params = options.check_params(snapshot.params)
        sizes = [size for part in self._execute(ReadStateSizes()) for size in part]
        acting = actuators = options.check_actuators(IDEAL if snapshot.actuators is None else snapshot.actuators)
        draws, randomization = NOTHING, options.randomization
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
        request = Restore(replace(snapshot, params=params, actuators=actuators), draws).copy()

        def commit(state: RunnerState, _: list[Any]) -> tuple[RunnerState, Observation]:
            self.pool.start_replay_from(request)
            state = state._replace(
                draws=draws,
                params=params,
                actuators=actuators,
                steps=snapshot.steps,
                targets=request.snapshot.targets,
                motion=None if (motion := request.snapshot.motion) is None else (motion[0], motion[1]),
                steps_since_checkpoint=0,
                faults=state.faults.restored(request.snapshot.states.containment["step"]),
            )
            return state, self._observation()

        observation: Observation = self._execute(request, commit)
        if self._moving is not None:
            self._moving.set_params(params)
        if self._chatter is not None:
            self._chatter.set_gains(params, actuators)
        return observation

    def info(self) -> RunInfo:
        """Return robot, options and origin of a run that starts now."""
        start, state, options = self.observe().qpos, self.state, self.options
        draws = None if options.randomization is None else state.draws
        return options.robot.run_info(
            **options.values_for("recording"),
            own_command=options.own_command,
            params=state.params,
            actuators=state.actuators,
            start=start,
            versions=dict(self._versions),
            begun=strftime("%Y-%m-%dT%H:%M:%S%z"),
            faults=state.faults.faults,
            draws=None if draws is None else {name: rows.copy() for name, rows in draws.values.items()},
            episodes=None if draws is None else draws.episodes.copy(),
        )

    @cached_property
    def _versions(self) -> dict[str, str]:
        return package_versions()

    # -- transactions ----------------------------------------------------------------------------------------------

    def _execute(self, request: Request, *commit: Commit) -> Any:
        """Execute a command, then warn; return its result."""
        result = self._transactions.run(request, *commit)
        self._warn(stacklevel=5)
        return result

    def _ticks(self, command: Command, substeps: int) -> tuple[Run, Commit]:
        """Return the request for ticks under ``command`` (ticks, envs, ...), after a checkpoint if one is due."""
        every, pool = self.options.checkpoint_steps, self.pool
        if every is not None and self._transactions.state.steps_since_checkpoint >= every:
            self.snapshot()
        setpoint, rate, *_ = command
        if rate is not None:
            command = self._accelerated(command, substeps * self.options.timestep)
        ticks, timestep = len(setpoint), self.options.timestep

        def commit(state: RunnerState, seconds: list[Any]) -> tuple[RunnerState, None]:
            faults, contacts, unrecorded, count = state.faults, state.contacts, state.unrecorded, len(pool.completed)
            are_ok = np.logical_and.reduce(pool.arrays.observation.ok[:count], None)
            is_quiet = are_ok and contacts is None and self.recorder is None
            for done, arrays in enumerate([] if is_quiet else pool.completed, start=1):
                faults = faults.with_faults(arrays)
                if contacts is not None:
                    contacts = contacts.with_contacts(arrays)
                if self.recorder is not None:
                    time = (state.steps + done * substeps) * timestep
                    observation = self._seen(arrays.observation)
                    unrecorded += ((time, arrays.command.setpoint.copy(), observation, rate is not None),)
            if self._moving is not None:
                self._moving.see(setpoint[:count], rate is not None, substeps * timestep)
            if self._chatter is not None and self._chatter.is_watching:
                seen = pool.arrays.observation.map(lambda rows: rows[:count])
                self._chatter.see(seen, substeps * timestep)
            steps = count * substeps
            motion = state.motion
            if motion is not None and count:
                motion = (setpoint[count - 1], None if rate is None else rate[count - 1])
            state = state._replace(
                faults=faults,
                contacts=contacts,
                unrecorded=unrecorded,
                steps=state.steps + steps,
                targets=None if state.targets is None else _followed(state.targets, setpoint[:count]),
                motion=motion,
                steps_since_checkpoint=state.steps_since_checkpoint + steps,
                work=state.work if pool.failure else (tuple(seconds), ticks),
            )
            return state, None

        return Run(ticks, substeps, command.given, command), commit

    def _accelerated(self, command: Command, seconds: float) -> Command:
        """Return ``command`` (ticks, envs, ...) with the mean accelerations in ticks of ``seconds`` with rates.

        The mean is the change of the rate over the tick. It is taken where the setpoints confirm that rates (and given
        accelerations) are those at the tick's end, since they change by the mean of the old and the new rate rather
        than by the new one, as increments do. Elsewhere the given acceleration is kept, or 0.
        """
        setpoint, rate, given, _ = command
        state = self._transactions.state
        if state.motion is None or self.options.control != "pid" or state.params.gain_units is None:
            return command
        before = [0.0 * rate[0] if rows is None else rows for rows in state.motion]
        both = zip((setpoint, rate), before, strict=True)
        with np.errstate(invalid="ignore"):  # non-finite rates become faults
            moved, change = (np.diff(rows, axis=0, prepend=first[None]) for rows, first in both)
            ahead = moved - seconds * rate  # of increments 0, else minus half the change
            fits = np.abs(ahead + 0.5 * seconds * change) < 4 * np.abs(ahead)
            if given is not None:  # with the jerk (given - mean) / (seconds / 2), where the rate is at its largest, too
                end = seconds**2 * given
                fits |= np.abs(ahead + end / 6 + seconds * change / 3) < np.abs(end) / 24
        return command._replace(setpoint_acceleration=np.where(fits, change / seconds, 0.0 if given is None else given))

    def _joints(
        self, name: str, setpoint: ArrayLike, twist: ArrayLike | None, acceleration: ArrayLike | None, ticks: int | None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return joint setpoints and their rates for poses of the tool and its twists."""
        if acceleration is not None:
            problem = "is for joint setpoints, and setpoints are poses"
            raise InvalidArgumentError(name.replace("point", "point_acceleration"), problem, remedy="leave it out")
        last, finite = self._transactions.ready().targets, self.options.on_invalid_input == "raise"
        tool = self._tool_setpoints
        assert tool is not None
        assert last is not None
        qpos = tool.joints(name, setpoint, last, finite, ticks, stacklevel=4)
        return qpos, None if twist is None else tool.rates(name.replace("point", "point_rate"), twist, qpos, finite)

    def _max_ticks(self) -> int:
        """Return the number of ticks that one request may have: none beyond the next checkpoint."""
        most, every = len(self.pool.ticks), self.options.checkpoint_steps
        if every is None:
            return most
        left = every - self._transactions.ready().steps_since_checkpoint % every
        return min(most, -(-left // self.options.substeps))

    def _observation(self) -> Observation:
        """Return a copy of the present observation."""
        return self._seen(self.pool.present.observation)

    def _seen(self, observation: Observation) -> Observation:
        """Return a copy of the loop's ``observation``, with the pose of the tool."""
        seen = observation.map(_COPY)
        return seen if self._tool_pose is None else seen._replace(tool_pose=self._tool_pose(seen.qpos))

    def _record(self) -> None:
        """Pass on the ticks that are not recorded yet."""
        transactions = self._transactions
        while ticks := transactions.state.unrecorded:
            try:
                if self.recorder is not None:
                    self.recorder.append(*ticks[0])
            except BatchPIDError:  # the recorder cannot record any more
                transactions.state = transactions.state._replace(unrecorded=())
                raise
            transactions.state = transactions.state._replace(unrecorded=ticks[1:])

    def _warn(self, stacklevel: int) -> None:
        """Warn of the last commands' lost workers, faults and missed contacts."""
        messages, state = self.pool.messages, self._transactions.state
        while messages:
            category, message = messages.popitem()
            warnings.warn(message, category, stacklevel=stacklevel)
        if self._chatter is not None:
            self._chatter.warn(stacklevel + 1)
        if self._moving is not None and self._moving.found is not None and not self._has_warned_of_motion:
            self._has_warned_of_motion = True
            self._moving.warn(stacklevel + 1)
        faults, contacts = state.faults.faults, state.contacts
        if faults and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"{faults[0]}; see runner.faults for more, of which there is no further warning",
                FaultWarning,
                stacklevel=stacklevel,
            )
        if contacts is not None and contacts.contacts and not self._has_warned_of_contact:
            self._has_warned_of_contact = True
            warnings.warn(contacts.message(), MissedContactWarning, stacklevel=stacklevel)


def _followed(targets: NDArray[Any], setpoints: NDArray[Any]) -> NDArray[Any]:
    """Return the last finite joint setpoints (envs, dof) after ``setpoints`` (ticks, envs, dof)."""
    for rows in setpoints:
        targets = np.where(np.isfinite(rows).all(1, keepdims=True), rows, targets)
    return targets
