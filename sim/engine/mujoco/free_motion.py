"""States of robots on fixed bases, and what native code needs to step them without MuJoCo where
they touch nothing (``free_motion.h``): tables for native proofs that their shapes do not touch
(``clearance.h``), of models built from URDFs.

Native code steps a robot if and only if its state has no contact, so the bits of a motion depend on
nothing else. The arrays of a pack hold the state of every robot, and ``mujoco.MjData`` is working memory.
Native code steps vectors of robots, so a table has the shape (blocks, columns, WIDTH).

A model with proofs has at most one joint a body, through its origin; others are welded to their
parents. It has shapes of the kinds in ``clearance.h``, and nothing moves but the robot. Models of
MJCF files can hold any element, so MuJoCo checks all of their contacts.
"""

from __future__ import annotations

import ctypes
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64, MjData, MjModel, Rows
from batchpid.sim.engine.mujoco.model_builder import RobotMj
from batchpid.sim.engine.native import FARTHEST, WIDTH, number, structure
from batchpid.sim.engine.native_model import NativeModel, aligned, table

Arrays = dict[str, NDArray[Any]]

_NO_CONTACT = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
_NEVER = 1 << 30
"""Age without a proof: NEVER in ``clearance.h``."""
_FLAGS = 0x5AA55AA5
"""Value of ``opt.disableflags`` by which its place in ``mjModel`` is found."""
_POINTERS = "body_geomnum", "body_contype", "body_conaffinity"
_BEGINNING = 4096
"""Number of bytes at the start of ``mjModel`` that are searched for its options; ``mjModel`` is
larger.
"""

_LONGEST = 10.0
"""Largest position of a sliding joint in which bounds of speeds hold [m]."""
_BEYOND = 0.01
"""Distance beyond the limits of a sliding joint up to which they hold [m]: limits are soft."""


@lru_cache(maxsize=8)
def shape_tables(robot: RobotMj) -> Arrays | None:
    """Return the tables of shapes and pairs for ``Clearance`` in ``clearance.h``, the same for
    every robot.

    None if there are no proofs: the model is a file's, no shapes can touch, or the fields to change
    are not found in this version of MuJoCo.
    """
    model = robot.model
    pairs = touching_pairs(model)
    # Models of files, which have frames, can hold any element.
    if robot.frames or not len(pairs) or places() is None:
        return None
    bodies = model.geom_bodyid[pairs]
    arms, travel = _arms(robot, bodies)
    meshes = model.geom_dataid
    hulls = np.zeros((model.ngeom, 2), np.int32)
    hulls[meshes >= 0] = np.stack([model.mesh_vertadr, model.mesh_vertnum], axis=1)[
        meshes[meshes >= 0]
    ]
    return {
        "kinds": model.geom_type.astype(np.int32),
        "sizes": model.geom_size.astype(float),
        "radii": model.geom_rbound.astype(float),
        "hulls": hulls,
        "vertices": model.mesh_vert.astype(float).reshape(-1, 3),
        "pairs": pairs,
        "bodies": bodies.astype(np.int32),
        "arms": _vectors(arms),
        "travel": travel,
    }


