"""Runner: N robots in N headless scenes, stepped by worker processes under one batch controller.

Each method makes a request of its arguments (:mod:`batchpid.sim.runner.operations`), and
:meth:`Runner._execute` runs it.

Longer than 350 lines because the public methods and their documentation are in one class.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from operator import itemgetter, methodcaller
from time import strftime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.arrays.array_types import Float64, Progress
from batchpid.checks import check_keywords, choice, instance
from batchpid.errors import ClosedError, InvalidArgumentError, SingleOwner, warn
from batchpid.io.files import package_versions
from batchpid.sim.diagnosis.loop_stability import StabilityCheck
from batchpid.sim.findings import report_shortfalls
from batchpid.sim.loop.arrays import Snapshot
from batchpid.sim.loop.faults import Fault, FaultWarning
from batchpid.sim.loop.group_control import describe
from batchpid.sim.options.options import (
    OPTIONS,
    RunnerKeywords,
    RunnerOptions,
    checked_option,
    with_arguments_of,
)
from batchpid.sim.rollout import Rollout, RunInfo
from batchpid.sim.runner.arguments import (
    count_ticks,
    read_chunks,
    read_command,
    refuse_latency,
)
from batchpid.sim.runner.operations import (
    READ,
    SNAPSHOT,
    RunnerState,
    committed,
    goal_of,
    reset_request,
    restore_request,
    restored,
    run_request,
    snapshot_of,
)
from batchpid.sim.signals import CommandSpec, Observation, empty_observation
from batchpid.sim.tool_space import OperationalSpace
from batchpid.sim.workers.pool import Outcome, RecoveryWarning, WorkerPool
from batchpid.sim.workers.requests import OneCall, Request
from batchpid.stages.values import Command

CHECKPOINT_STEPS = 8000
"""Least number of sim steps between checkpoints, from the last of which a lost worker is replayed."""
COPY = methodcaller("copy")
"""Copy of an array; a tick makes several."""


class Runner(SingleOwner):
    """N robots in N headless scenes of a physics engine, under explicit PID, drive or effort
    control.

    docs/runner.md has the ranges of the options, :class:`batchpid.sim.RunnerOptions` their texts.

    Parameters
    ----------
    robot, num_envs
        From :meth:`batchpid.sim.Robot.load`; number of robots, one in each scene.
    params, control, tool, compensate
        PID parameters, default those of the robot; law: "pid", "drive", "effort", "osc" for the
        link ``tool``, or a :class:`batchpid.sim.Controller`; forces that are compensated.
    timestep, substeps
        Time step of simulation and control [s]; sim steps of a tick.
    actuators, plan, guard, stages
        Motors and sensors, default the robot's; plan of a slow policy; limits of setpoints; further
        stages of a sim step.
    engine, physics, collisions, ground, build
        Physics engine, "mujoco" or "sapien"; its solver settings; collision shapes; a ground at
        height 0; content of SAPIEN's scenes.
    contacts, wrenches
        Links whose contact forces, and links whose wrenches are observed.
    randomization
        Distributions from which robots are drawn for each env and episode.
    workers, first_env, timeout, cluster, backend
        Processes that step the scenes, default one per core, 0 for this process; number of the
        first env; time after which a worker counts as stuck [s]; machines; "numpy" or "jax".
    on_fault, on_invalid_input
        Failed envs "hold" or "reset"; inputs that are not finite "raise", or are contained by
        failures ("contain").

    Raises
    ------
    InvalidArgumentError
        An argument is out of range; raised before any process starts.
    """

    instead = "make another Runner with the same options, and restore a runner.snapshot() in it"

    @with_arguments_of(RunnerKeywords)
    def __init__(self, *arguments: Any, **options: Any) -> None:
        check_keywords("Runner", options, OPTIONS)
        self.options = checked = RunnerOptions(*arguments, **options)
        """Options, checked."""
        self.robot = checked.robot
        self.num_envs = checked.num_envs
        self.control = checked.control
        self.timestep = checked.timestep
        self.substeps = checked.substeps
        self._call = OneCall()
        self._state = RunnerState.first(checked)
        self._cause: BaseException | None = None  # of the end
        self._has_warned = False  # of a fault
        self._stability: StabilityCheck | None = None
        if self.control == "pid":
            self._stability = StabilityCheck(self.robot, self.timestep)
        shortfalls = checked.load_engine().shortfalls(checked.scene)
        report_shortfalls(self.robot.path, checked.engine, shortfalls)
        try:
            self._open()
        except BaseException:
            if hasattr(self, "_pool"):
                self.close()
            raise

    def _open(self) -> None:
        """Start the workers, and reset all envs."""
        self._call.begin()
        try:
            self._call.waits = True
            self._pool = WorkerPool(self.options)
            self._pool.open()
        finally:
            self._call.end()
        self.reset(seed=None if self.options.randomization is None else 0)
        self._check_stability()

    def _check_stability(self) -> None:
        """Warn of gains beyond the stability bound of the sampled loop."""
        if self._stability is not None:
            self._stability.check(self._state.params, self._state.actuators)

    def __repr__(self) -> str:
        options = self.options
        state = "closed" if self.closed else f"at {self.time:g} s"
        return (
            f"Runner({self.robot.name}, {self.num_envs} envs, {options.workers} workers,"
            f" control {options.control_name!r}, {options.engine}, timestep {self.timestep:g} s,"
            f" {self.substeps} substeps, {state})"
        )

    # -- commands
    # ----------------------------------------------------------------------------------------------

    def reset(
        self,
        qpos: ArrayLike | None = None,
        qvel: ArrayLike | None = None,
        mask: ArrayLike | None = None,
        *,
        seed: int | ArrayLike | None = None,
        base_pose: ArrayLike | None = None,
        base_twist: ArrayLike | None = None,
    ) -> Observation:
        """Place robots at ``qpos`` and ``qvel`` with a fresh controller state and zero effort.

        Parameters
        ----------
        qpos, qvel
            (dof,) or (envs, dof) [rad or m, and per second]; default the robot's start pose, at
            rest. Followers are put where their leaders have them.
        mask
            Envs to reset (envs,) bool; default all. The others are not affected.
        seed
            Begin with the first episode of another stream of the randomization: an int s for stream
            s + k in env k, or one for each env. Default: draw for the next episode of each env's
            stream.
        base_pose
            Pose of a floating base, its root link, (7,) or (envs, 7): position [m] and quaternion
            (w, x, y, z). Default upright above the origin, with the lowest point of the robot's
            collision shapes on the ground; without a ground at the origin.
        base_twist
            Velocity of that link's origin and its angular velocity, along the axes of the world,
            (6,) or (envs, 6) [m/s, rad/s]; default 0.
        """
        self._ready()
        base = {"base_pose": base_pose, "base_twist": base_twist}
        start = reset_request(
            self.options,
            self._state,
            (qpos, qvel),
            mask,
            seed,
            base,
        )
        self._execute(start)
        return self.observe()

    def step(
        self,
        setpoint: ArrayLike | None,
        *,
        setpoint_rate: ArrayLike | None = None,
        setpoint_acceleration: ArrayLike | None = None,
        feedforward: ArrayLike | None = None,
        latency: ArrayLike = 0.0,
        substeps: int | None = None,
    ) -> Observation:
        """Run one tick: ``substeps`` sim steps under ``setpoint``.

        Parameters
        ----------
        setpoint
            (dof,) or (envs, dof) [rad or m]; under control "effort" the joint effort [N m or N]. A
            follower's value (:attr:`batchpid.sim.Robot.coupling`) is replaced by the coupling's
            value for the leader's setpoint; an effort acts on the leader. With the option ``plan``
            a chunk (envs, rows, dof), where the above is one of one row; its rows are for the
            beginning of this tick less ``latency``, and later in steps of the plan's period; None for
            no chunk. A
            :class:`batchpid.sim.Controller` that defines its command takes (size,) or (envs, size):
            :attr:`command`.
        setpoint_rate
            Rate of the setpoint [rad/s or m/s], same shapes, with which the setpoint moves within
            the tick. Both hold at the tick's end: the setpoint of a sim step that begins t before
            it is ``setpoint - t setpoint_rate``. The law damps the velocity error instead of the
            velocity, and follows this motion with full weight. Controls other than "pid" and
            "drive" ignore it.
        setpoint_acceleration
            Acceleration of the setpoint [rad/s^2 or m/s^2], same shapes, besides its rate: a law
            with gains per unit of inertia adds it to the acceleration that it commands. Other gains
            take ``feedforward``. Default 0. Where the setpoints confirm that the rate is the one at
            the tick's end, as in a smooth trajectory, its change over the tick is taken instead,
            which is the mean acceleration.
        feedforward
            Joint effort (dof,) or (envs, dof) [N m or N] added to the passive force before
            saturation.
        latency
            Age of the chunk, a number or (envs,) [s]; infinite for envs that get none.
        substeps
            Sim steps of this tick; default the runner's.
        """
        if self._pool.closed:
            self._ready()
        command = setpoint, setpoint_rate, setpoint_acceleration, feedforward
        self._execute(self._tick(command, latency, substeps))
        return self._observed()

    def rollout(
        self,
        setpoints: ArrayLike,
        *,
        setpoint_rates: ArrayLike | None = None,
        setpoint_accelerations: ArrayLike | None = None,
        feedforwards: ArrayLike | None = None,
        latency: ArrayLike = 0.0,
        progress: Progress[int] | None = None,
    ) -> Rollout:
        """Run one tick for each row of ``setpoints`` and record every observation.

        Parameters
        ----------
        setpoints
            (ticks, envs, dof), or (ticks, dof) for all envs [rad or m]; for another command (ticks,
            envs, size); with a plan also (ticks, envs, rows, dof).
        setpoint_rates, setpoint_accelerations, feedforwards
            Also with the ticks first: see :meth:`step`.
        latency
            A number, (envs,) or (ticks, envs): see :meth:`step`.
        progress
            Wraps the range of ticks, e.g. ``tqdm.tqdm``.
        """
        self._ready()
        arrays = {
            "setpoints": setpoints,
            "setpoint_rates": setpoint_rates,
            "setpoint_accelerations": setpoint_accelerations,
            "feedforwards": feedforwards,
        }
        options = self.options
        ticks = count_ticks(options, setpoints)
        seconds = options.substeps * options.timestep
        command, chunks = self._command(arrays, latency, seconds, ticks)
        seen = empty_observation(ticks, self.num_envs, options.robot.dof, observed=options.observed)
        info = self.info
        steps = self._state.steps + options.substeps * np.arange(1.0, ticks + 1)
        changes = None
        if self._state.changes is not None:
            changes = np.zeros((ticks, self.num_envs), np.uint8)
            changes[:1] = self._state.changes
        done = 0
        shown = iter(range(ticks) if progress is None else progress(range(ticks)))
        for number in range(ticks):  # not over ``shown``, which may yield anything
            next(shown, None)
            if number == done:
                # One request has several ticks.
                done = min(ticks, number + self._max_ticks())
                if chunks:
                    done = number + 1
                    self._add_chunk(*chunks[number])
                part = slice(number, done)
                rows = command.map(itemgetter(part))
                self._execute(run_request(done - number, options.substeps, rows))
                observed = self._pool.arrays.observation.map(itemgetter(slice(done - number)))
                for name in options.observed:
                    getattr(seen, name)[part] = getattr(observed, name)
        next(shown, None)  # the end
        seen = self._with_tool(seen)
        rated = command.setpoint_rate is not None
        info = replace(info, rates=rated, faults=self._state.faults)
        times = steps * options.timestep
        return Rollout(
            times,
            command.setpoint,
            seen,
            seconds,
            info,
            command.feedforward,
            changes,
        )

    def observe(self) -> Observation:
        """Return the state of every env, as fresh arrays."""
        self._ready()
        return self._observed()

    def _observed(self) -> Observation:
        """Return the present observation, as fresh arrays."""
        # A signal handler may have closed the runner after the tick.
        present: Any = getattr(self._pool, "present", None)
        if present is None:
            self._ready()
        return self._with_tool(present.observation.map(COPY))

    def _with_tool(self, seen: Observation) -> Observation:
        """Return what the loop observed with the pose of the tool, which follows from the joints."""
        if isinstance(self.control, OperationalSpace):
            return seen._replace(tool_pose=self.control.tool_pose(seen.qpos))
        return seen

    def poses(self) -> NDArray[np.float32]:
        """Return the poses of the entities that ``build`` returned (envs, entities, 7): x, y, z
        [m], w, x, y, z.

        Raises
        ------
        InvalidArgumentError
            ``build`` returned more entities for one env than for another, or in SAPIEN is not given.
        """
        self._ready()
        rows = self._execute(Request("poses", changes_loop=False)).result
        if len({len(poses) for poses in rows}) != 1:
            problem = "was not given, or returned more entities for one env than for another"
            remedy = "let build(scene, env) return as many entities for every env"
            raise InvalidArgumentError("build", problem, remedy=remedy)
        return np.stack(rows)

    def bodies(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Return the poses of bodies of an MJCF file (envs, names, 7), in the engine "mujoco".

        They are the positions [m] and quaternions (w, x, y, z) of MuJoCo's body frames in the
        world: of objects, which the file has besides the robot, and of the robot's own bodies.

        Raises
        ------
        InvalidArgumentError
            The robot is not from an MJCF file, the engine is another, or the file has no such body.
        """
        self._ready()
        if self.options.mjcf is None:
            problem = "need a robot from an MJCF file and the engine 'mujoco'"
            remedy = "use robot.kinematic_tree() for links"
            raise InvalidArgumentError("names", problem, remedy=remedy)
        chosen = tuple([choice("names", name, self.options.mjcf.bodies) for name in names])
        return np.stack(self._execute(Request("poses", (chosen,), changes_loop=False)).result)

    @property
    def params(self) -> bp.PIDParams:
        """PID parameters; assign new ones to change gains, limits or times in flight (bumpless in
        the integral).
        """
        return self._state.params

    @params.setter
    def params(self, params: bp.PIDParams) -> None:
        self._ready()
        checked = self.options.check_params(params)
        self._execute(Request("set_params", (checked,)))
        self._check_stability()

    @property
    def actuators(self) -> bp.Actuators | None:
        """Actuators; None for ideal ones. A snapshot brings its own."""
        return self._state.actuators

    def snapshot(self) -> Snapshot:
        """Return the state of all envs, physics and controller, for :meth:`restore`.

        It is a barrier: this runner, too, goes on as if restored from it, so that both are
        bit-identical from here on.
        """
        self._ready()
        return self._take_snapshot()

    def restore(self, snapshot: Snapshot) -> Observation:
        """Put all envs into the state of ``snapshot``, with its params and actuators.

        The snapshot is from this runner, or from one with the same options, except for:

        - ``workers``, ``cluster`` and ``timeout``, which change no result;
        - ``substeps`` and ``on_invalid_input``, which apply to the commands that follow.

        A controller of the caller's own counts by its class, ``build`` by its name, and both by
        their attribute ``version``, if they have one.

        Raises
        ------
        InvalidArgumentError
            It is of another robot, number of envs, timestep, control, ...; the message names the
            options.
        """
        self._ready()
        instance("snapshot", snapshot, Snapshot, "take one with runner.snapshot()")
        snapshot.check_options(self.options.described)
        restore = restored(self.options, snapshot, self._present)
        self._execute(restore)
        self._pool.replay.start_from(restore)
        return self.observe()

    # -- properties
    # ----------------------------------------------------------------------------------------------

    @property
    def info(self) -> RunInfo:
        """Robot, options and origin of a run that starts now."""
        start = self.observe().qpos
        state, options = self._state, self.options
        drawn = {}
        if options.randomization is not None:
            drawn = {"draws": self.draws, "episodes": self.episodes}
        return RunInfo.of(
            options.robot,
            **options.values_for("recording"),
            **drawn,
            own_command=options.own_command,
            params=state.params,
            actuators=state.actuators,
            start=start,
            versions=dict(self._versions),
            begun=strftime("%Y-%m-%dT%H:%M:%S%z"),
            faults=state.faults,
        )

    @cached_property
    def _present(self) -> Snapshot:
        """Snapshot of a moment, whose names and shapes those to restore are compared with."""
        return self._read(READ)

    @cached_property
    def _versions(self) -> dict[str, str]:
        return package_versions()

    @property
    def command(self) -> CommandSpec:
        """Names and units of a setpoint's entries: the joints, or as a controller declares them."""
        return self.options.command

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Envs that failed, latest last: the last ten thousand."""
        return self._state.faults

    @property
    def draws(self) -> dict[str, NDArray[np.float64]]:
        """Draws of the randomization for the present episodes, by field: (envs, joints or links),
        as copies.
        """
        return {name: rows.copy() for name, rows in self._state.draws.values.items()}

    @property
    def _lateness(self) -> Float64:
        """Latency of chunks that the randomization draws (envs,) [s]; 0 without one."""
        options, lateness = self.options, np.zeros((self.num_envs, 1))
        randomization = options.randomization
        if randomization is not None and randomization.latency is not None:
            lateness = randomization.apply("latency", lateness, self._state.draws, options.robot)
        return lateness[:, 0]

    @property
    def episodes(self) -> NDArray[np.int64]:
        """Stream and number of the present episode of each env (envs, 2); (0, 2) without a
        randomization.
        """
        return self._state.draws.episodes.copy()

    @property
    def backend(self) -> str:
        """Library of the law, and kind of the calls into the engine, with the reason if they are
        not native.
        """
        return describe(self.options)

    @property
    def time(self) -> float:
        """Simulated time since the start [s]."""
        return self._state.steps * self.timestep

    @property
    def recoveries(self) -> int:
        """Number of lost workers that were replaced."""
        return self._pool.recoveries

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of the workers."""
        return tuple(worker.pid for worker in self._pool.workers if worker.pid is not None)

    def close(self) -> None:
        """End the workers and free the scenes. May be called again, as after an interrupt."""
        self._pool.closed = True
        # The scenes of a loop in this process are in use until the call ends.
        if not (self._call.in_use and self._pool.is_local):
            self._pool.close()

    @property
    def closed(self) -> bool:
        """True after :meth:`close`, or after a worker was lost for good."""
        return self._pool.closed

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        # Without a pool its options were wrong.
        if hasattr(self, "_pool") and not self.closed:
            self.close()

    # -- execution of commands
    # -------------------------------------------------------------------------------------

    def _ready(self) -> None:
        """Check that the runner can be used.

        Raises
        ------
        ClosedError
            The runner is closed.
        InUseError
            Another call is in progress, or the runner belongs to another process.
        """
        if self._pool.closed:
            reason = ""
            cause = self._cause
            if cause is not None:
                text = str(cause) or type(cause).__name__
                reason = f", since a call failed ({text.splitlines()[0]})"
            raise ClosedError(f"this Runner is closed{reason}; make a new one")
        self._call.check()

    def _tick(
        self,
        arrays: tuple[ArrayLike | None, ...],
        latency: ArrayLike,
        substeps: int | None,
    ) -> Request:
        """Return the request for the arguments of :meth:`step`, checked; a chunk enters the plan."""
        if substeps is None:
            count = self.substeps
        else:
            count = checked_option("substeps", substeps)
        inputs = dict(zip(Command._fields, arrays, strict=True))
        command, chunks = self._command(inputs, latency, count * self.timestep)
        for chunk in chunks:
            self._add_chunk(*chunk)
        return run_request(1, count, command)

    def _command(
        self,
        inputs: dict[str, ArrayLike | None],
        latency: ArrayLike,
        seconds: float,
        ticks: int | None = None,
    ) -> tuple[Command, list[tuple[Float64, Float64]]]:
        """Return the command of one tick, or of ``ticks``: :func:`read_command`; and the chunk of
        each, with the latency of each env.
        """
        chunks: list[tuple[Float64, Float64]] = []
        setpoint = next(iter(inputs))
        if self.options.plan is None:
            refuse_latency(latency)
        elif not any(value is not None for value in list(inputs.values())[:3]):
            inputs[setpoint] = self._goal
        else:
            entries, ages = read_chunks(self.options, inputs, latency, ticks)
            chunks = list(zip(entries, ages + self._lateness, strict=True))
            goals = [self._goal]
            for chunk in chunks:
                goals.append(goal_of(*chunk, goals[-1]))
            inputs[setpoint] = goals[1] if ticks is None else np.array(goals[1:])
        command = read_command(self.options, self._state, inputs, seconds, ticks)
        return command, chunks

    @property
    def _goal(self) -> Float64:
        """Last row of the chunks so far (envs, dof)."""
        assert self._state.motion is not None
        return self._state.motion[0]

    def _add_chunk(self, chunk: Float64, latency: Float64) -> None:
        """Add a chunk to the plans, if it is for an env."""
        if np.isfinite(latency).any():
            self._execute(Request("add_chunk", (chunk, latency)))

    def _execute(self, request: Request) -> Outcome:
        """Execute a request, then issue warnings.

        Ctrl-C does not interrupt it between the request and the new state. The runner is closed if
        the workers cannot complete the request, or if a second Ctrl-C ends it.
        """
        call = self._call
        pool = self._pool
        self._prepare(request)
        # From here on Ctrl-C waits, so that workers and state change together or not at all.
        call.begin()
        try:
            call.waits = True
            outcome = pool.run(request)
            call.waits = False
            if outcome.failure is None:
                self._state = committed(self.options, self._state, outcome)
            elif request.changes_loop:
                self._fail(outcome.failure.error)
        except BaseException as error:
            self._fail(error)
            raise
        finally:
            if pool.closed:
                pool.close()
            call.end()
        if outcome.failure is not None:
            raise outcome.failure.error
        # Warnings come last: as errors they must leave a runner that can go on.
        while pool.warnings:
            warn(pool.warnings.pop(), RecoveryWarning)
        events = self._state.faults
        if events and not self._has_warned:
            self._has_warned = True
            text = f"{events[0]}; see runner.faults for more; this warning is not repeated"
            warn(text, FaultWarning)
        return outcome

    def _prepare(self, request: Request) -> None:
        """Take a checkpoint if one is due, before ticks or a reset.

        Before a reset it is one that the loops do not notice. It holds all that there is of an env
        after its next reset. With ``build`` that is not so: the user's content is not rebuilt.
        """
        is_due = self._state.steps_since_checkpoint >= CHECKPOINT_STEPS
        if request.method == "run":
            if is_due and self._keeps_bits:
                self._take_snapshot()
        elif is_due and request.method == "reset":
            keeps_rest = self._keeps_bits or self.options.build is not None
            if not (keeps_rest or self._pool.replay.waits):
                restore = restore_request(self._read(READ).copy(), self._state.draws)
                self._pool.replay.start_at_resets(restore, self.num_envs)
                self._state = self._state._replace(steps_since_checkpoint=0)

    @cached_property
    def _keeps_bits(self) -> bool:
        """Whether envs go on with the same bits after a snapshot as without it."""
        return "complete_state" in self.options.load_engine().capabilities

    def _fail(self, error: BaseException) -> None:
        """End the runner, which cannot complete a command."""
        self._call.waits = False
        if not isinstance(error, ClosedError):
            self._cause = error
        self._pool.closed = True

    def _take_snapshot(self) -> Snapshot:
        """Return a snapshot, from which the runner goes on, and a replacement of a lost worker
        begins.
        """
        snapshot = self._read(SNAPSHOT)
        self._pool.replay.start_from(restore_request(snapshot.copy(), self._state.draws))
        return snapshot

    def _read(self, request: Request) -> Snapshot:
        """Return the snapshot that a request reads."""
        return snapshot_of(self.options, self._state, self._execute(request).result)

    def _max_ticks(self) -> int:
        """Return the number of ticks that one request may have: none beyond the next checkpoint."""
        left = CHECKPOINT_STEPS - self._state.steps_since_checkpoint % CHECKPOINT_STEPS
        return min(len(self._pool.arrays.observation.ok), -(-left // self.options.substeps))
