"""A rollout that has been: played in the same page as a running one."""

from __future__ import annotations

import numpy as np

from batchpid.errors import InvalidArgumentError
from sim.observation import Rollout
from sim.robot.robot import Robot
from sim.view.data import Frame, Traces


class Playback:
    """``rollout`` of ``robot``, from its first row to its last and then again."""

    def __init__(self, robot: Robot, rollout: Rollout, label: str = "recorded", period: float = 1 / 30) -> None:
        if rollout.qpos.shape[2] != robot.dof:
            raise InvalidArgumentError(
                "rollout",
                f"has {rollout.qpos.shape[2]} joints, robot {robot.name!r} has {robot.dof}",
                remedy="give the robot that was recorded",
            )
        self.robot, self.per_group = robot, rollout.qpos.shape[1]
        self.groups: tuple[str, ...] = (label,)
        self._rollout = rollout
        self._time = rollout.time - rollout.time[0]
        self.duration = float(self._time[-1])
        tick = self.duration / max(1, len(self._time) - 1)
        self.period = max(period, tick) if self.duration else period
        self._now = 0.0

    def frame(self) -> Frame:
        """Return the recorded state nearest to the present time."""
        k = self._row()
        rollout, ok = self._rollout, self._rollout.ok[k]
        last = np.nan_to_num(rollout.qpos[k]) if not ok.all() else rollout.qpos[k]
        return Frame(
            time=float(self._time[k]),
            qpos=last,
            setpoint=rollout.setpoint[k],
            effort=rollout.effort[k].astype(np.float64),
            saturated=rollout.saturated[k].any(1),
            ok=ok,
        )

    def advance(self) -> None:
        """Go on by a frame; after the last begin again."""
        self._now = 0.0 if self._now >= self.duration else min(self._now + self.period, self.duration)

    def seek(self, time: float) -> None:
        """Go to a time [s] since the first row."""
        self._now = min(max(0.0, time), self.duration)

    def reset(self) -> None:
        """Go back to the beginning."""
        self._now = 0.0

    def traces(self, robot: int, joint: int) -> Traces:
        """Return a joint's past up to now."""
        rows = slice(0, self._row() + 1)
        rollout = self._rollout
        return Traces(
            self._time[rows],
            rollout.qpos[rows, robot, joint].astype(np.float64),
            rollout.setpoint[rows, robot, joint],
            rollout.effort[rows, robot, joint].astype(np.float64),
        )

    def effort_limits(self, robot: int, joint: int) -> tuple[float, float]:
        """Return the limits that the URDF gives."""
        limit = float(self.robot.effort_limit[joint])
        return -limit, limit

    def close(self) -> None:
        """Nothing is held."""

    def _row(self) -> int:
        return int(np.searchsorted(self._time, self._now - 1e-9).clip(0, len(self._time) - 1))
