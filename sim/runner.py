"""Runner: N robots in N headless scenes, on the cores you have, under one batch controller."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterable
from itertools import pairwise
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.errors import ClosedError, InvalidArgumentError, WorkerError
from batchpid.inertia import check_gain_units

from .arguments import array, choice, flag, integer, number
from .loop import COMPENSATE, CONTROLS, LoopSpec
from .physics import PHYSICS, Physics
from .robot import Robot
from .scenes import SceneSpec
from .worker import LocalWorker, ProcessWorker

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]


class SetpointWarning(UserWarning):
    """A setpoint or start pose lies outside a joint's limits."""


class Observation(NamedTuple):
    """State of every env after a tick. (envs, dof) in the robot's joint order, ``ok`` (envs,).

    ``qpos`` [rad or m], ``qvel`` [rad/s or m/s]; ``effort`` [N m or N] and ``saturated`` as applied in the last
    substep (under control "drive" the effort is the qf beside the drive, which PhysX keeps to itself).
    ``ok`` is False for an env whose state is no longer finite.
    """

    qpos: Float32
    qvel: Float32
    effort: Float32
    saturated: Bool
    ok: Bool


class Rollout(NamedTuple):
    """Observations of a rollout, stacked: (ticks, envs, dof), ``ok`` (ticks, envs), ``time`` (ticks,) [s].

    Row k is the state at the end of tick k, at ``time[k]``.
    """

    time: NDArray[np.float64]
    setpoint: NDArray[np.float64]
    qpos: Float32
    qvel: Float32
    effort: Float32
    saturated: Bool
    ok: Bool


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
        core. The results are the same bytes for any number.
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
    measurement_rate
        Give the law qvel as the measurement's rate instead of letting it difference qpos.
    ground
        Whether every scene has a ground plane at height 0.
    build
        ``build(scene, env)`` adds the caller's own actors to the ``sapien.Scene`` of each env. Visuals and lights that
        it asks for are left out, so tutorial code runs as it is. It may return the entities that :meth:`poses` tells
        of. A reset puts what it added back to where it left it.
    pack_size
        Scenes that share a PhysX system; a matter of speed alone.
    timeout
        Seconds to wait for a worker before it counts as stuck.

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
        measurement_rate: bool = False,
        ground: bool = True,
        build: Callable[[Any, int], Any] | None = None,
        pack_size: int = 4,
        timeout: float = 60.0,
    ) -> None:
        self._workers: list[LocalWorker | ProcessWorker] = []
        self._closed = False
        if not isinstance(robot, Robot):
            raise InvalidArgumentError(
                "robot",
                "must be a Robot",
                value=robot,
                remedy="load one with Robot.load('panda') or a URDF path",
            )
        self.robot = robot
        self.num_envs = integer("num_envs", num_envs, 1, 1_000_000)
        count = len(os.sched_getaffinity(0)) if workers is None else integer("workers", workers, 0, 1024)
        self.timestep = number("timestep", timestep, 1e-6, 0.1, "seconds; the tutorial's is 1/2000")
        self.substeps = integer("substeps", substeps, 1, 1_000_000)
        self.control = choice("control", control, CONTROLS)
        self.compensate = choice("compensate", compensate, COMPENSATE)
        if not isinstance(physics, Physics):
            physics = PHYSICS[choice("physics", physics, PHYSICS)]
        pack_size = integer("pack_size", pack_size, 1, 65535)
        if build is not None and not callable(build):
            raise InvalidArgumentError(
                "build", "must be a function", value=build, remedy="define build(scene, env)"
            )
        self.timeout = number("timeout", timeout, 1e-3, 1e9, "seconds")
        self._params = self._check_params(self._default_params() if params is None else params)
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
        self._warned: set[tuple[str, int]] = set()
        self._ticks = 0
        self.work_seconds = np.zeros(0)
        """Seconds that each worker worked in the last tick."""
        self._slices = _share(self.num_envs, count, pack_size)
        kind = LocalWorker if count == 0 else ProcessWorker
        try:
            for index, envs in enumerate(self._slices):
                spec = LoopSpec(
                    scene=scene,
                    num_envs=envs.stop - envs.start,
                    params=self._params.for_envs(envs),
                    control=self.control,
                    compensate=self.compensate,
                    measurement_rate=flag("measurement_rate", measurement_rate),
                    pack_size=pack_size,
                    first_env=envs.start,
                )
                self._workers.append(kind(spec, index, envs.start))
            if count:
                self._receive()
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
        self._check_open()
        shape = (self.num_envs, self.robot.dof)
        start = self.robot.start if qpos is None else qpos
        position = array("qpos", start, shape, self.robot.joint_names)
        velocity = array("qvel", 0.0 if qvel is None else qvel, shape, self.robot.joint_names)
        chosen = np.ones(self.num_envs, bool) if mask is None else self._check_mask(mask)
        self._warn_limits("qpos", position[chosen])
        for worker, envs in zip(self._workers, self._slices, strict=True):
            worker.send("reset", chosen[envs], position[envs], velocity[envs])
        self._receive()
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
        self._check_open()
        count = self.substeps if substeps is None else integer("substeps", substeps, 1, 1_000_000)
        shape, names = (self.num_envs, self.robot.dof), self.robot.joint_names
        target = array("setpoint", setpoint, shape, names)
        rate = None if setpoint_rate is None else array("setpoint_rate", setpoint_rate, shape, names)
        extra = None if feedforward is None else array("feedforward", feedforward, shape, names)
        if self.control != "effort":
            self._warn_limits("setpoint", target)
        self._tick(target, rate, extra, count)
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
        self._check_open()
        names = self.robot.joint_names
        table = np.asarray(setpoints)
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
            rows = np.asarray(value)
            return array(name, rows[:, None] if rows.ndim == 2 else rows, shape, names)

        targets = over_time("setpoints", setpoints)
        rates, extras = over_time("setpoint_rates", setpoint_rates), over_time("feedforwards", feedforwards)
        assert targets is not None
        if self.control != "effort":
            self._warn_limits("setpoint", targets)
        result = Rollout(
            time=np.asarray((self._ticks + 1 + np.arange(ticks)) * (self.substeps * self.timestep)),
            setpoint=np.array(targets),
            qpos=np.empty(shape, np.float32),
            qvel=np.empty(shape, np.float32),
            effort=np.empty(shape, np.float32),
            saturated=np.empty(shape, np.bool_),
            ok=np.empty(shape[:2], np.bool_),
        )
        for tick in range(ticks) if progress is None else progress(range(ticks)):
            self._tick(
                targets[tick],
                None if rates is None else rates[tick],
                None if extras is None else extras[tick],
                self.substeps,
            )
            for name in Observation._fields:
                self._gather(name, getattr(result, name)[tick])
        return result

    def observe(self) -> Observation:
        """State of every env now, as fresh arrays."""
        self._check_open()
        return Observation(*(self._gather(name) for name in Observation._fields))

    def poses(self) -> Float32:
        """Poses now of the entities that ``build`` returned, (envs, entities, 7): x, y, z [m], quaternion w, x, y, z.

        Raises
        ------
        InvalidArgumentError
            There is no ``build``, or it returned more entities for one env than for another.
        """
        self._check_open()
        for worker in self._workers:
            worker.send("poses")
        rows = [row for part in self._receive() for row in part]
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
        self._check_open()
        self._params = self._check_params(params)
        for worker, envs in zip(self._workers, self._slices, strict=True):
            worker.send("set_params", self._params.for_envs(envs))
        self._receive()

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of the workers."""
        return tuple(worker.pid for worker in self._workers if isinstance(worker, ProcessWorker))

    def close(self) -> None:
        """End the workers and free the scenes. May be called again."""
        self._closed = True
        workers, self._workers = self._workers, []
        for worker in workers:
            worker.close()

    def __enter__(self) -> Runner:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __del__(self) -> None:
        if not getattr(self, "_closed", True):
            self.close()

    # -- inside --------------------------------------------------------------------------------------------------

    def _tick(
        self,
        setpoint: NDArray[np.float64],
        rate: NDArray[np.float64] | None,
        feedforward: NDArray[np.float64] | None,
        substeps: int,
    ) -> None:
        for worker, envs in zip(self._workers, self._slices, strict=True):
            arrays = worker.arrays
            arrays.setpoint[...] = setpoint[envs]
            if rate is not None:
                arrays.setpoint_rate[...] = rate[envs]
            if feedforward is not None:
                arrays.feedforward[...] = feedforward[envs]
            worker.send_tick(substeps, rate is not None, feedforward is not None)
        self.work_seconds = np.array(self._receive())
        self._ticks += 1

    def _receive(self) -> list[Any]:
        """One answer of every worker; on failure all answers are taken before the first error is raised."""
        deadline = time.monotonic() + self.timeout
        results, errors = [], []
        for worker in self._workers:
            try:
                results.append(worker.receive(max(deadline - time.monotonic(), 1e-3)))
            except Exception as error:
                errors.append(error)
        if errors:
            if any(isinstance(error, WorkerError) for error in errors):
                self.close()
            raise errors[0]
        return results

    def _gather(self, name: str, out: NDArray[Any] | None = None) -> NDArray[Any]:
        return np.concatenate([getattr(worker.arrays, name) for worker in self._workers], out=out)

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedError("this Runner is closed; make a new one")

    def _default_params(self) -> bp.PIDParams:
        settings = self.robot.settings
        if self.control == "effort":
            return self.robot.params(kp=0.0, ki=0.0, kd=0.0)
        if self.control == "drive" and settings is not None:
            return self.robot.params(
                kp=settings.drive_stiffness, ki=0.0, kd=settings.drive_damping, effort_limit=None
            )
        return self.robot.params()

    def _check_params(self, params: bp.PIDParams) -> bp.PIDParams:
        if not isinstance(params, bp.PIDParams):
            raise InvalidArgumentError(
                "params",
                "must be PIDParams",
                value=params,
                remedy="build them with robot.params() or make_params()",
            )
        if params.gain_units is not None and self.control != "pid":
            raise InvalidArgumentError(
                "gain_units",
                f"have no meaning under control {self.control!r}",
                remedy="use control 'pid', or params with gain_units 'effort'",
            )
        check_gain_units(params)
        if params.joints != self.robot.dof:
            raise InvalidArgumentError(
                "params",
                f"hold {params.joints} joints, robot {self.robot.name!r} has {self.robot.dof}",
                remedy=f"give one gain for each of {', '.join(self.robot.joint_names)}",
            )
        if params.num_envs not in (1, self.num_envs):
            raise InvalidArgumentError(
                "params",
                f"hold {params.num_envs} envs, the runner has {self.num_envs}",
                remedy="give one row, or one row per env",
            )
        return params

    def _check_mask(self, mask: ArrayLike) -> Bool:
        chosen = np.asarray(mask)
        if chosen.dtype != np.bool_ or chosen.shape != (self.num_envs,):
            raise InvalidArgumentError(
                "mask",
                f"must be bool of shape ({self.num_envs},)",
                value=(chosen.dtype.name, chosen.shape),
                remedy="use e.g. mask = ~obs.ok",
            )
        return chosen

    def _warn_limits(self, argument: str, positions: NDArray[np.float64]) -> None:
        """Warn once for each joint whose ``positions`` (..., dof) leave its limits."""
        robot = self.robot
        outside = (positions < robot.lower - 1e-6) | (positions > robot.upper + 1e-6)
        if not outside.any():
            return
        for index in np.flatnonzero(outside.reshape(-1, robot.dof).any(0)):
            if (argument, int(index)) in self._warned:
                continue
            self._warned.add((argument, int(index)))
            joint, column = robot.joints[index], positions[..., index]
            worst = column.flat[np.argmax(np.maximum(joint.lower - column, column - joint.upper))]
            warnings.warn(
                f"{argument} of joint {joint.name!r} is {worst:g} {joint.unit}, outside its limits "
                f"[{joint.lower:g}, {joint.upper:g}]: the joint cannot reach it; move it inside",
                SetpointWarning,
                stacklevel=3,
            )


def _share(num_envs: int, workers: int, pack_size: int) -> list[slice]:
    """Contiguous slices of envs, one for each worker, cut where packs end as far as that keeps the load even."""
    count = max(1, min(workers, num_envs))
    packs = -(-num_envs // pack_size)
    unit = pack_size if packs % count == 0 else 1
    cuts = [min(num_envs, unit * (-(-num_envs // unit) * k // count)) for k in range(count + 1)]
    return [slice(low, high) for low, high in pairwise(cuts) if high > low]
