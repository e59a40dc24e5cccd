"""States of robots on fixed bases, and what native code needs to step them without MuJoCo where
they touch nothing (``free_motion.h``).

Native code steps a robot if and only if its state has no contact, so the bits of a motion depend on
nothing else. The arrays of a pack hold the state of every robot, and ``mujoco.MjData`` is working memory.
Native code steps vectors of robots, so a table has the shape (blocks, columns, WIDTH).
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache

import mujoco
import numpy as np

from batchpid.arrays.array_types import Float64, MjData, MjModel, Rows
from batchpid.sim.engine.mujoco.clearance import touching_pairs
from batchpid.sim.engine.mujoco.model_builder import RobotMj
from batchpid.sim.engine.native.interface import FARTHEST, WIDTH, number, structure
from batchpid.sim.engine.native_model import NativeModel, aligned, table

_COUNT = 37
"""Number of contacts by which its place in ``mjData`` is found: no other number there is equal."""


@cache
def place_of_contacts() -> int | None:
    """Return the offset of the number of contacts in ``mjData`` [bytes], found by its value; None
    if it is ambiguous.
    """
    planes = _COUNT * '<geom type="plane" size="0 0 1"/>'
    ball = '<body pos="0 0 0.05"><freejoint/><geom size="0.1"/></body>'
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{planes}{ball}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    # The number lies between these two arrays of the structure.
    start = data.solver_fwdinv.ctypes.data
    size = data.energy.ctypes.data - start
    places = np.flatnonzero(np.frombuffer(ctypes.string_at(start, size), np.int32) == _COUNT)
    return start - data._address + 4 * int(places[0]) if len(places) == 1 else None


class FreeMotions:
    """States of ``size`` robots of ``robot``, whose rigid bodies are those of ``model``.

    Attributes
    ----------
    contact
        What is known about the contacts of each robot (M,), by number of Contact in free_motion.h.
    time
        Time of each robot (M,) [s].
    ctrl
        Inputs of the drives (M, dof); not used without drives.
    """

    def __init__(self, robot: RobotMj, size: int, model: NativeModel) -> None:
        dof = len(robot.joints)
        scene = robot.model
        self.size = size
        self._robot, self._rigid = robot, model
        at = robot.qvel
        joints = scene.dof_jntid[at]
        blocks = -(-size // WIDTH)
        limited = scene.jnt_limited[joints] != 0
        ends = np.where(limited, scene.jnt_range[joints].T, [[-np.inf], [np.inf]])
        self.contact = np.full(size, number("Contact", "UNKNOWN"), np.int8)
        self.time = np.zeros(size)
        self.ctrl = np.zeros((size, dof))
        self._states = [aligned(blocks, dof, WIDTH) for _ in range(3)]
        self._arrays = {
            "bias": aligned(blocks, dof, WIDTH),
            "mass": aligned(blocks, dof * (dof + 1) // 2, WIDTH),
            "low": ends[0].copy(),
            "high": ends[1].copy(),
            "contact": self.contact,
            "time": self.time,
            **dict(zip(("qpos", "qvel", "acceleration"), self._states, strict=True)),
        }
        least, most, width, *_ = scene.jnt_solimp[joints[0]]
        time, ratio = scene.jnt_solref[joints[0]]
        self._structure = structure("FreeMotion")(
            # The reference acceleration of a limit: "Computation" in MuJoCo's documentation.
            stiffness=1 / (most * time * ratio) ** 2,
            rate_gain=2 / (most * time),
            least=least,
            most=most,
            width=width,
            timestep=scene.opt.timestep,
            has_pairs=len(touching_pairs(scene)) > 0,
            robots=size,
        )

    def use(self, models: Sequence[MjModel]) -> None:
        """Take the constants of the robots' models (M,), which may have changed."""
        at = self._robot.qvel
        kinds = models[:1] if all(model is models[0] for model in models) else models
        columns = {
            "armature": [model.dof_armature[at] for model in kinds],
            "weight": [model.dof_invweight0[at] for model in kinds],
            "gravity": [model.opt.gravity for model in kinds],
        }
        if self._robot.model.nu:
            self._arrays["ctrl"] = self.ctrl
            columns |= {
                "position_gain": [model.actuator_biasprm[:, 1] for model in kinds],
                "drive_rate_gain": [model.actuator_biasprm[:, 2] for model in kinds],
                "drive_limit": [model.actuator_forcerange[:, 1] for model in kinds],
            }
        self._arrays |= {name: table(np.array(rows), self.size) for name, rows in columns.items()}
        # In place, since native code has the address.
        self._structure.model = self._rigid.address
        for name, array in self._arrays.items():
            setattr(self._structure, name, array.ctypes.data)
        self.contact[...] = number("Contact", "UNKNOWN")

    @property
    def address(self) -> int:
        """Address of the structure, for native code."""
        return ctypes.addressof(self._structure)

    def forget_contacts(self) -> None:
        """Look for the contacts of robots in contact anew: their ``mujoco.MjData`` have changed."""
        is_touching = self.contact == number("Contact", "SOME")
        self.contact[is_touching] = number("Contact", "UNKNOWN")

    def read(self) -> tuple[Float64, Float64, Float64]:
        """Return positions, velocities and last accelerations (M, dof)."""
        qpos, qvel, acceleration = (
            np.array(array.swapaxes(1, 2).reshape(-1, array.shape[1])[: self.size])
            for array in self._states
        )
        return qpos, qvel, acceleration

    def write(self, rows: Sequence[int] | slice, *states: Rows | float) -> None:
        """Set positions, velocities and last accelerations (len(rows), dof) of robots ``rows``."""
        numbers = np.arange(self.size)[rows]
        for array, values in zip(self._states, states, strict=True):
            array[numbers // WIDTH, :, numbers % WIDTH] = values
        self.contact[numbers] = number("Contact", "UNKNOWN")

    def load(self, row: int, data: MjData) -> None:
        """Take the state of a robot from its data."""
        qpos, qvel = data.qpos[self._robot.qpos], data.qvel[self._robot.qvel]
        self.write([row], qpos, qvel, data.qacc_warmstart[self._robot.qvel])
        self.time[row] = data.time

    def show(self, row: int, model: MjModel, data: MjData) -> None:
        """Bring the data of a robot up to date."""
        at = row // WIDTH, slice(None), row % WIDTH
        data.qpos[self._robot.qpos], data.qvel[self._robot.qvel] = (
            array[at] for array in self._states[:2]
        )
        data.qacc_warmstart[self._robot.qvel] = self._states[2][at]
        data.time = self.time[row]
        data.ctrl[:] = self.ctrl[row, : len(data.ctrl)]
        if (np.abs(data.qpos) <= FARTHEST).all():
            mujoco.mj_step1(model, data)
