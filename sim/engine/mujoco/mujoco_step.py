"""Sim step of robots in MuJoCo as one native call, of the same kind as SAPIEN's.

Robots are stepped by MuJoCo's public functions ``mj_step2`` (from velocities to the next state) and
``mj_step1`` (all that follows from that state alone, so also gravity and Coriolis forces).
Collision detection takes half of a sim step of a robot with meshes, and usually finds no contact:
native code proves, from tables of the shapes, that they do not touch (``clearance.h``).

A ``mujoco.MjData`` takes half a megabyte, of which a hundred numbers are the state of a robot. So
the packs of a loop, which runs them one after another, share as many as the largest of them needs.
A pack that is not at work keeps the rows of its states; back at work it computes the rest by
``mj_step1``, with the same result to the last bit.
"""

from __future__ import annotations

import copy
import ctypes
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from batchpid.arrays.array_types import Bool, Float64, MjData, MjModel, Rows
from batchpid.sim.engine import native
from batchpid.sim.engine.mujoco.free_motion import (
    FreeMotions,
    GroupClearance,
    place_of_contacts,
    shape_tables,
)
from batchpid.sim.engine.mujoco.model_builder import RobotMj
from batchpid.sim.engine.native import FARTHEST, structure
from batchpid.sim.engine.native_model import NativeStep

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


FUNCTIONS = {
    "step1": "mj_step1",
    "step2": "mj_step2",
    "set_log_handler": "mju_setLogHandler",
    "kinematics": "mj_kinematics",
}
"""Functions of MuJoCo's library, by field of Mujoco in mujoco_step.h, or Clearance in clearance.h."""
CLOCK = "mjcb_time"
"""Variable of the library that holds its clock."""
ROW_FIELDS = (
    ("qpos", "qpos"),
    ("qvel", "qvel"),
    ("applied", "qfrc_applied"),
    ("bias", "qfrc_bias"),
    ("warm", "qacc_warmstart"),
    ("ctrl", "ctrl"),
    ("sensors", "sensordata"),
)
"""Fields of Mujoco in mujoco_step.h, and the arrays of ``mujoco.MjData`` that they point to."""


def mujoco_library() -> Path:
    """Return the path of MuJoCo's shared library; ValueError without exactly one."""
    (path,) = Path(mujoco.__file__).parent.glob("libmujoco.so*")
    return path


def obstacle() -> str:
    """Return why native code cannot call MuJoCo; "" if it can."""
    if (reason := native.obstacle()) or functions() is not None:
        return reason
    return f"MuJoCo {mujoco.__version__} lacks functions for native calls"


@cache
def functions() -> dict[str, int] | None:
    """Return the addresses of functions and clock by field; None if this version of MuJoCo lacks
    one of them.
    """
    try:
        library = ctypes.CDLL(str(mujoco_library()))
        addresses = {
            field: ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0
            for field, name in FUNCTIONS.items()
        }
        addresses["clock"] = ctypes.addressof(ctypes.c_void_p.in_dll(library, CLOCK))
        # Attributes of the Python package that are not documented: a version may lack them.
        data = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
        _ = data._address, data.model._address
    except (ValueError, OSError, AttributeError):
        return None
    return addresses


class MujocoStep(NativeStep):
    """Sim step of robots in MuJoCo.

    Parameters
    ----------
    pool, models, rows
        Working memory, and model and row of the state of each robot.
    reads_force
        Whether to read the forces of gravity and Coriolis; otherwise they are zero.
    arrays
        Arrays of the pack (robots, ...) for native code: efforts last applied, sums of the sensors,
        and stiffness and rate gain of the drives, if their targets move within a tick.
    skip
        Robots that are not stepped (robots,).
    constraint
        Address of the constraint of coupled joints, or None.
    free
        States of robots that step without MuJoCo where they touch nothing, in place of ``rows``;
        or None.
    """

    def __init__(
        self,
        pool: DataPool,
        models: list[MjModel],
        rows: Float64,
        reads_force: bool,
        arrays: dict[str, Rows],
        skip: Bool,
        constraint: int | None,
        free: FreeMotions | None,
    ) -> None:
        data = pool.take(models, rows) if free is None else pool.lend(free)
        robot = pool.robot
        dof = len(robot.qpos)
        addresses = dict(functions() or {})
        kinematics = addresses.pop("kinematics")
        tables = {
            name: [getattr(row, field).ctypes.data for row in data] for name, field in ROW_FIELDS
        }
        tables["models"] = [model._address for model in models]
        tables["data"] = [row._address for row in data]
        tables["contacts"] = [row._address + (place_of_contacts() or 0) for row in data]
        arrays = arrays | {name: np.array(rows, np.uint64) for name, rows in tables.items()}
        arrays |= {"qpos_at": robot.qpos.astype(np.int64), "qvel_at": robot.qvel.astype(np.int64)}
        robots = structure("Mujoco")(
            **addresses, **{name: array.ctypes.data for name, array in arrays.items()}
        )
        robots.sensor_size = arrays["sensed"].shape[1]
        robots.base_qpos, robots.base_qvel = robot.base
        if free is not None:
            robots.free = free.address
        clearance = None
        shapes = shape_tables(robot)
        if shapes is not None:
            clearance = GroupClearance(shapes, kinematics, models, data, dof)
            robots.clearance = clearance.address
        self._pool = pool
        self._states = [*models], rows
        self._free = free
        self._kept = data, arrays, robots, clearance
        super().__init__(
            len(data),
            dof,
            {"skip": skip},
            mujoco=ctypes.addressof(robots),
            gravity=reads_force,
            coriolis=reads_force,
            constraint=constraint,
        )

    def prepare(self) -> int:
        """Return the address of the group, for a call of the extension; the robots are in
        their states.
        """
        if self._free is None:
            self._pool.take(*self._states)
        else:
            self._pool.lend(self._free)
        return super().prepare()
