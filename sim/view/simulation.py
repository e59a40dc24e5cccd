"""Robots that run: one Runner for each way of control, driven by what the panel wishes."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.validate import choice, integer, number
from sim.loop.control import check_params
from sim.robot.kinematics import Kinematics
from sim.robot.robot import Robot
from sim.runner import Runner
from sim.view.data import Frame, History, Traces

Float64 = NDArray[np.float64]

CONTROLS = ("pid", "drive")
MOST = 64
"""Robots that a view shows at most."""
REMEMBERED = 8.0
"""How much of the past the charts show [s]."""
PUSH_TIME = 0.25
"""How long a push lasts [s]."""
GRAVITY = 9.81
# An option that comes and goes would change what the law remembers: the filter and the weight are never quite off.
_LEAST_FILTER = 1e-6  # [s]
_MOST_WEIGHT = 1 - 1e-9

GAINS = ("kp", "ki", "kd", "derivative_filter_time", "setpoint_weight", "effort_limit")
"""What can be changed while robots move, each (dof,)."""


class Live:
    """``num_envs`` robots for each of ``controls``, all after the same setpoints, side by side.

    Parameters
    ----------
    controls
        ``"pid"``, ``"drive"``, or both.
    period
        Simulated time of a frame [s], rounded to whole sim steps.
    spread
        How far from the robot's start pose each begins [rad or m].
    seed
        Of start poses and random setpoints.
    workers
        Processes in all; default one for each core.
    params
        Of the PID, one row, in whatever gain units; default the robot's designed gains, and the tutorial's to choose.
    options
        Of :class:`sim.Runner`: physics, compensate, timestep, ...
    """

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        *,
        controls: tuple[str, ...] = ("pid",),
        period: float = 1 / 30,
        spread: float = 0.2,
        seed: int = 0,
        workers: int | None = None,
        params: bp.PIDParams | None = None,
        **options: Any,
    ) -> None:
        self.robot = robot
        self.groups = tuple(choice("controls", control, CONTROLS) for control in controls)
        self.per_group = integer("num_envs", num_envs, 1, MOST // max(1, len(self.groups)))
        self.kinematics = Kinematics(robot)
        timestep = options.get("timestep", 1 / 2000)
        substeps = max(1, round(number("period", period, timestep, 1.0, "seconds of a frame") / timestep))
        self.period = substeps * timestep
        cores = len(os.sched_getaffinity(0)) if workers is None else workers
        share = 0 if cores == 0 else max(1, cores // len(self.groups))
        self._random = np.random.default_rng(seed)
        self._changed: dict[str, bool] = {}
        low, high = robot.lower, robot.upper
        offsets = self._random.uniform(-spread, spread, (self.per_group, robot.dof))
        self.start = np.clip(robot.start + offsets, low, high)
        self._low, self._high = np.maximum(low, -np.pi), np.minimum(high, np.pi)
        self._base = None if params is None else _one_row(params, robot)
        self._sets = {control: self._gain_sets(control) for control in self.groups}
        self.gains: dict[str, dict[str, Float64]] = {}
        for control in self.groups:
            self.take_gains(control, self.gain_sets(control)[0])
        self._changed = dict.fromkeys(self.groups, False)
        self.setpoint = np.tile(robot.start, (self.per_group, 1))
        self.payload = 0.0
        """Mass that hangs on the load link, as a weight without inertia [kg]."""
        self.load_link = self.kinematics.tool
        self._push: Float64 = np.zeros(3)
        self._push_left = 0.0
        self._loaded = False
        self._history = History(round(REMEMBERED / self.period))
        self._runners: list[Runner] = []
        try:
            for control in self.groups:
                self._runners.append(
                    Runner(
                        robot,
                        self.per_group,
                        params=self._params(control, None),
                        control=control,
                        substeps=substeps,
                        workers=share,
                        **options,
                    )
                )
        except BaseException:
            self.close()
            raise
        self._pool = ThreadPoolExecutor(len(self._runners)) if len(self._runners) > 1 else None
        self.reset()

    # -- what the panel wishes -------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Put every robot back to its start pose, at rest, with a fresh controller."""
        for runner in self._runners:
            runner.reset(self.start)
        self.time = 0.0
        self._push_left = 0.0
        self._history.clear()
        zero = np.zeros((len(self.groups) * self.per_group, self.robot.dof))
        self._frame = self._observe(zero)
        self._history.add(self._frame)

    def go(self, joint: int, position: float, env: int | None = None) -> None:
        """Set the setpoint of a joint [rad or m], of one env of every group or (None) of all."""
        self.setpoint[slice(None) if env is None else env, joint] = position

    def go_to(self, pose: Float64) -> None:
        """Set every setpoint: (dof,) or (envs, dof) [rad or m]."""
        self.setpoint = np.array(np.broadcast_to(pose, self.setpoint.shape), np.float64)

    def go_anywhere(self) -> None:
        """Draw a setpoint within the joint limits for each env: near enough to the start to stay off the ground."""
        near = self.robot.start + self._random.uniform(-1.0, 1.0, self.setpoint.shape)
        self.go_to(np.clip(near, self.robot.lower, self.robot.upper))

    def tune(self, control: str, gain: str, joint: int, value: float) -> None:
        """Change one of :data:`GAINS` of a joint, on every robot of a group."""
        self.gains[control][choice("gain", gain, GAINS)][joint] = value
        self._changed[control] = True

    def gain_sets(self, control: str) -> tuple[str, ...]:
        """Return the names of the sets that :meth:`take_gains` knows; the first is in force at the start."""
        return tuple(self._sets[control])

    @property
    def gain_units(self) -> str:
        """What the PID's gains are per: "effort", "inertia" or "mass_matrix"."""
        return "effort" if self._base is None else str(self._base.options().get("gain_units", "effort"))

    def take_gains(self, control: str, name: str) -> None:
        """Give every joint of a group the gains of a named set."""
        chosen = self._sets[control][choice("name", name, self._sets[control])]
        self.gains[control] = {gain: value.copy() for gain, value in chosen.items()}
        self._changed[control] = True

    def gain_range(self, control: str, gain: str, joint: int) -> tuple[float, float]:
        """Return a gain of a joint, and up to where it is worth changing."""
        value = float(self.gains[control][gain][joint])
        known = [float(gains[gain][joint]) for gains in self._sets[control].values()]
        if gain == "setpoint_weight":
            return value, 1.0
        if gain == "derivative_filter_time":
            return value, max(0.02, *known)
        if gain == "effort_limit":
            limit = float(self.robot.effort_limit[joint])
            return min(value, 1e3), min(limit, 1e3)
        return value, 4 * max(known) or float(self.gains[control]["kp"][joint]) or 1.0

    def push(self, force: tuple[float, float, float]) -> None:
        """Push every robot's load link with a force [N] for :data:`PUSH_TIME`."""
        self._push, self._push_left = np.array(force, np.float64), PUSH_TIME

    # -- frames ----------------------------------------------------------------------------------------------------

    def frame(self) -> Frame:
        """Return the present state, with the setpoints as they are wished for now."""
        return self._frame._replace(setpoint=np.tile(self.setpoint, (len(self.groups), 1)))

    def advance(self) -> None:
        """Run one frame of every group, all at once."""
        disturbance = self._disturbance()
        parts = np.split(disturbance, len(self.groups))
        jobs = list(zip(self.groups, self._runners, parts, strict=True))
        if self._pool is None:
            for job in jobs:
                self._step(*job)
        else:
            list(self._pool.map(lambda job: self._step(*job), jobs))
        self._loaded = bool(disturbance.any())
        self.time += self.period
        self._push_left = max(0.0, self._push_left - self.period)
        self._frame = self._observe(disturbance)
        self._history.add(self._frame)

    def traces(self, robot: int, joint: int) -> Traces:
        """Return the recent past of a joint."""
        return self._history.traces(robot, joint)

    def effort_limits(self, robot: int, joint: int) -> tuple[float, float]:
        """Return the limits of a joint's effort."""
        limit = float(self.gains[self.groups[robot // self.per_group]]["effort_limit"][joint])
        return -limit, limit

    def close(self) -> None:
        """End the runners."""
        for runner in self._runners:
            runner.close()

    # -- inside ----------------------------------------------------------------------------------------------------

    def _step(self, control: str, runner: Runner, disturbance: Float64) -> None:
        loaded = bool(disturbance.any())
        if self._changed[control] or (control == "pid" and (loaded or self._loaded)):
            runner.params = self._params(control, disturbance if loaded else None)
            self._changed[control] = False
        runner.step(self.setpoint, feedforward=disturbance if loaded else None)

    def _disturbance(self) -> Float64:
        """Return the joint efforts (robots, dof) of weight and push on the load link."""
        force = np.array([0.0, 0.0, -GRAVITY * self.payload])
        if self._push_left > 0:
            force = force + self._push
        if not force.any():
            return np.zeros(self._frame.qpos.shape)
        poses = self.kinematics.poses(self._frame.qpos)
        return np.where(self._frame.ok[:, None], self.kinematics.efforts_of_force(poses, self.load_link, force), 0.0)

    def _observe(self, disturbance: Float64) -> Frame:
        seen = [runner.observe() for runner in self._runners]
        qpos, effort, saturated, ok = (
            np.concatenate([getattr(obs, name) for obs in seen]) for name in ("qpos", "effort", "saturated", "ok")
        )
        if not ok.all():  # one that diverged stays where it was last seen
            before = self._frame.qpos if hasattr(self, "_frame") else np.tile(self.start, (len(self.groups), 1))
            qpos = np.where(ok[:, None], qpos, before).astype(np.float32)
        return Frame(
            time=self.time,
            qpos=qpos,
            setpoint=np.tile(self.setpoint, (len(self.groups), 1)),
            effort=np.where(ok[:, None], effort - disturbance, 0.0),
            saturated=np.asarray(saturated.any(1)),
            ok=ok,
        )

    def _gain_sets(self, control: str) -> dict[str, dict[str, Float64]]:
        """Return named gains: those designed from the robot's inertia, and the tutorial's for a robot that has them.

        Given ones stand alone: in other units no other set means the same.
        """
        robot, settings = self.robot, self.robot.settings
        if control == "pid" and self._base is not None:
            rows = self._base.options()
            rows["effort_limit"] = rows.get("effort_max", np.inf)
            unset = {"setpoint_weight": 1.0}
            return {
                "given": {
                    gain: np.broadcast_to(rows.get(gain, unset.get(gain, 0.0)), (1, robot.dof))[0].astype(float)
                    for gain in GAINS
                }
            }
        limit = np.full(robot.dof, np.inf) if control == "drive" else robot.effort_limit
        plain = {"ki": 0.0, "derivative_filter_time": 0.0, "setpoint_weight": 1.0, "effort_limit": limit}
        sets: dict[str, dict[str, Any]] = {}
        if control == "pid" and robot.fixed_base:
            designed = bp.design_gains(robot)
            sets["designed"] = plain | {gain: getattr(designed, gain) for gain in GAINS[:5]}
        if settings is not None:
            if control == "drive":
                sets["tutorial"] = plain | {"kp": settings.drive_stiffness, "kd": settings.drive_damping}
            else:
                sets["tutorial"] = plain | {"kp": settings.kp, "ki": settings.ki, "kd": settings.kd}
        if not sets:
            inertia = np.diagonal(robot.mass_matrix(robot.start)[0]) if robot.fixed_base else 1.0
            sets["first"] = plain | {"kp": 100 * inertia, "kd": 20 * inertia}  # 10 rad/s, critically damped
        shape = (robot.dof,)
        return {
            name: {
                gain: np.array(
                    np.broadcast_to(np.asarray(1.0 if value is None else value).squeeze(), shape), np.float64
                )
                for gain, value in gains.items()
            }
            for name, gains in sets.items()
        }

    def _params(self, control: str, disturbance: Float64 | None) -> bp.PIDParams:
        """Return the group's params.

        The disturbance enters as feedforward, and the limits are moved along with it: so the motor's own effort stays
        within them, and what it cannot hold it does not hold.
        """
        gains = self.gains[control]
        limit = gains["effort_limit"]
        shift = 0.0 if disturbance is None or control == "drive" else disturbance
        chosen: dict[str, Any] = {
            "kp": gains["kp"],
            "ki": gains["ki"],
            "kd": gains["kd"],
            "derivative_filter_time": np.maximum(gains["derivative_filter_time"], _LEAST_FILTER),
            "setpoint_weight": np.minimum(gains["setpoint_weight"], _MOST_WEIGHT),
            "effort_min": shift - limit,
            "effort_max": shift + limit,
        }
        if control == "pid" and self._base is not None:
            return self._base.replace(**chosen)
        return self.robot.params(**chosen, weight_origin="start")


def _one_row(params: bp.PIDParams, robot: Robot) -> bp.PIDParams:
    """Return ``params`` if the sliders can stand for them: one row, of the robot's joints."""
    params = check_params(params, robot, 1, "pid")
    if params.weight_origin is None and params.setpoint_weight is None:
        return params.replace(weight_origin="start")  # of no effect until the weight is moved
    return params
