"""Playback of a recorded run."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.digest import digest
from batchpid.checks.validate import integer
from batchpid.errors import InvalidArgumentError
from batchpid.sim.robot.robot import Robot
from batchpid.sim.signals.rollout import Rollout
from batchpid.sim.view.scene import MAX_ROBOTS

HISTORY_SECONDS = 8.0
"""Longest past that the charts show [s]."""


class Playback:
    """Recorded run as the data of a page, from the first row to the last and then again.

    ``robot`` is by default :func:`recorded_robot`. Frames are ``period`` [s] apart, or a tick of
    the run.

    Raises
    ------
    InvalidArgumentError
        The run has more robots than fit on a page, or another number of joints than the robot; or
        the recording holds no robot.
    """

    def __init__(
        self, rollout: Rollout, robot: Robot | None = None, *, period: float = 1 / 30
    ) -> None:
        robot = recorded_robot(rollout) if robot is None else robot
        joints = rollout.qpos.shape[2]
        if joints != robot.dof:
            raise InvalidArgumentError(
                "rollout",
                f"has {joints} joints, robot {robot.name!r} has {robot.dof}",
                remedy="give the robot that was recorded",
            )
        self.robot = robot
        self.num_envs = integer("num_envs", rollout.num_envs, 1, MAX_ROBOTS)
        if rollout.info.ground is None:
            self.ground = robot.has_ground
        else:
            self.ground = rollout.info.ground
        """True if the run had a ground at height 0."""
        self._rollout = replace(rollout, time=rollout.time - rollout.time[0])
        self.duration = float(self._rollout.time[-1])
        """Time from the first row to the last [s]."""
        self.period = max(period, rollout.tick)
        self._now = 0.0

    def frame(self) -> Rollout:
        """Return the state recorded at the present time, as a rollout of one tick."""
        return self._since(self._now)

    def history(self) -> Rollout:
        """Return the rows up to the present one, of the last :data:`HISTORY_SECONDS`."""
        return self._since(self._now - HISTORY_SECONDS)

    def advance(self) -> None:
        """Go to the next frame; after the last to the first."""
        if self._now >= self.duration:
            self._now = 0.0
        else:
            self._now = min(self._now + self.period, self.duration)

    def seek(self, time: float) -> None:
        """Go to a time [s] since the first row."""
        self._now = min(max(0.0, time), self.duration)

    def reset(self) -> None:
        """Go to the first row."""
        self._now = 0.0

    def close(self) -> None:
        """Do nothing: a playback holds no resources."""

    def _since(self, start: float) -> Rollout:
        """Return the rows from a time [s] to the present one."""
        first, last = rows_at(self._rollout, np.array([start, self._now])).tolist()
        return self._rollout.for_ticks(slice(first, last + 1))


def recorded_robot(rollout: Rollout) -> Robot:
    """Return the robot of a run in this process, or the bundled one that was recorded, or the one
    in the recording; its meshes are read from their files, and left out where these are gone.

    Raises InvalidArgumentError if the recording has none.
    """
    info = rollout.info
    if isinstance(info.description, Robot):
        return info.description
    if info.robot in Robot.bundled():
        bundled = Robot.load(info.robot, fixed_base=info.fixed_base)
        if info.digest in (None, bundled.digest):
            return bundled
    if info.urdf is None:
        raise InvalidArgumentError(
            "robot",
            f"{info.robot!r} is not bundled, and the recording holds no description of it",
            remedy="name its URDF or MJCF file",
        )
    path = Path(_folder().name, f"{digest(info.urdf)[:32]}.urdf")
    path.write_text(info.urdf, encoding="utf-8")
    return Robot.load(path, fixed_base=info.fixed_base)


@cache
def _folder() -> TemporaryDirectory[str]:
    """Return the folder of recorded robots, whose files are read again when they are drawn; it is
    removed at the end of the process.
    """
    return TemporaryDirectory(prefix="batchpid-")


def rows_at(rollout: Rollout, seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the rows of ``rollout`` that are shown at times [s] since its first row."""
    elapsed = rollout.time - rollout.time[0]
    return np.searchsorted(elapsed, seconds - 1e-9).clip(0, len(elapsed) - 1)
