"""Runner: N robots in N headless scenes, on the cores you have, under one batch controller."""

from __future__ import annotations

import hashlib
import os
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import astuple, replace
from functools import cached_property
from pathlib import Path
from time import strftime
from types import TracebackType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.errors import ClosedError, InvalidArgumentError
from batchpid.validate import array, choice, env_mask, flag, integer, joint_speeds, number, read_array, within
from batchpid.versions import package_versions
from sim.engine.building import SceneSpec
from sim.engine.physics import PHYSICS, Physics
from sim.engine.variation import Variation
from sim.loop.arrays import Arrays, Command
from sim.loop.control import CONTROLS, check_params, default_params
from sim.loop.faults import ACTIONS, Fault, FaultLog
from sim.loop.loop import COMPENSATE, LoopSpec
from sim.loop.snapshot import EnvStates, Snapshot
from sim.observation import Observation, Rollout, RunInfo, empty_observation
from sim.robot.limits import SetpointCheck
from sim.robot.robot import Robot
from sim.workers.pool import WorkerPool, packing
from sim.workers.requests import Call, Run, Worker
from sim.workers.worker import ProcessWorker

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

_FAR = 1e6  # rad or m, and per second
_AHEAD = 8000  # sim steps of envs that a worker of a rollout is sent at once: a fifth of a second


class TickRecorder(Protocol):
    """Receives every tick of a runner; :class:`sim.Recorder` is one."""

    path: Path

    def append(self, time_: float, setpoint: NDArray[Any], observation: Observation) -> None:
        """Record the state at ``time_`` [s], reached under ``setpoint`` (envs, dof)."""