def _vectors(arms: Float64) -> Float64:
    """Return the arms of all pairs, with zeros for those beyond the last (ways, blocks, WIDTH)."""
    padded = aligned(arms.shape[1], -(-len(arms) // WIDTH), WIDTH)
    padded.reshape(arms.shape[1], -1)[:, : len(arms)] = arms.T
    return padded


def touching_pairs(model: MjModel) -> NDArray[np.int32]:
    """Return the pairs of shapes (pairs, 2), by number, that MuJoCo checks for contact; the ground
    comes first.

    MuJoCo ignores bodies that are welded together, a body and its parent unless the parent is the
    world, and excluded bodies ("Collision detection" in MuJoCo's documentation).
    """
    pairs = np.column_stack(np.triu_indices(model.ngeom, 1))
    bodies = model.geom_bodyid[pairs]
    welded = model.body_weldid[bodies]
    parents = model.body_weldid[model.body_parentid[welded]]
    # A body and its parent touch at their joint; the world is no such parent.
    related = (welded != 0).all(axis=1) & (welded == parents[:, ::-1]).any(axis=1)
    excluded = np.isin((bodies[:, 0] << 16) + bodies[:, 1], model.exclude_signature)
    chosen: NDArray[np.int32] = pairs[(welded[:, 0] != welded[:, 1]) & ~related & ~excluded].astype(
        np.int32
    )
    return chosen


def _arms(robot: RobotMj, pairs: NDArray[np.intp]) -> tuple[Float64, Float64]:
    """Return bounds of the closing speed of pairs of bodies per unit speed of each way (pairs,
    ways) [m or 1], and the joint positions in which they hold (2, dof).

    A way is a joint; a floating base adds its displacement and its rotation. A way that moves both
    bodies of a pair, or neither, does not change their distance.
    """
    model = robot.model
    dof = len(robot.joints)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    numbers = np.full(model.nbody, -1)
    numbers[model.dof_bodyid[robot.qvel]] = np.arange(dof)
    axes = model.jnt_axis[model.dof_jntid[robot.qvel]]
    # Balls in the frame of the body to which their carriers are welded: center and radius.
    balls = defaultdict[int, list[list[float]]](list)

    def add(point: Float64, radius: float, carrier: int) -> None:
        top = int(model.body_weldid[carrier])
        place = (point - data.xpos[top]) @ data.xmat[top].reshape(3, 3)
        balls[top].append([*place, radius])

    for place, radius, body in zip(
        data.geom_xpos, model.geom_rbound, model.geom_bodyid, strict=True
    ):
        add(place, radius, body)
    arms = np.ones(dof + 2)
    travel = np.tile([[-np.inf], [np.inf]], (1, dof))
    # From the last body to the base: a ball around the origin of a body contains all that it
    # carries at any pose, and is carried by the body above.
    for body in reversed(range(1, model.nbody)):
        if model.body_weldid[body] != body:
            continue
        points = np.reshape(balls[body], (-1, 4))
        reach = (np.linalg.norm(points[:, :3], axis=1) + points[:, 3]).max(initial=0.0)
        at = numbers[body]
        if at < 0:  # a floating base
            arms[dof + 1] = reach
            continue
        joint = robot.joints[at]
        if joint.unit == "m":
            limits = np.clip([joint.lower, joint.upper], -_LONGEST, _LONGEST)
            travel[:, at] = limits + np.array([-_BEYOND, _BEYOND])
            reach += np.abs(travel[:, at]).max()
        else:
            # A hinge moves a point by its distance from the axis.
            across = np.linalg.norm(np.cross(points[:, :3], axes[at]), axis=1)
            arms[at] = (across + points[:, 3]).max(initial=0.0)
        add(data.xpos[body], reach, model.body_parentid[body])
    floats = len(model.jnt_type) > dof
    moved = np.zeros((model.nbody, dof + 2 * floats), bool)
    for body in range(1, model.nbody):
        # What moves a body moves its children.
        moved[body] = moved[model.body_parentid[body]]
        moved[body, dof:] = model.body_weldid[body] > 0
        if numbers[body] >= 0:
            moved[body, numbers[body]] = True
    differs = moved[pairs[:, 0]] != moved[pairs[:, 1]]
    return np.where(differs, arms[: moved.shape[1]], 0.0), travel


def _offset(address: int, size: int, value: int, kind: type[np.generic]) -> int | None:
    """Return the offset [bytes] of the only ``value`` in ``size`` bytes of memory; None if it is
    ambiguous.
    """
    memory = np.frombuffer(ctypes.string_at(address, size), kind)
    indices = np.flatnonzero(memory == value)
    return int(indices[0]) * memory.itemsize if len(indices) == 1 else None


@cache
def places() -> tuple[int, ...] | None:
    """Return the offsets of ``opt.disableflags`` and of the pointers :data:`_POINTERS` in
    ``mjModel`` [bytes], found by their values. None if one is ambiguous.
    """
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    model.opt.disableflags = _FLAGS
    values = [getattr(model, name).ctypes.data for name in _POINTERS]
    address = model._address
    offsets = [
        _offset(address, _BEGINNING, _FLAGS, np.int32),
        *(_offset(address, _BEGINNING, value, np.uint64) for value in values),
    ]
    unique = tuple(offset for offset in offsets if offset is not None)
    return unique if len(unique) == len(offsets) else None


class GroupClearance:
    """Clearances of robots in MuJoCo, for native code; ``kinematics`` is the address of
    ``mj_kinematics``.

    ``tables`` come from :func:`shape_tables`; ``models`` and ``data`` have one entry for each
    robot. Native code disables contacts in a model during a part of each sim step, so groups that
    share a model must take turns. A reset of a robot needs no call, because a jump of its positions
    counts as motion of its joints.
    """

    def __init__(
        self,
        tables: Arrays,
        kinematics: int,
        models: Sequence[MjModel],
        data: Sequence[MjData],
        dof: int,
    ) -> None:
        robots = len(data)
        pairs = len(tables["pairs"])
        bodies = models[0].nbody
        floats = models[0].njnt > dof
        blocks, ways = -(-robots // WIDTH), dof + 2 * floats
        arrays = tables | {
            # Native code reads the places of shapes where MuJoCo writes them.
            "models": np.array([model._address for model in models], np.uint64),
            "places": np.array([scene.geom_xpos.ctypes.data for scene in data], np.uint64),
            "turns": np.array([scene.geom_xmat.ctypes.data for scene in data], np.uint64),
            "last": aligned(blocks, dof, WIDTH),
            "shares": aligned(blocks, 2, WIDTH),
            "moved": aligned(blocks, ways, WIDTH),
            "rate": aligned(blocks, ways, WIDTH),
            "open": np.zeros((robots, bodies), np.int8),
            "left": np.zeros((robots, -(-pairs // WIDTH) * WIDTH), np.uint16),
            "wait": np.ones(robots, np.int32),
            "no_shapes": np.zeros(bodies, np.int32),
            "some_types": np.zeros(bodies, np.int32),
            "brief": np.zeros(robots, np.int8),
            # No proof is young enough: the first step checks all pairs.
            "age": np.full(robots, _NEVER, np.int32),
        }
        if floats:
            arrays["poses"] = np.zeros((robots, 7))
        self.arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        # Native code has their addresses.
        self._kept = [*models], data
        fields = zip(("flags", "counts", "types_at", "affinities_at"), places() or (), strict=True)
        self._fields = structure("Clearance")(
            kinematics=kinematics,
            number=pairs,
            ways=ways,
            size=bodies,
            contact=_NO_CONTACT,
            **dict(fields),
            **{name: array.ctypes.data for name, array in self.arrays.items()},
        )

    @property
    def address(self) -> int:
        """Address of the ``Clearance`` structure."""
        return ctypes.addressof(self._fields)


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
    offset = _offset(start, size, _COUNT, np.int32)
    return None if offset is None else start - data._address + offset


class FreeMotions:
    """States of robots of ``robot``, whose rigid bodies are those of ``model``; ``sensed`` (M,
    sensors) are the sums of their sensors.

    Attributes
    ----------
    contact
        What is known about the contacts of each robot (M,), by number of Contact in free_motion.h.
    time
        Time of each robot (M,) [s].
    ctrl
        Inputs of the drives (M, dof); not used without drives.
    """

    def __init__(self, robot: RobotMj, model: NativeModel, sensed: Float64) -> None:
        dof, size = len(robot.joints), len(sensed)
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
            "sums": sensed,
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
            wrenches=(scene.sensor_type == mujoco.mjtSensor.mjSENS_FORCE).sum(),
            sensed=sensed.shape[1],
        )

    def use(self, models: Sequence[MjModel], wrenches: Mapping[str, Rows]) -> None:
        """Take the constants of the robots' models (M,), which may have changed, and their
        :func:`.wrench_tables`.
        """
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
        self._arrays |= wrenches
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

    def read(self, state: int) -> Float64:
        """Return positions, velocities or last accelerations (M, dof): ``state`` 0, 1, 2."""
        array = self._states[state]
        return np.array(array.swapaxes(1, 2).reshape(-1, array.shape[1])[: self.size])

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
        qpos, qvel, acceleration = [array[at] for array in self._states]
        data.qpos[self._robot.qpos], data.qvel[self._robot.qvel] = qpos, qvel
        data.qacc_warmstart[self._robot.qvel] = acceleration
        data.time = self.time[row]
        data.ctrl[:] = self.ctrl[row, : len(data.ctrl)]
        if (np.abs(data.qpos) <= FARTHEST).all():
            mujoco.mj_step1(model, data)
