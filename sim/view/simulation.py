"""Robots that run while they are shown: a Runner, steered from the page."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import choice, integer, number
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner.runner import Runner
from batchpid.sim.signals.quantities import Observation
from batchpid.sim.signals.rollout import Rollout, RunInfo
from batchpid.sim.view.playback import HISTORY_SECONDS
from batchpid.sim.view.scene import MAX_ROBOTS

GAINS = ("kp", "ki", "kd")
"""Gains that the page changes."""


class LiveSimulation:
    """``num_envs`` robots under the PID.

    Parameters
    ----------
    period
        Simulated time between frames [s], rounded to whole sim steps.
    spread
        Largest distance of a joint from the robot's start pose at the beginning [rad or m];
        ``seed`` determines it.
    options
        Of :class:`batchpid.sim.Runner`: params, workers, engine, physics, compensate, timestep, ...

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
        period: float = 1 / 30,
        spread: float = 0.2,
        seed: int = 0,
        **options: Any,
    ) -> None:
        self.robot = robot
        self.num_envs = integer("num_envs", num_envs, 1, MAX_ROBOTS)
        timestep = options.get("timestep", RunnerOptions.timestep)
        substeps = max(
            1, round(number("period", period, timestep, 1.0, "seconds between frames") / timestep)
        )
        self.period = substeps * timestep
        self._random = np.random.default_rng(seed)
        spread = number("spread", spread, 0.0, 10.0, "rad or m")
        offsets = self._random.uniform(-spread, spread, (num_envs, robot.dof))
        self.start = np.clip(robot.start + offsets, robot.lower, robot.upper)
        """Joint positions at the beginning (envs, dof) [rad or m]."""
        self.setpoint: Float64 = np.tile(robot.start, (num_envs, 1))
        """Setpoints (envs, dof) [rad or m]."""
        self._frames: deque[Rollout] = deque()
        self._runner = Runner(robot, num_envs, substeps=substeps, **options)
        self.ground = self._runner.options.ground
        """True if the scenes have a ground at height 0."""
        self._info = RunInfo.of(robot, ground=self.ground)
        self.reset()

    def reset(self) -> None:
        """Put every robot back to its start pose, at rest, with a reset controller."""
        first = self._frame(self._runner.reset(self.start), 0.0)
        # The page's thread reads the frames at any time: there is no moment without one.
        self._frames = deque([first], round(HISTORY_SECONDS / self.period))

    def set_setpoint(
        self, position: ArrayLike, *, joint: int | None = None, env: int | None = None
    ) -> None:
        """Set setpoints [rad or m]: of one joint or all, (dof,) or (envs, dof); of one env or
        all.
        """
        self.setpoint[
            slice(None) if env is None else env, slice(None) if joint is None else joint
        ] = position
        self.setpoint = self.robot.coupled(self.setpoint)

    def randomize_setpoints(self) -> None:
        """Draw a setpoint for each env, within the joint limits and 1 rad (or m) of the start
        pose.
        """
        drawn = self.robot.start + self._random.uniform(-1.0, 1.0, self.setpoint.shape)
        self.set_setpoint(np.clip(drawn, self.robot.lower, self.robot.upper))

    @property
    def params(self) -> bp.PIDParams:
        """Gains in force; assign others to change them in flight."""
        return self._runner.params

    @params.setter
    def params(self, params: bp.PIDParams) -> None:
        self._runner.params = params

    def set_gain(self, gain: str, joint: int, value: float) -> None:
        """Set one of :data:`GAINS` of a joint, on every robot."""
        gains = np.array(getattr(self.params, choice("gain", gain, GAINS)))
        gains[:, joint] = value
        self.params = self.params.replace(**{gain: gains})

    def frame(self) -> Rollout:
        """Return the present state, with the setpoints of the next frame, as a rollout of one
        tick.
        """
        return replace(self._frames[-1], setpoint=self.setpoint[None].copy())

    def history(self) -> Rollout:
        """Return the frames of the last :data:`HISTORY_SECONDS`, the present one included."""
        return Rollout.join(list(self._frames))

    def advance(self) -> None:
        """Run one frame."""
        time = float(self._frames[-1].time[0])
        self._frames.append(self._frame(self._runner.step(self.setpoint), time + self.period))

    def close(self) -> None:
        """Close the runner."""
        self._runner.close()

    def _frame(self, observation: Observation, time: float) -> Rollout:
        row = observation.map(lambda array: array[None])
        return Rollout(np.array([time]), self.setpoint[None].copy(), row, self.period, self._info)
