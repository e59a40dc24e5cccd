"""Runner: N robots in N headless scenes, stepped by worker processes under one batch controller.

Longer than 300 lines because the public signatures and their documentation are spelled out for editors and readers.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from inspect import Parameter, Signature, signature
from operator import methodcaller
from pathlib import Path
from time import strftime
from typing import Any, ClassVar, NamedTuple, Protocol, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.checks.single_owner import SingleOwner
from batchpid.checks.validate import AxisKind, array, env_mask, instance, integer, read_array, within
from batchpid.errors import BatchPIDError, CallOrderError, ClosedError, InvalidArgumentError
from batchpid.io.versions import package_versions
from batchpid.sim.command import CommandSpec
from batchpid.sim.loop.arrays import Arrays, Command
from batchpid.sim.loop.backend import describe
from batchpid.sim.loop.contact_log import MissedContact, MissedContactLog, MissedContactWarning
from batchpid.sim.loop.custom import initial_state
from batchpid.sim.loop.faults import FARTHEST, Fault, FaultLog, FaultWarning
from batchpid.sim.loop.snapshot import EnvStates, Snapshot, initial_actuators
from batchpid.sim.observation import Observation, Rollout, RunInfo, empty_observation
from batchpid.sim.options import IDEAL, RunnerKeywords, RunnerOptions, default_params, keyword_parameters
from batchpid.sim.randomization.draws import NOTHING, Draws
from batchpid.sim.robot.limits import SetpointCheck
from batchpid.sim.robot.loop_stability import StabilityCheck
from batchpid.sim.robot.robot import Robot
from batchpid.sim.workers.ledger import Commit, Ledger
from batchpid.sim.workers.node import NodeInfo
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


class TickRecorder(Protocol):
    """Receives every tick of a runner; :class:`batchpid.sim.Recorder` is one."""

    path: Path

    def append(self, time_: float, setpoint: NDArray[Any], observation: Observation) -> None:
        """Record the state at ``time_`` [s], reached under ``setpoint`` (envs, size).

        After an interrupt it is called again, with the same ``observation``; it is to be recorded once.
        """


_Axis = tuple[AxisKind, tuple[str, ...]]


class _Books(NamedTuple):
    """Everything about a runner that changes with its commands, apart from the workers."""

    params: bp.PIDParams
    faults: FaultLog
    draws: Draws
    steps: int = 0
    steps_since_checkpoint: int = 0
    work_seconds: tuple[float, ...] = ()
    """Of each worker in the last request, for each of its ticks."""
    unrecorded: tuple[tuple[float, NDArray[Any], Observation], ...] = ()
    """Ticks for the recorder: arguments of :meth:`TickRecorder.append`."""
    actuators: bp.Actuators | None = None
    contacts: MissedContactLog | None = None
    """None with collisions."""
    received: Observation | None = None
    """Observation of the tick that was sent, until :meth:`Runner.recv` returns it."""


class Runner(SingleOwner):
    """N robots in N headless SAPIEN scenes under explicit PID, drive or effort control.

    Parameters
    ----------
    robot
        From :meth:`batchpid.sim.Robot.load`.
    num_envs
        Number of robots, one in each scene.
    params
        PID parameters of one row, or one row per env. Default: see :func:`batchpid.sim.options.default_params`.
    workers, timestep, ...
        See :class:`batchpid.sim.RunnerKeywords`.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range; raised before any process starts.
    """

    __signature__: ClassVar[Signature]
    instead = "make another Runner with the same options, and restore a runner.snapshot() in it"

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        *,
        params: bp.PIDParams | None = None,
        **options: Unpack[RunnerKeywords],
    ) -> None:
        self._ledger: Ledger[_Books] | None = None
        self.options = checked = RunnerOptions(robot, num_envs, **options)
        """Options, checked."""
        self.robot, self.num_envs, self.control = checked.robot, checked.num_envs, checked.control
        self.timestep, self.substeps = checked.timestep, checked.substeps
        params = checked.check_params(default_params(robot, checked.control) if params is None else params)
        self._shape, self._joint_names = (self.num_envs, robot.dof), robot.joint_names
        own = checked.own_command
        of_command: _Axis = ("joint" if own is None else "entry", checked.command.names)
        self._axes: tuple[_Axis, ...] = (of_command, of_command, ("joint", robot.joint_names))
        """Last axis of each array of a command: its kind, and the names of its columns."""
        self._finite = checked.on_invalid_input == "raise"
        self._limits = SetpointCheck(robot)
        self._stability = StabilityCheck(robot, self.timestep) if self.control == "pid" else None
        self._checks_setpoints = checked.sets_positions and checked.guard is None
        self.recorder: TickRecorder | None = None
        """Recorder of every tick; :class:`batchpid.sim.Recorder` sets it."""
        self._has_warned = self._has_warned_of_contact = False
        entry_names = None if own is None else own.names
        faults = FaultLog(self.num_envs, robot.joint_names, self.timestep, checked.on_fault, entry_names)
        contacts = None
        if not checked.collisions:
            engine = checked.load_engine()
            contacts = MissedContactLog(
                self.num_envs, self.timestep, lambda qpos: engine.robot_dynamics(robot).nearest_links(qpos)
            )
        self._pool = WorkerPool(checked, params)
        randomization = checked.randomization
        draws = NOTHING if randomization is None else randomization.first(robot, self.num_envs)
        books = _Books(params, faults, draws, actuators=checked.actuators, contacts=contacts)
        self._ledger = Ledger(self._pool, books)
        try:
            self._pool.open()
            self.reset(seed=None if randomization is None else 0)
            if self._stability is not None:
                self._stability.check(params, checked.actuators)
        except BaseException:
            self.close()
            raise

    def __repr__(self) -> str:
        options, workers, nodes = self.options, len(self.pids), len(self.nodes)
        where = "closed" if self.closed else f"{workers} workers" if workers else "in this process"
        collisions = "" if options.collisions else ", no collisions"
        where = f"{nodes} nodes" if nodes else where
        return (
            f"Runner({self.robot.name}, {self.num_envs} envs, {where}, control {options.control_name!r}, compensate "
            f"{options.compensate!r},\n       physics {options.physics!r}{collisions}, timestep {self.timestep:g} s, "
            f"{self.substeps} substeps, at {self.time:g} s)"
        )

    # -- commands ------------------------------------------------------------------------------------------------

    def reset(
        self,
        qpos: ArrayLike | None = None,
        qvel: ArrayLike | None = None,
        mask: ArrayLike | None = None,
        *,
        seed: int | ArrayLike | None = None,
    ) -> Observation:
        """Place robots at ``qpos`` and ``qvel`` with a fresh controller state and zero effort.

        Parameters
        ----------
        qpos, qvel
            (dof,) or (envs, dof) [rad or m, and per second]; default the robot's start pose, at rest. Followers are put
            where their leaders have them.
        mask
            Envs to reset (envs,) bool; default all. The others are not affected.
        seed
            Begin with the first episode of another stream of the randomization: an int s for stream s + k in env k, or
            one for each env. Default: draw for the next episode of each env's stream.

        Raises
        ------
        CallOrderError
            The observation of a tick that was sent has not been received, as for :meth:`step`, :meth:`rollout` and
            :meth:`restore`.
        """
        books = self._received("reset")
        position = self._state("qpos", self.robot.start if qpos is None else qpos)
        velocity = self._state("qvel", 0.0 if qvel is None else qvel)
        chosen = np.ones(self.num_envs, bool) if mask is None else env_mask("mask", mask, self.num_envs)
        self._limits.check("qpos", self.robot.coupled(position), chosen)
        draws, randomization = books.draws, self.options.randomization
        if randomization is not None:
            draws = randomization.redraw(self.robot, draws, chosen, seed)
            position, velocity = randomization.start(position, velocity, draws, self.robot)
        elif seed is not None:
            raise InvalidArgumentError("seed", "has no effect without a randomization", remedy="leave it out")
        if (coupling := self.robot.coupling) is not None:
            position, velocity = coupling.positions(position), coupling.rates(velocity)

        def commit(books: _Books, _: list[Any]) -> tuple[_Books, Observation]:
            present = self._pool.present
            faults = books.faults.without(chosen).noting(present)
            return books._replace(faults=faults, draws=draws), _copy(present)

        observation: Observation = self._execute(Reset(chosen, position, velocity, draws), commit)
        return observation

    def step(
        self,
        setpoint: ArrayLike,
        *,
        setpoint_rate: ArrayLike | None = None,
        feedforward: ArrayLike | None = None,
        substeps: int | None = None,
    ) -> Observation:
        """Run one tick: ``substeps`` sim steps under ``setpoint``.

        Parameters
        ----------
        setpoint
            (dof,) or (envs, dof) [rad or m]; under control "effort" the joint effort [N m or N]. What it has for a
            follower (:attr:`batchpid.sim.Robot.coupling`) is replaced by what the leader's means for it; an effort acts
            on the leader. A :class:`batchpid.sim.Controller` with a command of its own takes (size,) or (envs, size):
            :attr:`command`.
        setpoint_rate
            Rate of the setpoint [rad/s or m/s], same shapes: damps the velocity error instead of the velocity. Not for
            a :class:`batchpid.sim.Controller`, which ignores it.
        feedforward
            Joint effort (dof,) or (envs, dof) [N m or N] added to the passive force before saturation.
        substeps
            Sim steps of this tick; default the runner's.
        """
        self._received("step")
        self._run(*self._tick(setpoint, setpoint_rate, feedforward, substeps))
        return _copy(self._pool.present)

    def send(
        self,
        setpoint: ArrayLike,
        *,
        setpoint_rate: ArrayLike | None = None,
        feedforward: ArrayLike | None = None,
        substeps: int | None = None,
    ) -> None:
        """Begin a tick and return, while the workers run it; :meth:`recv` returns its observation.

        The two are bit-identical to one :meth:`step`, and take its arguments. Other calls in between, and attributes
        such as :attr:`time`, first wait for the tick to end. Calls that change the observation raise CallOrderError.
        With ``workers=0`` the tick runs in this call.

        Raises
        ------
        CallOrderError
            The observation of the last tick that was sent has not been received.
        """
        self._received("send")
        request, commit = self._ticks(*self._tick(setpoint, setpoint_rate, feedforward, substeps))

        def commit_sent(books: _Books, seconds: list[Any]) -> tuple[_Books, None]:
            books, _ = commit(books, seconds)
            return books._replace(received=_copy(self._pool.present)), None

        assert self._ledger is not None
        self._ledger.begin(request, commit_sent, self._record)

    def recv(self) -> Observation:
        """Wait for the end of the tick that :meth:`send` began; return its observation.

        Raises
        ------
        CallOrderError
            No tick was sent since the last call.
        """
        books = self._settle()
        if books.received is None:
            raise CallOrderError("recv: no tick is under way; call send(setpoint) first")
        assert self._ledger is not None
        self._ledger.books = books._replace(received=None)
        self._warn(stacklevel=3)
        return books.received

    def rollout(
        self,
        setpoints: ArrayLike,
        *,
        setpoint_rates: ArrayLike | None = None,
        feedforwards: ArrayLike | None = None,
        progress: Callable[[Iterable[int]], Iterable[int]] | None = None,
    ) -> Rollout:
        """Run one tick for each row of ``setpoints`` and record every observation.

        Parameters
        ----------
        setpoints
            (ticks, envs, dof), or (ticks, dof) for all envs alike [rad or m]; of another command (ticks, envs, size).
        setpoint_rates, feedforwards
            Also with the ticks first: see :meth:`step`.
        progress
            Wraps the range of ticks, e.g. ``tqdm.tqdm``.
        """
        steps, pool, size = self._received("rollout").steps, self._pool, self.command.size
        shape = read_array("setpoints", setpoints).shape
        if len(shape) not in (2, 3) or shape[0] == 0:
            raise InvalidArgumentError(
                "setpoints",
                f"must have shape (ticks, {self.num_envs}, {size}) or (ticks, {size})",
                value=shape,
                remedy=f"repeat a constant setpoint with np.broadcast_to(setpoint, (ticks, {size}))",
            )
        ticks = shape[0]

        def of_ticks(name: str, value: ArrayLike) -> NDArray[np.float64]:
            rows = read_array(name, value)
            return rows[:, None] if rows.ndim == 2 else rows

        given = {"setpoints": setpoints, "setpoint_rates": setpoint_rates, "feedforwards": feedforwards}
        given = {name: None if value is None else of_ticks(name, value) for name, value in given.items()}
        command = self._read_command(given, (ticks,)).map(np.array)  # a copy: ``progress`` may run code of the caller
        if self._checks_setpoints:
            self._limits.check("setpoint", command.setpoint)
        seen = empty_observation(ticks, *self._shape)
        times = (steps + self.substeps * np.arange(1, ticks + 1)) * self.timestep
        info, done = self.info, 0
        shown = iter(range(ticks) if progress is None else progress(range(ticks)))
        for tick in range(ticks):  # not over ``shown``, which may yield anything
            next(shown, None)
            if tick == done:
                done = min(ticks, tick + self._max_ticks())
                part = slice(tick, done)
                self._run(command.map(lambda rows, part=part: rows[part]), self.substeps)
                for table, rows in zip(seen, pool.arrays.observation, strict=True):
                    table[part] = rows[: done - tick]
        next(shown, None)  # the end
        info = replace(info, faults=self.faults)
        return Rollout(times, command.setpoint, seen, self.timestep * self.substeps, info)

    def observe(self) -> Observation:
        """Return the state of every env, as fresh arrays."""
        self._settle()
        return _copy(self._pool.present)

    def poses(self) -> NDArray[np.float32]:
        """Return the poses of the entities that ``build`` returned (envs, entities, 7): x, y, z [m], w, x, y, z.

        Raises
        ------
        InvalidArgumentError
            There is no ``build``, or it returned more entities for one env than for another.
        """
        rows = [row for part in self._execute(ReadPoses(), _read) for row in part]
        counts = [len(row) for row in rows]
        if not rows or len(set(counts)) > 1:
            raise InvalidArgumentError(
                "build",
                f"returned {sorted(set(counts))} entities, by env" if rows else "was not given",
                remedy="let build(scene, env) return as many entities for every env",
            )
        return np.stack(rows)

    @property
    def params(self) -> bp.PIDParams:
        """PID parameters; assign new ones to change gains, limits or times in flight (bumpless in the integral)."""
        return self._books.params

    @params.setter
    def params(self, params: bp.PIDParams) -> None:
        self._settle()
        checked = self.options.check_params(params)
        self._execute(SetParams(checked), lambda books, _: (books._replace(params=checked), None))
        if self._stability is not None:
            self._stability.check(checked, self._books.actuators)

    @property
    def actuators(self) -> bp.Actuators | None:
        """Actuators; assign others to change them in flight, None for ideal ones. Delays keep their histories."""
        return self._books.actuators

    @actuators.setter
    def actuators(self, actuators: bp.Actuators | None) -> None:
        self._settle()
        checked = self.options.check_actuators(actuators)
        self._execute(SetActuators(checked), lambda books, _: (books._replace(actuators=checked), None))

    def snapshot(self) -> Snapshot:
        """Return the state of all envs, physics and controller, for :meth:`restore`.

        It is a barrier: this runner, too, goes on as if restored from it, so that both are bit-identical from here on.
        """
        self._settle()

        def commit(books: _Books, results: list[Any]) -> tuple[_Books, Snapshot]:
            episodes = None if self.options.randomization is None else books.draws.episodes
            states = EnvStates.join(results)
            about = self.options.describe()
            snapshot = Snapshot(about, books.steps, books.params, states, books.actuators, episodes)
            self._pool.start_replay_from(Restore(snapshot, books.draws))
            return books._replace(steps_since_checkpoint=0), snapshot

        snapshot: Snapshot = self._execute(TakeSnapshot(), commit)
        return snapshot

    def restore(self, snapshot: Snapshot) -> Observation:
        """Put all envs into the state of ``snapshot``, with its params, from this runner or one with its options.

        Raises
        ------
        InvalidArgumentError
            It is of another robot, number of envs, timestep, control, ...
        """
        self._received("restore")
        instance("snapshot", snapshot, Snapshot, "take one with runner.snapshot()")
        snapshot.check(self.options.describe())
        snapshot = replace(snapshot, params=self.options.check_params(snapshot.params))
        sizes = [size for part in self._execute(ReadStateSizes(), _read) for size in part]
        controller = initial_state(self.options, snapshot.params)
        acting = actuators = self.options.check_actuators(IDEAL if snapshot.actuators is None else snapshot.actuators)
        draws, randomization = NOTHING, self.options.randomization
        if randomization is not None and snapshot.episodes is not None:
            draws = randomization.draw(self.robot, snapshot.episodes)
            acting = randomization.randomized_actuators(actuators, draws, self.robot)
        motors = initial_actuators(acting, *self._shape, self.timestep)
        stiction = self.options.has_stiction(acting)
        guarded = self.options.guard is not None
        size = self.command.size
        snapshot.states.check(self.num_envs, self.robot.dof, controller, stiction, motors, guarded, sizes, size)
        request = Restore(replace(snapshot, actuators=actuators), draws)

        def commit(books: _Books, _: list[Any]) -> tuple[_Books, Observation]:
            self._pool.start_replay_from(request)
            books = books._replace(
                draws=draws,
                params=snapshot.params,
                actuators=actuators,
                steps=snapshot.steps,
                steps_since_checkpoint=0,
                faults=books.faults.restored(snapshot.states.containment["step"]),
            )
            return books, _copy(self._pool.present)

        observation: Observation = self._execute(request, commit)
        return observation

    def settle(self) -> None:
        """Complete a command whose call was interrupted (Ctrl-C), as every other method does first.

        A closed runner passes on to the recorder what was completed before.
        """
        if self._ledger is not None:
            self._ledger.settle(self._record)

    # -- properties ------------------------------------------------------------------------------------------------

    @property
    def info(self) -> RunInfo:
        """Robot, options and origin of a run that starts now."""
        randomized = self.options.randomization is not None
        return self.robot.run_info(
            **self.options.values_for("recording"),
            own_command=self.options.own_command,
            params=self.params,
            actuators=self.actuators,
            start=self.observe().qpos,
            versions=dict(self._versions),
            begun=strftime("%Y-%m-%dT%H:%M:%S%z"),
            faults=self.faults,
            draws=self.draws if randomized else None,
            episodes=self.episodes if randomized else None,
        )

    @property
    def command(self) -> CommandSpec:
        """Names and units of a setpoint's entries: the joints, or as a controller declares them."""
        return self.options.command

    @cached_property
    def _versions(self) -> dict[str, str]:
        return package_versions()

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Envs that failed, latest last: the last ten thousand."""
        return self._books.faults.faults

    @property
    def missed_contacts(self) -> tuple[MissedContact, ...]:
        """First contact that each robot would have had since its reset, without collisions; latest last."""
        contacts = self._books.contacts
        return () if contacts is None else tuple(contacts.contacts)

    @property
    def draws(self) -> dict[str, NDArray[np.float64]]:
        """Draws of the randomization for the present episodes, by field: (envs, joints or links), as copies."""
        return {name: rows.copy() for name, rows in self._books.draws.values.items()}

    @property
    def episodes(self) -> NDArray[np.int64]:
        """Stream and number of the present episode of each env (envs, 2); (0, 2) without a randomization."""
        return self._books.draws.episodes.copy()

    @property
    def backend(self) -> str:
        """Library of the law, and kind of the calls into the engine, with the reason if they are not native."""
        return describe(self.options, self.actuators)

    @property
    def time(self) -> float:
        """Simulated time since the start [s]."""
        return self._books.steps * self.timestep

    @property
    def work_seconds(self) -> NDArray[np.float64]:
        """Seconds of work of each worker in the last tick; after a rollout, the mean over the ticks of one request."""
        return np.array(self._books.work_seconds)

    @property
    def recoveries(self) -> int:
        """Number of lost workers that were replaced."""
        return 0 if self._ledger is None else self._pool.recoveries

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of the workers."""
        workers = [] if self._ledger is None else self._pool.workers
        return tuple(worker.pid for worker in workers if worker.pid is not None)

    @property
    def nodes(self) -> tuple[NodeInfo, ...]:
        """Machines of a cluster, in the order of their envs; empty without ``cluster``."""
        return () if self._ledger is None else self._pool.nodes

    def close(self) -> None:
        """End the workers and free the scenes. May be called again, as after an interrupt."""
        if self._ledger is not None:
            self._ledger.close()

    @property
    def closed(self) -> bool:
        """True after :meth:`close`, or after a worker was lost for good."""
        return self._ledger is None or self._pool.closed

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        if getattr(self, "_ledger", None) is not None:
            self.close()

    # -- inside --------------------------------------------------------------------------------------------------

    def _execute(self, request: Request, commit: Commit[_Books], stacklevel: int = 3) -> Any:
        """Execute a command, then warn of what it brought; return its result."""
        assert self._ledger is not None
        result = self._ledger.execute(request, commit, self._record)
        self._warn(stacklevel + 1)
        return result

    def _warn(self, stacklevel: int) -> None:
        """Warn of what the last commands brought: lost workers, faults, missed contacts."""
        assert self._ledger is not None
        while self._pool.messages:
            category, message = self._pool.messages.popitem()
            warnings.warn(message, category, stacklevel=stacklevel)
        faults = self._ledger.books.faults.faults
        if faults and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"{faults[0]}; see runner.faults for more, of which there is no further warning",
                FaultWarning,
                stacklevel=stacklevel,
            )
        contacts = self._ledger.books.contacts
        if contacts is not None and contacts.contacts and not self._has_warned_of_contact:
            self._has_warned_of_contact = True
            warnings.warn(contacts.message(), MissedContactWarning, stacklevel=stacklevel)

    def _tick(
        self,
        setpoint: ArrayLike,
        setpoint_rate: ArrayLike | None,
        feedforward: ArrayLike | None,
        substeps: int | None,
    ) -> tuple[Command, int]:
        """Return the command (1, envs, ...) and the sim steps of one tick, checked."""
        count = self.substeps if substeps is None else integer("substeps", substeps, 1, 1_000_000)
        given = {"setpoint": setpoint, "setpoint_rate": setpoint_rate, "feedforward": feedforward}
        command = self._read_command(given)
        if self._checks_setpoints:
            self._limits.check("setpoint", command.setpoint, stacklevel=4)
        return command.map(lambda rows: rows[None]), count

    def _run(self, command: Command, substeps: int) -> None:
        """Run ticks under ``command`` (ticks, envs, ...)."""
        self._execute(*self._ticks(command, substeps), stacklevel=4)

    def _ticks(self, command: Command, substeps: int) -> tuple[Run, Commit[_Books]]:
        """Return the request for ticks under ``command`` (ticks, envs, ...), after a checkpoint if one is due."""
        every, pool, ledger = self.options.checkpoint_steps, self._pool, self._ledger
        assert ledger is not None
        if every is not None and ledger.books.steps_since_checkpoint >= every:
            self.snapshot()
        ticks = len(command.setpoint)
        request = Run.under(command, substeps)

        def commit(books: _Books, seconds: list[Any]) -> tuple[_Books, None]:
            faults, contacts, unrecorded = books.faults, books.contacts, books.unrecorded
            whole = ticks if pool.failure is None else pool.failure.ticks
            for done, arrays in enumerate(pool.ticks.first(whole), start=1):
                faults = faults.noting(arrays)
                if contacts is not None:
                    contacts = contacts.noting(arrays)
                if self.recorder is not None:
                    time = (books.steps + done * substeps) * self.timestep
                    unrecorded += ((time, arrays.command.setpoint.copy(), _copy(arrays)),)
            steps = whole * substeps
            since = books.steps_since_checkpoint + steps
            spent = books.work_seconds if pool.failure else tuple([each / ticks for each in seconds])
            books = books._replace(faults=faults, steps=books.steps + steps, steps_since_checkpoint=since)
            return books._replace(work_seconds=spent, unrecorded=unrecorded, contacts=contacts), None

        return request, commit

    def _record(self) -> None:
        """Pass on the ticks that are not recorded yet."""
        ledger = self._ledger
        assert ledger is not None
        while ticks := ledger.books.unrecorded:
            try:
                if self.recorder is not None:
                    self.recorder.append(*ticks[0])
            except BatchPIDError:  # the recorder cannot record any more
                ledger.books = ledger.books._replace(unrecorded=())
                raise
            ledger.books = ledger.books._replace(unrecorded=ticks[1:])

    def _max_ticks(self) -> int:
        """Return the number of ticks that one request may have: none beyond the next checkpoint."""
        most, every = len(self._pool.ticks), self.options.checkpoint_steps
        if every is None:
            return most
        left = every - self._settle().steps_since_checkpoint % every
        return min(most, -(-left // self.substeps))

    def _settle(self) -> _Books:
        """Complete a command that was sent or interrupted; return the books."""
        if self._ledger is None or self._pool.closed:
            cause = None if self._ledger is None else self._ledger.cause
            reason = "" if cause is None else f", since a call failed ({str(cause).splitlines()[0]})"
            raise ClosedError(f"this Runner is closed{reason}; make a new one")
        ledger = self._ledger
        if not ledger.is_settled or ledger.books.unrecorded:
            ledger.settle(self._record)
        return ledger.books

    def _received(self, call: str) -> _Books:
        """Settle before a call that changes the observation; raise CallOrderError between a send and its recv."""
        books = self._settle()
        if books.received is not None:
            problem = "the observation of the last tick that was sent has not been received"
            raise CallOrderError(f"{call}: {problem}; call recv() first")
        return books

    @property
    def _books(self) -> _Books:
        """State after the last command; that of the last completed one during a call and after the end."""
        assert self._ledger is not None
        if not (self._ledger.is_settled or self._ledger.in_use or self._pool.closed):
            self._ledger.settle(self._record)
        return self._ledger.books

    def _rows(self, name: str, value: ArrayLike) -> NDArray[np.float64]:
        """Return an argument as an array (envs, dof), checked."""
        return array(name, value, self._shape, self._joint_names, finite=self._finite)

    def _read_command(self, given: Mapping[str, Any], ticks: tuple[int, ...] = ()) -> Command:
        """Return a command (*ticks, envs, ...) of the arguments ``given``, checked.

        Positions of followers become those that their leaders mean for them; efforts act on leaders in the loop.
        """
        rows = list[Any]()
        for (name, value), (kind, names) in zip(given.items(), self._axes, strict=True):
            shape = (*ticks, self.num_envs, len(names))
            absent = value is None and rows  # the setpoint, which is first, cannot be
            rows.append(None if absent else array(name, value, shape, names, finite=self._finite, kind=kind))
        command = Command._make(rows)
        if (coupling := self.robot.coupling) is None or not self.options.sets_positions:
            return command
        setpoint, rate, feedforward = command
        return Command(coupling.positions(setpoint), None if rate is None else coupling.rates(rate), feedforward)

    def _state(self, name: str, value: ArrayLike) -> NDArray[np.float64]:
        """Return positions or velocities (envs, dof) to reset to, checked."""
        rows = self._rows(name, value)
        if self._finite:
            return within(name, rows, FARTHEST, self._joint_names)
        return np.where(np.abs(rows) > FARTHEST, np.nan, rows)


_NAMED = [each for each in signature(Runner).parameters.values() if each.kind != Parameter.VAR_KEYWORD]
Runner.__signature__ = Signature(_NAMED + keyword_parameters())


def _copy(arrays: Arrays) -> Observation:
    return Observation._make(map(methodcaller("copy"), arrays.observation))


def _read(books: _Books, results: list[Any]) -> tuple[_Books, list[Any]]:
    """Commit of a command that changes nothing."""
    return books, results
