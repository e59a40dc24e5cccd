"""Data of a page: robots that run while they are shown, or a recorded run."""

from __future__ import annotations

from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Float64, Rows
from batchpid.checks import integer, number
from batchpid.errors import InvalidArgumentError
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.robot.robot import Robot
from batchpid.sim.rollout import Rollout
from batchpid.sim.runner.runner import Runner
from batchpid.sim.signals import Observation
from batchpid.sim.view.scene import MAX_ROBOTS

FRAME = 1 / 30
"""Time from frame to frame [s]."""


class LiveSimulation:
    """``num_envs`` robots under the PID, on their way to the robot's target, or to the setpoints of
    the page.

    Parameters
    ----------
    period
        Simulated time between frames [s], rounded to whole sim steps.
    spread
        Largest distance of a joint from the robot's start pose at the beginning [rad or m].
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
        period: float = FRAME,
        spread: float = 0.2,
        **options: Any,
    ) -> None:
        self.robot = robot
        self.num_envs = integer("num_envs", num_envs, 1, MAX_ROBOTS)
        timestep = options.get("timestep", RunnerOptions.timestep)
        period = number("period", period, timestep, 1.0, "seconds between frames")
        substeps = round(period / timestep)
        self.period = substeps * timestep
        offsets = np.random.default_rng(0).uniform(-spread, spread, (num_envs, robot.dof))
        self.start = np.clip(robot.start + offsets, robot.lower, robot.upper)
        """Joint positions at the beginning (envs, dof) [rad or m]."""
        self.setpoint: Float64 = np.tile(robot.target, (num_envs, 1))
        """Setpoints (envs, dof) [rad or m]."""
        self._runner = Runner(robot, num_envs, substeps=substeps, **options)
        self.ground = self._runner.options.ground
        """True if the scenes have a ground at height 0."""
        self.reset()

    def set_setpoint(self, position: ArrayLike, *, joint: int | None = None) -> None:
        """Set setpoints [rad or m] of every robot: of one joint, or of all, (dof,) or (envs,
        dof).
        """
        joints = slice(None) if joint is None else joint
        self.setpoint[:, joints] = position
        self.setpoint = self.robot.coupling.positions(self.setpoint)

    def reset(self) -> None:
        """Put every robot back to its start pose, at rest, with a reset controller."""
        self.observation = self._runner.reset(self.start)
        """Present state."""
        self.time = 0.0
        """Time since the beginning [s]."""

    def advance(self) -> None:
        """Run one frame."""
        self.observation = self._runner.step(self.setpoint)
        self.time += self.period

    def close(self) -> None:
        """Close the runner."""
        self._runner.close()


class Playback:
    """Recorded run, from the first row to the last and then again.

    ``robot`` is by default :func:`recorded_robot`. Frames are :data:`FRAME` apart, or a tick of
    the run.

    Raises
    ------
    InvalidArgumentError
        The run has no tick, more robots than fit on a page, or another number of joints than the
        robot; or the recording holds no robot.
    """

    def __init__(self, rollout: Rollout, robot: Robot | None = None) -> None:
        rollout.check_ticks()
        robot = recorded_robot(rollout) if robot is None else robot
        joints = rollout.qpos.shape[2]
        if joints != robot.dof:
            problem = f"has {joints} joints, robot {robot.name!r} has {robot.dof}"
            remedy = "give the robot that was recorded"
            raise InvalidArgumentError("rollout", problem, remedy=remedy)
        self.robot = robot
        self.num_envs = integer("num_envs", rollout.num_envs, 1, MAX_ROBOTS)
        self.ground = bool(rollout.info.ground)
        """True if the run had a ground at height 0."""
        self._rollout = rollout
        self.duration = float(rollout.time[-1] - rollout.time[0])
        """Time from the first row to the last [s]."""
        self.period = max(FRAME, rollout.tick)
        self.time = 0.0
        """Time since the first row [s]."""

    def reset(self) -> None:
        """Go to the first row."""
        self.time = 0.0

    def advance(self) -> None:
        """Go to the next frame; after the last to the first."""
        ended = self.time >= self.duration
        self.time = 0.0 if ended else min(self.time + self.period, self.duration)

    @property
    def observation(self) -> Observation:
        """State recorded at the present time."""
        return self._rollout.observation.map(itemgetter(self._row))

    @property
    def setpoint(self) -> Rows:
        """Setpoints (envs, dof) [rad or m] at the present time; the positions, if the run had
        others.
        """
        positions: Rows = self._rollout.qpos
        if self._rollout.info.sets_positions:
            positions = self._rollout.setpoint
        shown: Rows = positions[self._row]
        return shown

    @property
    def _row(self) -> int:
        return int(rows_at(self._rollout, np.array(self.time)))

    def close(self) -> None:
        """Do nothing: a playback holds no resources."""


ViewData = LiveSimulation | Playback


def recorded_robot(rollout: Rollout) -> Robot:
    """Return the robot of a run in this process, or the one in the recording; its meshes are read
    from their files, and left out where these are gone.

    Raises InvalidArgumentError if the recording has none.
    """
    info = rollout.info
    if isinstance(info.description, Robot):
        return info.description
    if info.urdf is None:
        problem = f"of the recording, {info.robot!r}, is unknown: a URDF cannot hold it"
        remedy = "name its URDF or MJCF file"
        raise InvalidArgumentError("robot", problem, remedy=remedy)
    with TemporaryDirectory(prefix="batchpid-") as folder:
        path = Path(folder, "robot.urdf")
        path.write_text(info.urdf, encoding="utf-8")
        return Robot.load(path, fixed_base=info.fixed_base)


def rows_at(rollout: Rollout, seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the rows of ``rollout`` that are shown at times [s] since its first row."""
    elapsed = rollout.time - rollout.time[0]
    return np.searchsorted(elapsed, seconds - 1e-9).clip(0, len(elapsed) - 1)
