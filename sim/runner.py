"""Runner: N robots in N headless scenes, stepped by worker processes under one batch controller.

Longer than 300 lines because the public signatures and their documentation are spelled out for editors and readers.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from inspect import Parameter, Signature, signature
from typing import ClassVar, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid as bp
from batchpid.checks.single_owner import SingleOwner
from batchpid.sim.command import CommandSpec
from batchpid.sim.loop.backend import describe
from batchpid.sim.loop.faults import Fault
from batchpid.sim.loop.snapshot import Snapshot
from batchpid.sim.observation import Observation, Rollout, RunInfo
from batchpid.sim.options import RunnerOptions, default_params, keyword_parameters
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner_keywords import DEFAULT_ENGINE, RunnerKeywords
from batchpid.sim.session import Session, TickRecorder
from batchpid.sim.workers.contact_log import MissedContact
from batchpid.sim.workers.node import NodeInfo


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
        if "engine" not in options and DEFAULT_ENGINE != "sapien":
            warnings.warn(f"SAPIEN is not installed: the engine is {DEFAULT_ENGINE!r}", stacklevel=2)
        self.options = checked = RunnerOptions(robot, num_envs, **options)
        """Options, checked."""
        self.robot, self.num_envs, self.control = checked.robot, checked.num_envs, checked.control
        self.timestep, self.substeps = checked.timestep, checked.substeps
        params = checked.check_params(
            default_params(robot, checked.control, checked.loops) if params is None else params
        )
        self._session = Session(checked, params)
        try:
            self._session.open()
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
        base_pose: ArrayLike | None = None,
        base_twist: ArrayLike | None = None,
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
        base_pose
            Pose of a floating base, its root link, (7,) or (envs, 7): position [m] and quaternion (w, x, y, z). Default
            upright above the origin, with the lowest point of the robot's collision shapes on the ground; without a
            ground at the origin.
        base_twist
            Velocity of that link's origin and its angular velocity, along the axes of the world, (6,) or (envs, 6)
            [m/s, rad/s]; default 0.

        Raises
        ------
        CallOrderError
            The observation of a tick that was sent has not been received, as for :meth:`step`, :meth:`rollout` and
            :meth:`restore`.
        """
        return self._session.reset(qpos, qvel, mask, seed, base_pose, base_twist)

    def step(
        self,
        setpoint: ArrayLike,
        *,
        setpoint_rate: ArrayLike | None = None,
        setpoint_acceleration: ArrayLike | None = None,
        feedforward: ArrayLike | None = None,
        substeps: int | None = None,
    ) -> Observation:
        """Run one tick: ``substeps`` sim steps under ``setpoint``.

        Parameters
        ----------
        setpoint
            (dof,) or (envs, dof) [rad or m]; under control "effort" the joint effort [N m or N]. A follower's
            value (:attr:`batchpid.sim.Robot.coupling`) is replaced by the coupling's value for the leader's setpoint;
            an effort acts on the leader. A :class:`batchpid.sim.Controller` that defines its command takes (size,) or
            (envs, size): :attr:`command`. With ``setpoint_space="tool"`` it is a pose (7,) or (envs, 7), or
            :attr:`command`.
        setpoint_rate
            Rate of the setpoint [rad/s or m/s], same shapes, with which the setpoint moves within the tick. Both hold
            at the tick's end: the setpoint of a sim step that begins t before it is ``setpoint - t setpoint_rate``. The
            law damps the velocity error instead of the velocity, and follows this motion with full weight. Controls
            other than "pid" and "drive" ignore it. With ``setpoint_space="tool"`` it is the twist of the tool in the
            world (6,) or (envs, 6) [m/s, rad/s].
        setpoint_acceleration
            Acceleration of the setpoint [rad/s^2 or m/s^2], same shapes, besides its rate: a law with gains per unit of
            inertia adds it to the acceleration that it commands. Other gains take ``feedforward``. Default 0. Where the
            setpoints confirm that the rate is the one at the tick's end, as in a smooth trajectory, its change over the
            tick is taken instead, which is the mean acceleration.
        feedforward
            Joint effort (dof,) or (envs, dof) [N m or N] added to the passive force before saturation.
        substeps
            Sim steps of this tick; default the runner's.
        """
        return self._session.step(setpoint, setpoint_rate, setpoint_acceleration, feedforward, substeps)

    def send(
        self,
        setpoint: ArrayLike,
        *,
        setpoint_rate: ArrayLike | None = None,
        setpoint_acceleration: ArrayLike | None = None,
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
        self._session.send(setpoint, setpoint_rate, setpoint_acceleration, feedforward, substeps)

    def recv(self) -> Observation:
        """Wait for the end of the tick that :meth:`send` began; return its observation.

        Raises
        ------
        CallOrderError
            No tick was sent since the last call.
        """
        return self._session.recv()

    def rollout(
        self,
        setpoints: ArrayLike,
        *,
        setpoint_rates: ArrayLike | None = None,
        setpoint_accelerations: ArrayLike | None = None,
        feedforwards: ArrayLike | None = None,
        progress: Callable[[Iterable[int]], Iterable[int]] | None = None,
    ) -> Rollout:
        """Run one tick for each row of ``setpoints`` and record every observation.

        Parameters
        ----------
        setpoints
            (ticks, envs, dof), or (ticks, dof) for all envs [rad or m]; for another command (ticks, envs, size).
        setpoint_rates, setpoint_accelerations, feedforwards
            Also with the ticks first: see :meth:`step`.
        progress
            Wraps the range of ticks, e.g. ``tqdm.tqdm``.
        """
        return self._session.rollout(setpoints, setpoint_rates, setpoint_accelerations, feedforwards, progress)

    def observe(self) -> Observation:
        """Return the state of every env, as fresh arrays."""
        return self._session.observe()

    def poses(self) -> NDArray[np.float32]:
        """Return the poses of the entities that ``build`` returned (envs, entities, 7): x, y, z [m], w, x, y, z.

        Raises
        ------
        InvalidArgumentError
            There is no ``build``, or it returned more entities for one env than for another.
        """
        return self._session.poses()

    def bodies(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Return the poses of bodies of an MJCF file (envs, names, 7), in the engine "mujoco".

        They are the positions [m] and quaternions (w, x, y, z) of MuJoCo's body frames in the world: of objects, which
        the file has besides the robot, and of the robot's own bodies.

        Raises
        ------
        InvalidArgumentError
            The robot is not from an MJCF file, the engine is another, or the file has no such body.
        """
        return self._session.bodies(names)

    @property
    def params(self) -> bp.PIDParams:
        """PID parameters; assign new ones to change gains, limits or times in flight (bumpless in the integral)."""
        return self._session.state.params

    @params.setter
    def params(self, params: bp.PIDParams) -> None:
        self._session.set_params(params)

    @property
    def actuators(self) -> bp.Actuators | None:
        """Actuators, None for ideal ones; assign others to change them in flight. Delays keep their histories.

        As in the option, assign None for the robot's own actuators, and ``bp.Actuators()`` for ideal ones.
        """
        return self._session.state.actuators

    @actuators.setter
    def actuators(self, actuators: bp.Actuators | None) -> None:
        self._session.set_actuators(actuators)

    def snapshot(self) -> Snapshot:
        """Return the state of all envs, physics and controller, for :meth:`restore`.

        It is a barrier: this runner, too, goes on as if restored from it, so that both are bit-identical from here on.
        """
        return self._session.snapshot()

    def restore(self, snapshot: Snapshot) -> Observation:
        """Put all envs into the state of ``snapshot``, with its params and actuators.

        The snapshot is from this runner, or from one with the same options, except for:

        - ``workers``, ``cluster``, ``recover`` and ``timeout``, which change no result, and
          ``checkpoint_steps``, which changes the last bits;
        - ``substeps`` and ``on_invalid_input``, which apply to the commands that follow.

        A controller or ``build`` of the caller's own counts by its code, constants, closure and attributes, and by the
        globals that it names, as they are when the runner is made. So snapshots of an edited function are refused, and
        of another version of Python. Make a new controller for each runner if calls change its attributes.

        Raises
        ------
        InvalidArgumentError
            It is of another robot, number of envs, timestep, control, ...; the message names the options.
        """
        return self._session.restore(snapshot)

    def settle(self) -> None:
        """Complete a command whose call was interrupted (Ctrl-C), as every other method does first.

        A closed runner passes completed ticks on to the recorder.
        """
        self._session.settle()

    # -- properties ------------------------------------------------------------------------------------------------

    @property
    def info(self) -> RunInfo:
        """Robot, options and origin of a run that starts now."""
        return self._session.info()

    @property
    def command(self) -> CommandSpec:
        """Names and units of a setpoint's entries: the joints, or as a controller declares them."""
        tool = self.options.tool_setpoints
        return self.options.command if tool is None else tool.command

    @property
    def recorder(self) -> TickRecorder | None:
        """Recorder of every tick; :class:`batchpid.sim.Recorder` sets it."""
        return self._session.recorder

    @recorder.setter
    def recorder(self, recorder: TickRecorder | None) -> None:
        self._session.recorder = recorder

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Envs that failed, latest last: the last ten thousand."""
        return self._session.state.faults.faults

    @property
    def missed_contacts(self) -> tuple[MissedContact, ...]:
        """First contact that each robot would have had since its reset, without collisions; latest last."""
        contacts = self._session.state.contacts
        return () if contacts is None else tuple(contacts.contacts)

    @property
    def draws(self) -> dict[str, NDArray[np.float64]]:
        """Draws of the randomization for the present episodes, by field: (envs, joints or links), as copies."""
        return {name: rows.copy() for name, rows in self._session.state.draws.values.items()}

    @property
    def episodes(self) -> NDArray[np.int64]:
        """Stream and number of the present episode of each env (envs, 2); (0, 2) without a randomization."""
        return self._session.state.draws.episodes.copy()

    @property
    def backend(self) -> str:
        """Library of the law, and kind of the calls into the engine, with the reason if they are not native."""
        return describe(self.options, self.actuators)

    @property
    def time(self) -> float:
        """Simulated time since the start [s]."""
        return self._session.state.steps * self.timestep

    @property
    def work_seconds(self) -> NDArray[np.float64]:
        """Seconds of work of each worker in the last tick; after a rollout, the mean over the ticks of one request."""
        seconds, ticks = self._session.state.work
        return np.array(seconds) / ticks

    @property
    def recoveries(self) -> int:
        """Number of lost workers that were replaced."""
        return self._session.pool.recoveries

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of the workers."""
        return tuple(worker.pid for worker in self._session.pool.workers if worker.pid is not None)

    @property
    def nodes(self) -> tuple[NodeInfo, ...]:
        """Machines of a cluster, in the order of their envs; empty without ``cluster``."""
        return self._session.pool.nodes

    def close(self) -> None:
        """End the workers and free the scenes. May be called again, as after an interrupt."""
        self._session.close()

    @property
    def closed(self) -> bool:
        """True after :meth:`close`, or after a worker was lost for good."""
        return self._session.pool.closed

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        if hasattr(self, "_session"):  # its options were right
            self.close()


_NAMED = [each for each in signature(Runner).parameters.values() if each.kind != Parameter.VAR_KEYWORD]
Runner.__signature__ = Signature(_NAMED + keyword_parameters())
