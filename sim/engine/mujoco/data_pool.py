"""Working memory of packs in MuJoCo, which the packs of a loop use in turn.

A ``mujoco.MjData`` takes half a megabyte, of which a hundred numbers are the state of a robot. So
the packs of a loop, which runs them one after another, share as many as the largest of them needs.
A pack that is not at work keeps the rows of its states; back at work it computes the rest by
``mj_step1``, with the same result to the last bit.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from batchpid.arrays.array_types import Float64, MjData, MjModel
from batchpid.sim.engine.mujoco.free_motion import FreeMotions
from batchpid.sim.engine.mujoco.model_builder import RobotMj
from batchpid.sim.engine.native.interface import FARTHEST

STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
"""Parts of the state: all of the inputs of a sim step."""
POSITIONS = 1
"""Place of the positions in the state, after the time."""


def rest(model: MjModel, data: MjData) -> None:
    """Reset the data of a robot: to the start of its file, or with its joints at 0."""
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    else:
        mujoco.mj_resetData(model, data)


class DataPool:
    """``mujoco.MjData`` of ``robot`` for one pack at a time, and the model of robots without
    variation.

    The model is a copy, since native code disables and enables its contacts within a sim step.
    """

    def __init__(self, robot: RobotMj) -> None:
        self.robot = robot
        self.model = copy.copy(robot.model)
        self._data = list[MjData]()
        self._taken = list[MjData]()
        self._owner: object = None
        self._initial = np.empty(mujoco.mj_stateSize(robot.model, STATE))
        (data,) = self._new(1)
        rest(robot.model, data)
        mujoco.mj_getState(robot.model, data, self._initial, STATE)

    def initial(self, size: int) -> Float64:
        """Return the rows of ``size`` robots at rest."""
        return np.tile(self._initial, (size, 1))

    def take(
        self, models: list[MjModel], rows: Float64, placed: Sequence[int] = ()
    ) -> list[MjData]:
        """Return the data of the robots with these ``models``, in the states ``rows``. The states
        of the previous pack are first saved to its rows. The robots ``placed`` get another state
        next, and are not updated here.
        """
        if self._owner is not rows:
            if isinstance(self._owner, np.ndarray):
                for data, row in zip(self._taken, self._owner, strict=True):
                    mujoco.mj_getState(self.model, data, row, STATE)
            self._owner = rows
            self._taken = self._new(len(rows))
            # MuJoCo warns of states that are not finite, and the loop finds them by itself.
            qpos = rows[:, POSITIONS : POSITIONS + self.model.nq]
            is_near = np.all(np.abs(qpos) <= FARTHEST, axis=1)
            is_near[list(placed)] = False
            for model, data, row, near in zip(models, self._taken, rows, is_near, strict=True):
                mujoco.mj_setState(model, data, row, STATE)
                if near:
                    mujoco.mj_step1(model, data)
        return self._taken

    def lend(self, robots: FreeMotions) -> list[MjData]:
        """Return data of ``robots``, which hold their states themselves."""
        if self._owner is not robots:
            self._owner = robots
            self._taken = self._new(robots.size)
            robots.forget_contacts()
        return self._taken

    def leave(self, owner: object) -> None:
        """Forget the states of the rows or robots ``owner``."""
        if self._owner is owner:
            self._owner = None

    def _new(self, size: int) -> list[MjData]:
        self._data += [mujoco.MjData(self.robot.model) for _ in range(size - len(self._data))]
        return self._data[:size]
