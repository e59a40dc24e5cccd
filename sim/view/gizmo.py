"""Frame at the target of the watched robot's tool, which the pointer drags."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.sim.view.simulation import LiveSimulation

_SIZE = 0.25
"""Length of an axis, in reaches of the robot."""


class TargetGizmo:
    """Draggable frame of a viser ``server`` at the setpoint of control "osc".

    Parameters
    ----------
    positions
        Positions of the robots on the page (envs, 3) [m].
    reach
        Reach of the robot [m].
    put
        Function that queues a request until the next frame.
    only_watched
        Function that returns whether a drag moves the target of the watched robot alone.
    """

    def __init__(
        self,
        server: Any,
        live: LiveSimulation,
        positions: NDArray[np.float64],
        reach: float,
        put: Callable[[Callable[[], object]], None],
        only_watched: Callable[[], bool],
    ) -> None:
        self._live, self._positions, self._put, self._only_watched = live, positions, put, only_watched
        self._env = 0
        self._shown: bytes | None = None
        self._frame = server.scene.add_transform_controls("/target", scale=_SIZE * reach, depth_test=False)
        self._frame.on_update(self._dragged)
        self.update(0)

    def update(self, env: int) -> None:
        """Put the frame at the target of a robot, unless it is there."""
        target = self._live.setpoint[env]
        if (env, target.tobytes()) != (self._env, self._shown):
            self._env, self._shown = env, target.tobytes()
            self._frame.position = tuple(self._positions[env] + target[:3])
            self._frame.wxyz = tuple(target[3:] / np.linalg.norm(target[3:]))

    async def _dragged(self, event: Any) -> None:
        if event.phase == "update":
            pose = np.concatenate([self._frame.position, self._frame.wxyz], dtype=np.float64)
            self._put(partial(self._move, self._env, pose))

    def _move(self, env: int, pose: NDArray[np.float64]) -> None:
        """Set the target to a pose on the page, between two frames; a refused one brings the frame back."""
        self._shown = None
        target = pose - np.concatenate([self._positions[env], np.zeros(4)])
        self._live.set_target(target, env=env if self._only_watched() else None)
        if env == self._env:  # the frame is where the pointer has it
            self._shown = self._live.setpoint[env].tobytes()