class Runner:
    """N robots in N headless SAPIEN scenes under explicit PID, drive or effort control.

    Parameters
    ----------
    robot
        From :meth:`sim.Robot.load`.
    num_envs
        How many robots, one in each scene.
    params
        PID parameters of one row, or one row per env; default ``robot.params()``. Under control "drive" their kp
        and kd are the drive's stiffness and damping (default: the robot's settings).
    workers
        Processes that step the scenes; 0 runs the same code in this process. Default: one for each available
        core, and each keeps to its own. The results are the same bytes for any number.
    timestep
        Of simulation and control [s].
    substeps
        Sim steps of one :meth:`step`, all under the same setpoint; the PID runs at every one of them.
    control
        ``"pid"``; ``"drive"``: PhysX's internal PD drive; ``"effort"``: the setpoint given to :meth:`step` is the
        joint effort itself.
    compensate
        Passive force added at every sim step: ``"gravity+coriolis"``, ``"gravity"`` or ``"none"``.
    physics
        ``"accurate"`` (SAPIEN's solver settings), ``"fast"``, or a :class:`sim.Physics`.
    ground
        Whether every scene has a ground plane at height 0.
    build
        ``build(scene, env)`` adds the caller's own actors to the ``sapien.Scene`` of each env. Visuals and lights that
        it asks for are left out, so tutorial code runs as it is. It may return the entities that :meth:`poses` tells
        of. A reset puts what it added back to where it left it.
    pack_size
        Scenes that share a PhysX system, at most: a matter of speed. A robot gets a system of its own before
        something touches it, so that nothing else depends on it (docs/reliability.md).
    on_fault
        What becomes of an env that fails, while the others go on undisturbed: ``"hold"`` it at rest where it last
        was sound, with ``ok`` False until it is reset; or ``"reset"`` it to where it last started, with
        ``ok`` False for that tick. An env fails when its state is no longer finite, or by ``speed_limit``.
    speed_limit
        Joint speed at which an env fails, one for all joints or (dof,) [rad/s or m/s]; default none.
    variation
        How each env's robot differs from the model: :func:`sim.tuning.randomization.draw_variation`. It is not part
        of snapshots, so with it there is no recovery and no checkpoint.
    on_invalid_input
        What a NaN or infinity in a setpoint, its rate, a feedforward or a pose to reset to does: ``"raise"`` an
        error, or ``"contain"`` it: the env that it is for fails.
    recover
        Whether a worker process that dies or gets stuck is replaced, and its envs brought back by replay: the results
        are the same bytes as if nothing had happened. Otherwise :class:`batchpid.errors.WorkerError` is raised.
    checkpoint_steps
        Sim steps after which all workers start from a snapshot anew, so that no replay is longer than that; None:
        never, and all commands are kept. Results depend on it in the last bits after contacts, on nothing else said
        here about workers.
    timeout
        Seconds, beyond any time that its work can take, before a worker counts as stuck. One that is stopped or asleep
        amid a tick counts as stuck within a second.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range, before any process starts.
    """

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        *,
        params: bp.PIDParams | None = None,
        workers: int | None = None,
        timestep: float = 1 / 2000,
        substeps: int = 20,
        control: str = "pid",
        compensate: str = "gravity+coriolis",
        physics: str | Physics = "accurate",
        ground: bool = True,
        build: Callable[[Any, int], Any] | None = None,
        pack_size: int = 4,
        on_fault: str = "hold",
        speed_limit: ArrayLike | None = None,
        variation: Variation | None = None,
        on_invalid_input: str = "raise",
        recover: bool = True,
        checkpoint_steps: int | None = 8000,
        timeout: float = 60.0,
    ) -> None:
        self._pool: WorkerPool | None = None
        if not isinstance(robot, Robot):
            raise InvalidArgumentError(
                "robot",
                "must be a Robot",
                value=robot,
                remedy="load one with Robot.load('panda') or a URDF path",
            )
        self.robot = robot
        self._limits = SetpointCheck(robot)
        self.num_envs = integer("num_envs", num_envs, 1, 1_000_000)
        count = len(os.sched_getaffinity(0)) if workers is None else integer("workers", workers, 0, 1024)
        self.timestep = number("timestep", timestep, 1e-6, 0.1, "seconds; the tutorial's is 1/2000")
        self.substeps = integer("substeps", substeps, 1, 1_000_000)
        self.control = choice("control", control, CONTROLS)
        self.compensate = choice("compensate", compensate, COMPENSATE)
        self._physics = str(physics)
        if not isinstance(physics, Physics):
            physics = PHYSICS[choice("physics", physics, PHYSICS)]
        pack_size = packing(self.num_envs, integer("pack_size", pack_size, 1, 65535))
        if build is not None and not callable(build):
            raise InvalidArgumentError("build", "must be a function", value=build, remedy="define build(scene, env)")
        self._on_fault = choice("on_fault", on_fault, ACTIONS)
        limit = None if speed_limit is None else joint_speeds("speed_limit", speed_limit, robot.joint_names)
        self._contains = choice("on_invalid_input", on_invalid_input, ("raise", "contain")) == "contain"
        self._checkpoint_steps = (
            None if checkpoint_steps is None else integer("checkpoint_steps", checkpoint_steps, 1, 10**9)
        )
        recover = flag("recover", recover)
        timeout = number("timeout", timeout, 1e-3, 1e9, "seconds")
        self._params = check_params(
            default_params(robot, self.control) if params is None else params,
            robot,
            self.num_envs,
            self.control,
        )
        scene = SceneSpec(
            urdf=robot.urdf,
            srdf=robot.srdf,
            joints=robot.joints,
            timestep=self.timestep,
            physics=physics,
            dissipation=robot.dissipation,
            ground=flag("ground", ground),
            fixed_base=robot.fixed_base,
            build=build,
        )
        self._steps = self._since_checkpoint = 0
        self._faults = FaultLog(self.num_envs, robot.joint_names, self.timestep, on_fault)
        self.recorder: TickRecorder | None = None
        """What records every tick; :class:`sim.Recorder` sets it."""
        self.work_seconds = np.zeros(0)
        """Seconds that each worker worked in the last tick; in a rollout, the mean of those it did at a time."""
        self._about = {
            "robot": robot.name,
            "urdf": hashlib.sha256(robot.urdf.encode()).hexdigest(),
            "joints": list(robot.joint_names),
            "num_envs": self.num_envs,
            "timestep": self.timestep,
            "control": self.control,
            "compensate": self.compensate,
            "physics": list(astuple(physics)),
            "dissipation": robot.dissipation,
            "ground": scene.ground,
            "fixed_base": robot.fixed_base,
        }

        def spec(envs: slice) -> LoopSpec:
            return LoopSpec(
                scene=scene,
                num_envs=envs.stop - envs.start,
                params=first_params.for_envs(envs),
                control=self.control,
                compensate=self.compensate,
                pack_size=pack_size,
                first_env=envs.start,
                on_fault=on_fault,
                speed_limit=limit,
                variation=None if variation is None else variation.for_envs(envs),
            )

        self._varies = variation is not None
        if variation is not None:
            if not isinstance(variation, Variation):
                raise InvalidArgumentError(
                    "variation", "is none", value=variation, remedy="draw one with draw_variation"
                )
            if len(variation.payload) != self.num_envs:
                raise InvalidArgumentError(
                    "variation",
                    f"is for {len(variation.payload)} envs, not {self.num_envs}",
                    remedy="draw one for each env",
                )
            recover, self._checkpoint_steps = False, None
        first_params = self._params
        share = -(-self.num_envs // max(count, 1))
        self._pool = WorkerPool(
            spec,
            self.num_envs,
            count,
            pack_size,
            ticks=max(1, _AHEAD // (self.substeps * share)),
            recover=recover,
            timeout=timeout,
        )
        self._last = 0  # which of the pool's ticks is the present
        try:
            self.reset()
        except BaseException:
            self.close()
            raise

    # -- commands ------------------------------------------------------------------------------------------------

    def reset(
        self, qpos: ArrayLike | None = None, qvel: ArrayLike | None = None, mask: ArrayLike | None = None
    ) -> Observation:
        """Place robots at ``qpos`` and ``qvel`` with a fresh controller state and zero effort.

        Parameters
        ----------
        qpos, qvel
            (dof,) or (envs, dof) [rad or m, and per second]; default the robot's start pose, at rest.
        mask
            (envs,) bool: which envs; default all. The others go on undisturbed.
        """
        pool = self._open()
        start = self.robot.start if qpos is None else qpos
        position = self._within("qpos", self._rows("qpos", start))
        velocity = self._within("qvel", self._rows("qvel", 0.0 if qvel is None else qvel))
        chosen = np.ones(self.num_envs, bool) if mask is None else env_mask("mask", mask, self.num_envs)
        self._limits.check("qpos", position[chosen])
        self._last = 0
        pool.run(Call("reset", (chosen, position, velocity)))
        self._faults.forget(chosen)
        self._faults.note(pool.ticks[0])
        return self.observe()

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
            (dof,) or (envs, dof) [rad or m]; under control "effort" the joint effort [N m or N].
        setpoint_rate
            Its rate [rad/s or m/s], same shapes: damps the velocity error instead of the velocity.
        feedforward
            Effort [N m or N] added before saturation, beside the passive force.
        substeps
            Sim steps of this tick; default the runner's.
        """
        self._open()
        count = self.substeps if substeps is None else integer("substeps", substeps, 1, 1_000_000)
        target = self._rows("setpoint", setpoint)
        rate = None if setpoint_rate is None else self._rows("setpoint_rate", setpoint_rate)
        extra = None if feedforward is None else self._rows("feedforward", feedforward)
        if self.control != "effort":
            self._limits.check("setpoint", target)
        self._run(Command(target, rate, extra).map(lambda rows: rows[None]), 1, count)
        return self.observe()

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
            (ticks, envs, dof), or (ticks, dof) for all envs alike [rad or m].
        setpoint_rates, feedforwards
            The same shapes: see :meth:`step`.
        progress
            Wraps the range of ticks, e.g. ``tqdm.tqdm``.
        """
        pool = self._open()
        table = read_array("setpoints", setpoints)
        ticks = table.shape[0] if table.ndim in (2, 3) else 0
        if ticks == 0:
            raise InvalidArgumentError(
                "setpoints",
                f"must have shape (ticks, {self.num_envs}, {self.robot.dof}) or (ticks, {self.robot.dof})",
                value=table.shape,
                remedy="repeat a constant setpoint with np.broadcast_to(setpoint, (ticks, dof))",
            )
        shape = (ticks, self.num_envs, self.robot.dof)

        def over_time(name: str, value: ArrayLike | None) -> NDArray[np.float64] | None:
            if value is None:
                return None
            rows = read_array(name, value)
            return self._rows(name, rows[:, None] if rows.ndim == 2 else rows, shape)

        targets = over_time("setpoints", setpoints)
        command = Command(targets, over_time("setpoint_rates", setpoint_rates), over_time("feedforwards", feedforwards))
        assert targets is not None
        if self.control != "effort":
            self._limits.check("setpoint", targets)
        seen = empty_observation(ticks, self.num_envs, self.robot.dof)
        times = (self._steps + self.substeps * np.arange(1, ticks + 1)) * self.timestep
        info, done = self.info, 0
        for tick in range(ticks) if progress is None else progress(range(ticks)):
            if tick == done:  # a tick for which no worker has been sent ahead
                done = min(ticks, tick + self._room())
                sent = slice(tick, done)
                self._run(command.map(lambda rows, sent=sent: rows[sent]), done - tick, self.substeps)
                for row, arrays in zip(range(tick, done), pool.ticks, strict=False):
                    for table, now in zip(seen, arrays.observation, strict=True):
                        table[row] = now
        info = replace(info, faults=tuple(self.faults))
        return Rollout(times, targets.copy(), seen, self.timestep * self.substeps, info)

    def observe(self) -> Observation:
        """State of every env now, as fresh arrays."""
        return self._observe(self._open().ticks[self._last])

    def poses(self) -> Float32:
        """Poses now of the entities that ``build`` returned, (envs, entities, 7): x, y, z [m], quaternion w, x, y, z.

        Raises
        ------
        InvalidArgumentError
            There is no ``build``, or it returned more entities for one env than for another.
        """
        rows = [row for part in self._open().run(Call("poses"), keep=False) for row in part]
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
        return self._params

    @params.setter
    def params(self, params: bp.PIDParams) -> None:
        pool = self._open()
        params = check_params(params, self.robot, self.num_envs, self.control)
        pool.run(Call("set_params", (params,)))
        self._params = params

    @property
    def info(self) -> RunInfo:
        """Robot, options and origin of a run that starts now."""
        return self.robot.run_info(
            timestep=self.timestep,
            substeps=self.substeps,
            control=self.control,
            compensate=self.compensate,
            physics=self._physics,
            params=self._params,
            start=self.observe().qpos,
            versions=self._versions,
            begun=strftime("%Y-%m-%dT%H:%M:%S%z"),
            faults=tuple(self.faults),
        )

    @cached_property
    def _versions(self) -> dict[str, str]:
        return package_versions()

    def snapshot(self) -> Snapshot:
        """State of all envs, physics and controller, to go on from: :meth:`restore`.

        It is a barrier: this runner, too, goes on from it as from a restored one, so that both give the same bytes.
        """
        pool = self._open()
        self._refuse_variation()
        states = EnvStates.join(pool.run(Call("snapshot")))
        snapshot = Snapshot(self._about, self._steps, self._params, states)
        self._start_from(snapshot)
        return snapshot

    def restore(self, snapshot: Snapshot) -> Observation:
        """Put all envs into the state of ``snapshot``, with its params, from this runner or another like it.

        Raises
        ------
        InvalidArgumentError
            It is of another robot, number of envs, timestep, control, ...
        """
        pool = self._open()
        self._refuse_variation()
        if not isinstance(snapshot, Snapshot):
            raise InvalidArgumentError(
                "snapshot", "is none", value=type(snapshot).__name__, remedy="take one with runner.snapshot()"
            )
        snapshot.check(self._about)
        check_params(snapshot.params, self.robot, self.num_envs, self.control)
        sizes = [size for part in pool.run(Call("content_sizes"), keep=False) for size in part]
        snapshot.states.check(self.num_envs, self.robot.dof, snapshot.params, sizes)
        self._last = 0
        pool.run(Call("restore", (snapshot,)))
        self._steps, self._params = snapshot.steps, snapshot.params
        self._faults.restore(snapshot.states.containment["step"])
        self._start_from(snapshot)
        return self.observe()

    @property
    def faults(self) -> deque[Fault]:
        """Envs that failed, latest last: the last ten thousand."""
        return self._faults.faults

    @property
    def time(self) -> float:
        """Simulated seconds since the start."""
        return self._steps * self.timestep

    @property
    def recoveries(self) -> int:
        """How many lost workers were replaced."""
        return 0 if self._pool is None else self._pool.recoveries

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of the workers."""
        return tuple(worker.pid for worker in self._workers if isinstance(worker, ProcessWorker))

    def close(self) -> None:
        """End the workers and free the scenes. May be called again."""
        if self._pool is not None:
            self._pool.close()

    @property
    def closed(self) -> bool:
        """Whether it was closed, or a worker was lost for good."""
        return self._pool is None or self._pool.closed

    def __enter__(self) -> Runner:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __del__(self) -> None:
        if getattr(self, "_pool", None) is not None:
            self.close()

    # -- inside --------------------------------------------------------------------------------------------------

    def _run(self, command: Command, ticks: int, substeps: int) -> None:
        """Run ticks under ``command`` (ticks, envs, dof)."""
        pool = self._open()
        if self._checkpoint_steps is not None and self._since_checkpoint >= self._checkpoint_steps:
            self.snapshot()
        before, self._steps = self._steps, self._steps + ticks * substeps
        self._since_checkpoint += ticks * substeps
        self._last = ticks - 1
        self.work_seconds = np.array(pool.run(Run(command, ticks, substeps))) / ticks
        for done, arrays in enumerate(pool.ticks[:ticks], start=1):
            self._faults.note(arrays)
            if self.recorder is not None:
                time = (before + done * substeps) * self.timestep
                self.recorder.append(time, command.setpoint[done - 1], self._observe(arrays))

    def _room(self) -> int:
        """How many ticks the workers can be sent at once: no more than up to the next checkpoint."""
        room = len(self._open().ticks)
        if self._checkpoint_steps is None:
            return room
        left = self._checkpoint_steps - self._since_checkpoint % self._checkpoint_steps
        return min(room, -(-left // self.substeps))

    @staticmethod
    def _observe(arrays: Arrays) -> Observation:
        return Observation._make(array.copy() for array in arrays.observation)

    def _refuse_variation(self) -> None:
        if self._varies:
            raise InvalidArgumentError(
                "variation", "is not part of snapshots", remedy="make the runner without variation="
            )

    def _start_from(self, snapshot: Snapshot) -> None:
        self._since_checkpoint = 0
        self._open().start_from(Call("restore", (snapshot,)))

    @property
    def _workers(self) -> list[Worker]:
        return [] if self._pool is None else self._pool.workers

    def _open(self) -> WorkerPool:
        if self._pool is None or self.closed:
            raise ClosedError("this Runner is closed; make a new one")
        self._pool.settle()
        return self._pool

    def _within(self, name: str, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """``rows``, checked: the engine turns what is far out into NaN."""
        if self._contains:
            return np.where(np.abs(rows) > _FAR, np.nan, rows)
        return within(name, rows, _FAR, self.robot.joint_names)

    def _rows(self, name: str, value: ArrayLike, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
        shape = (self.num_envs, self.robot.dof) if shape is None else shape
        return array(name, value, shape, self.robot.joint_names, finite=not self._contains)
