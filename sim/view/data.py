"""What a view shows: frames of some robots, whether they come from a running Runner or from a recording."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sim.robot.robot import Robot


class Frame(NamedTuple):
    """State of every robot at one time. (robots, dof), in rad or m and N m or N; ``ok`` and ``saturated`` (robots,)."""

    time: float
    qpos: NDArray[np.float32]
    setpoint: NDArray[np.float64]
    effort: NDArray[np.float64]
    saturated: NDArray[np.bool_]
    ok: NDArray[np.bool_]


class Traces(NamedTuple):
    """The recent past of one joint of one robot: (samples,) each."""

    time: NDArray[np.float64]
    qpos: NDArray[np.float64]
    setpoint: NDArray[np.float64]
    effort: NDArray[np.float64]


class Source(Protocol):
    """Where frames come from. Robots are numbered group by group, ``per_group`` in each."""

    robot: Robot
    groups: tuple[str, ...]
    per_group: int
    period: float
    """Simulated time from frame to frame [s]."""

    def frame(self) -> Frame:
        """Return the present state."""

    def advance(self) -> None:
        """Go on by one frame."""

    def reset(self) -> None:
        """Begin again."""

    def traces(self, robot: int, joint: int) -> Traces:
        """Return the recent past of a joint."""

    def effort_limits(self, robot: int, joint: int) -> tuple[float, float]:
        """Return the limits of a joint's effort, infinite where there are none."""

    def close(self) -> None:
        """Free what the source holds."""


class History:
    """The last frames, kept for the charts."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._frames: list[Frame] = []

    def add(self, frame: Frame) -> None:
        """Keep one more."""
        self._frames.append(frame)
        del self._frames[: -self._length]

    def clear(self) -> None:
        """Forget all."""
        self._frames = []

    def traces(self, robot: int, joint: int) -> Traces:
        """Return one joint's past."""
        rows = [
            (frame.time, frame.qpos[robot, joint], frame.setpoint[robot, joint], frame.effort[robot, joint])
            for frame in self._frames
        ]
        return Traces(*np.array(rows, np.float64).reshape(-1, 4).T)
