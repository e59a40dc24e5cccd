"""Robots that run while they are shown: one Runner for each control, steered from the page."""

from __future__ import annotations

import math
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64
from batchpid.checks.single_owner import SingleOwner
from batchpid.checks.validate import array, choice, integer, number
from batchpid.errors import InvalidArgumentError
from batchpid.sim.observation import Observation, Rollout, RunInfo
from batchpid.sim.options import RunnerOptions, worker_count
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner import Runner
from batchpid.sim.runner_keywords import ControlMode
from batchpid.sim.tool_space.osc_controller import OperationalSpace
from batchpid.sim.view.gains import GroupGains, offered_gains
from batchpid.sim.view.layout import MAX_ROBOTS
from batchpid.sim.view.playback import HISTORY_SECONDS
from batchpid.task_space.rigid_tree import GRAVITY

CONTROLS = ("pid", "drive", "osc")
MAX_DISTANCE = 10.0
"""Largest distance of a target from the robot's base along an axis [m]."""
PUSH_SECONDS = 0.25
"""Duration of a push [s]."""
FASTEST = 3.0
"""Fastest motion of a setpoint that counts as a drag, if the joint's velocity limit is not lower [rad/s or m/s]."""


class LiveSimulation(SingleOwner):
    """``num_envs`` robots for each of ``controls``, all under the same setpoints.

    Parameters
    ----------
    controls
        ``"pid"``, ``"drive"``, or both; or ``"osc"``, whose setpoints are poses of the link ``tool`` (7,).
    tool
        Link that control "osc" moves; default the last link of the robot's longest chain.
    period
        Simulated time between frames [s], rounded to whole sim steps.
    spread
        Largest distance of a joint from the robot's start pose at the beginning [rad or m]; ``seed`` determines it.
    workers
        Processes in all; default one for each core.
    params
        Of the PID, one row, in any gain units; default the tuned gains where the robot has them, else designed ones.
    options
        Of :class:`batchpid.sim.Runner`: physics, compensate, timestep, ...

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
        controls: tuple[ControlMode | Literal["osc"], ...] = ("pid",),
        tool: str | None = None,
        period: float = 1 / 30,
        spread: float = 0.2,
        seed: int = 0,
        workers: int | None = None,
        params: bp.PIDParams | None = None,
        **options: Any,
    ) -> None:
        self.robot = robot
        self.groups: tuple[Any, ...] = tuple(
            dict.fromkeys(choice("controls", control, CONTROLS) for control in controls)
        )
        groups = integer("controls", len(self.groups), 1, len(CONTROLS))
        self.per_group = integer("num_envs", num_envs, 1, MAX_ROBOTS // groups)
        timestep = options.get("timestep", RunnerOptions.timestep)
        substeps = max(1, round(number("period", period, timestep, 1.0, "seconds between frames") / timestep))
        self.period = substeps * timestep
        self._random = np.random.default_rng(seed)
        spread = number("spread", spread, 0.0, 10.0, "rad or m")
        offsets = self._random.uniform(-spread, spread, (self.per_group, robot.dof))
        osc = self._operational_space(tool)
        home = robot.start if osc is None else self._home()
        self.start = np.clip(home + offsets, robot.lower, robot.upper)
        """Joint positions at the beginning (envs, dof) [rad or m]."""
        self.gains = {}
        """Gains of each group, by control; none of control "osc"."""
        if osc is None:
            self.gains = {each: GroupGains(robot, offered_gains(robot, each, params), each) for each in self.groups}
        self.command = None if osc is None else osc.command
        """Entries of a setpoint, if these are not joints: a pose of the tool."""
        self.neutral = robot.start if osc is None else np.array(osc.command.neutral)
        """Setpoint at the start (dof,) [rad or m], or (7,)."""
        self.setpoint = np.tile(self.neutral, (self.per_group, 1))
        """Setpoints of the robots of each group (envs, dof) [rad or m], or (envs, 7)."""
        self._last: Float64 = self.setpoint
        self._rate: Float64 | None = None
        self.payload = 0.0
        """Mass at the load link, a weight without inertia [kg]."""
        self.load_link = robot.rigid_tree.tool
        """Link that payload and pushes act on."""
        self._push: Float64 = np.zeros(3)
        self._count = self._push_frames = 0
        self._frames: deque[Rollout] = deque(maxlen=round(HISTORY_SECONDS / self.period))
        cores = worker_count(workers)
        options = dict(substeps=substeps, workers=0 if cores == 0 else max(1, cores // groups), **options)
        with ExitStack() as stack:
            self._pool = stack.enter_context(ThreadPoolExecutor(groups))
            own: list[Any] = [{"control": each, "params": gains.params} for each, gains in self.gains.items()]
            self._runners = [
                stack.enter_context(Runner(robot, self.per_group, **each, **options))
                for each in own or [{"control": osc}]
            ]
            self._resources = stack.pop_all()
        self.ground = self._runners[0].options.ground
        """True if the scenes have a ground at height 0."""
        self._info = robot.run_info(ground=self.ground, own_command=self.command)
        self.reset()

    def reset(self) -> None:
        """Put every robot back to its start pose, at rest, with a reset controller."""
        for runner in self._runners:
            runner.reset(self.start)
        self._last, self._rate = self.setpoint.copy(), None
        self._count = self._push_frames = 0
        self._frames.clear()
        self._observe(np.zeros((len(self.groups) * self.per_group, self.robot.dof)))

    def set_setpoint(self, position: ArrayLike, *, joint: int | None = None, env: int | None = None) -> None:
        """Set setpoints [rad or m]: of one joint or all, (dof,) or (envs, dof); of one env of each group or all."""
        self.setpoint[slice(None) if env is None else env, slice(None) if joint is None else joint] = position
        self.setpoint = self.robot.coupled(self.setpoint)

    def set_target(self, pose: ArrayLike, *, env: int | None = None) -> None:
        """Set the setpoint of one env, or all, under control "osc": position [m] and quaternion (w, x, y, z) (7,).

        Raises
        ------
        InvalidArgumentError
            There is no tool, the target is farther than :data:`MAX_DISTANCE`, or its quaternion has length 0.
        """
        if self.command is None:
            raise InvalidArgumentError("pose", "is for control 'osc'", remedy="use set_setpoint")
        target = array("pose", pose, (1, 7), self.command.names, kind="entry")[0]
        if np.abs(target[:3]).max() > MAX_DISTANCE:
            problem, remedy = "is out of reach", f"stay within {MAX_DISTANCE:g} m of the robot"
            raise InvalidArgumentError("pose", problem, value=target[:3].tolist(), remedy=remedy)
        if not 1e-3 < np.abs(target[3:]).max() < 1e3:
            raise InvalidArgumentError(
                "pose", "has no orientation", value=target[3:].tolist(), remedy="give a quaternion of length 1"
            )
        self.setpoint[slice(None) if env is None else env] = target

    def randomize_setpoints(self) -> None:
        """Draw a setpoint for each env, within the joint limits and 1 rad (or m) of the start pose."""
        drawn = self.robot.start + self._random.uniform(-1.0, 1.0, self.setpoint.shape)
        self.set_setpoint(np.clip(drawn, self.robot.lower, self.robot.upper))

    def push(self, force: ArrayLike) -> None:
        """Push the load link of every robot with a force (3,) [N] for :data:`PUSH_SECONDS`."""
        self._push, self._push_frames = np.array(force, np.float64), math.ceil(PUSH_SECONDS / self.period)

    @property
    def time(self) -> float:
        """Simulated time since the last reset [s]."""
        return self._count * self.period

    def frame(self) -> Rollout:
        """Return the present state, with the setpoints of the next frame, as a rollout of one tick."""
        return replace(self._frames[-1], setpoint=self._setpoints())

    def history(self) -> Rollout:
        """Return the frames of the last :data:`HISTORY_SECONDS`, the present one included."""
        return Rollout.join(list(self._frames))  # a copy: another thread may add a frame

    def info_of(self, robot: int) -> RunInfo:
        """Return the options of the run of one robot, numbered over all groups."""
        group, runner = robot // self.per_group, self._runners[robot // self.per_group]
        known = runner.options.values_for("recording") | {"control": self.groups[group]}
        gains = self.gains.get(self.groups[group])
        known |= {"params": gains and gains.params, "actuators": runner.options.actuators}
        return replace(self._info, **known)

    def effort_limits(self, robot: int, joint: int) -> tuple[float, float]:
        """Return the effort limits of a joint [N m or N]."""
        if not self.gains:
            return -float(self.robot.effort_limit[joint]), float(self.robot.effort_limit[joint])
        values = self.gains[self.groups[robot // self.per_group]].values
        return float(values["effort_min"][joint]), float(values["effort_max"][joint])

    def advance(self) -> None:
        """Run one frame of all groups concurrently."""
        disturbance = self._disturbance()
        self._rate, self._last = self._dragged(), self.setpoint.copy()
        list(self._pool.map(self._step, self.groups, self._runners, np.split(disturbance, len(self.groups))))
        self._count += 1
        self._push_frames = max(0, self._push_frames - 1)
        self._observe(disturbance)

    def close(self) -> None:
        """Close the runners."""
        self._resources.close()

    def _step(self, control: str, runner: Runner, disturbance: Float64) -> None:
        loaded = bool(disturbance.any())
        if (gains := self.gains.get(control)) is not None:
            params = gains.params_under(disturbance) if loaded and control == "pid" else gains.params
            if runner.params is not params:
                runner.params = params
        runner.step(self.setpoint, setpoint_rate=self._rate, feedforward=disturbance if loaded else None)

    def _dragged(self) -> Float64 | None:
        """Return the rates of setpoints that move slowly (envs, dof), as a slider that is dragged.

        Larger changes are steps, with a rate of 0. None if nothing moves so, and for poses.
        """
        if self.command is not None:
            return None
        rate = (self.setpoint - self._last) / self.period
        rate[np.abs(rate) > np.minimum(self.robot.velocity_limit, FASTEST)] = 0.0
        return rate if rate.any() else None

    def _disturbance(self) -> Float64:
        """Return the joint efforts (robots, dof) [N m or N] of payload and push."""
        frame = self._frames[-1]
        force = self.payload * np.array(GRAVITY) + self._push * (self._push_frames > 0)
        if not force.any():
            return np.zeros(frame.qpos.shape[1:])
        jacobian = ts.jacobian(self.robot.rigid_tree, frame.qpos[0], self.load_link)[:, :3]
        return np.where(frame.ok[0, :, None], (jacobian * force[..., :, None]).sum(-2), 0.0)

    def _observe(self, disturbance: Float64) -> None:
        """Append the present state to the frames; a robot that diverged keeps its last finite position."""
        parts = [runner.observe() for runner in self._runners]
        observation = Observation.join(parts)
        ok = observation.ok[:, None]
        last = self._frames[-1].qpos[0] if self._frames else np.tile(self.start, (len(self.groups), 1))
        observation = observation._replace(
            qpos=np.where(ok, observation.qpos, last).astype(np.float32),
            effort=np.where(ok, observation.effort - disturbance, 0.0).astype(np.float32),
        )
        row = observation.map(lambda array: array[None])
        self._frames.append(Rollout(np.array([self.time]), self._setpoints(), row, self.period, self._info))

    def _home(self) -> Float64:
        """Return the pose around which robots start under control "osc", where the tool can move in any direction."""
        return self.robot.start if self.robot.settings is None else self.robot.settings.target

    def _operational_space(self, tool: str | None) -> OperationalSpace | None:
        """Return the controller of control "osc", None for another control."""
        if "osc" not in self.groups:
            if tool is not None:
                raise InvalidArgumentError("tool", "is for control 'osc'", value=tool, remedy="leave it out")
            return None
        if len(self.groups) > 1:
            problem = "take different setpoints, joint positions and poses"
            raise InvalidArgumentError("controls", problem, value=self.groups, remedy="show 'osc' alone")
        tree = self.robot.rigid_tree
        link = tree.tool if tool is None else choice("tool", tool, tree.links)
        return OperationalSpace(self.robot, link, posture=self._home())

    def _setpoints(self) -> Float64:
        """Return the setpoints of all robots (1, robots, size) [rad or m]."""
        return np.tile(self.setpoint, (1, len(self.groups), 1))
