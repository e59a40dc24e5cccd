"""Sim step of robots in MuJoCo as one native call, of the same kind as SAPIEN's.

Robots are stepped by MuJoCo's public functions ``mj_step2`` (from velocities to the next state) and ``mj_step1`` (all
that follows from that state alone, so also gravity and Coriolis forces). Collision detection takes half of a sim step
of a robot with meshes, and usually finds no contact: native code proves, from tables of the shapes, that they do not
touch (``clearance.h``).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import MjModel, Rows
from batchpid.sim.engine import native
from batchpid.sim.engine.link_reach import LinkExtent, closing_arms, link_reach
from batchpid.sim.engine.mujoco.model_builder import FLOATING, RobotMj
from batchpid.sim.engine.native.interface import Clearance, Mujoco
from batchpid.sim.engine.native_model import NativeStep
from batchpid.task_space.spatial_inertia import rotation_matrix

Arrays = dict[str, NDArray[Any]]

_BEYOND = 0.01
"""Distance beyond its limits up to which a sliding joint's arms are valid [m]: MuJoCo's limits are soft."""
_NO_CONTACT = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
_NEVER = 1 << 30
"""Age without a proof: NEVER in ``clearance.h``."""
_MOST_NEAR = 16
"""MOST_NEAR in ``clearance.h``."""
_POINTERS = "body_geomnum", "body_contype", "body_conaffinity"
_BEGINNING = 4096
"""Number of bytes at the start of ``mjModel`` that are searched for its options; ``mjModel`` is larger."""
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_GEOM = mujoco.mjtGeom
_KINDS = {
    int(kind) for kind in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_BOX)
} | {int(_GEOM.mjGEOM_MESH), int(_GEOM.mjGEOM_PLANE)}


@lru_cache(maxsize=8)
def shape_tables(robot: RobotMj) -> Arrays | None:
    """Return the tables of shapes and pairs for ``Clearance`` in ``clearance.h``, the same for every robot.

    None if collision detection is never skipped: the model has no pair of shapes that may touch, or a kind of shape
    that is not supported, or the fields to change are not found in this version of MuJoCo. None also for a file with
    moving bodies apart from the robot, with ``<pair>`` elements or margins of shapes, or with flexible bodies.
    """
    model = robot.model
    moves = len(robot.qvel) + (0 if robot.base is None else FLOATING)
    special = model.npair or model.nflex or model.geom_margin.any()
    special |= int(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT))
    if special or model.nv > moves or robot.base not in (None, (0, 0)):
        return None
    pairs = touching_pairs(model) if places() is not None else np.empty((0, 2))
    if not len(pairs) or not set(model.geom_type.tolist()) <= _KINDS:
        return None
    reach, travel = _reach(robot)
    bodies = model.geom_bodyid[pairs]
    arms = closing_arms(reach[bodies[:, 0]], reach[bodies[:, 1]])
    at = arms > 0
    meshes = np.where(model.geom_type == int(_GEOM.mjGEOM_MESH), model.geom_dataid, -1)
    hulls = np.zeros((model.ngeom, 2), np.int32)
    hulls[meshes >= 0] = np.stack([model.mesh_vertadr, model.mesh_vertnum], axis=1)[meshes[meshes >= 0]]
    return {
        "kinds": model.geom_type.astype(np.int32),
        "sizes": model.geom_size.astype(float),
        "radii": model.geom_rbound.astype(float),
        "hulls": hulls,
        "vertices": model.mesh_vert.astype(float).reshape(-1, 3),
        "pairs": pairs,
        "bodies": bodies.astype(np.int32),
        "arms": arms[at],
        "arm_ways": at.nonzero()[1].astype(np.int32),
        "begins": np.cumsum([0, *at.sum(axis=1)], dtype=np.int32),
        "travel": travel,
    }


def touching_pairs(model: MjModel) -> NDArray[np.int32]:
    """Return the pairs of shapes (pairs, 2), by number, that MuJoCo checks for contact; a plane comes first.

    MuJoCo ignores two planes, bodies that are welded together, a body and its parent unless the parent is the world,
    excluded bodies, and shapes whose ``contype`` and ``conaffinity`` do not match ("Collision detection" in MuJoCo's
    documentation).
    """
    pairs = np.column_stack(np.triu_indices(model.ngeom, 1))
    planes = model.geom_type == int(_GEOM.mjGEOM_PLANE)
    pairs = np.where(planes[pairs[:, 1:]], pairs[:, ::-1], pairs)
    bodies = np.sort(model.geom_bodyid[pairs], axis=1)
    welded = model.body_weldid[bodies]
    parents = model.body_weldid[model.body_parentid[welded]]
    related = (welded != 0).all(axis=1) & (welded == parents[:, ::-1]).any(axis=1)
    excluded = np.isin((bodies[:, 0] << 16) + bodies[:, 1], model.exclude_signature)
    types = (model.geom_contype[pairs] & model.geom_conaffinity[pairs[:, ::-1]]).any(axis=1)
    found = (welded[:, 0] != welded[:, 1]) & ~related & ~excluded & types & ~planes[pairs].all(axis=1)
    return pairs[found].astype(np.int32)


def _reach(robot: RobotMj) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the reach of the bodies (bodies, ways), and the range of joint positions in which it is valid (2, dof).

    A way is a joint. A floating base adds two ways: its displacement and its rotation angle.
    """
    model, dof = robot.model, len(robot.qvel)
    places = {int(at): number for number, at in enumerate(robot.qvel)}
    travel = np.tile([[-np.inf], [np.inf]], (1, dof))
    links = []
    for body in range(model.nbody):
        pose, in_link = _pose(model.body_pos[body], model.body_quat[body]), np.eye(4)
        number, slides, farthest, floats = None, False, 0.0, False
        for joint in np.flatnonzero(model.jnt_bodyid == body):
            floats = int(model.jnt_type[joint]) == _FREE
            if floats:
                number = dof
                continue
            number = places[int(model.jnt_dofadr[joint])]
            slides = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
            in_link[:3, :3] = np.linalg.qr(np.column_stack([model.jnt_axis[joint], np.eye(3)]))[0]
            in_link[:3, 3] = model.jnt_pos[joint]
            if slides and model.jnt_limited[joint]:
                travel[:, number] = model.jnt_range[joint] + (-_BEYOND, _BEYOND)
            farthest = float(np.abs(travel[:, number]).max()) if slides else 0.0
        balls = np.column_stack([model.geom_pos, model.geom_rbound])[model.geom_bodyid == body]
        parent = int(model.body_parentid[body]) if body else None
        links.append(LinkExtent(parent, number, slides, pose @ in_link, in_link, farthest, balls, floats))
    ways = dof + 2 if any(link.free for link in links) else dof
    return link_reach(links, ways), travel


def _pose(position: NDArray[np.float64], wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    pose, turn = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(turn, wxyz)
    pose[:3, :3], pose[:3, 3] = turn.reshape(3, 3), position
    return pose


@cache
def places() -> tuple[int, ...] | None:
    """Return the offsets of ``opt.disableflags`` and of the pointers :data:`_POINTERS` in ``mjModel`` [bytes].

    The flags are found by a change of one of them, the pointers by their values. None if one is ambiguous.
    """
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    before = ctypes.string_at(model._address, _BEGINNING)
    model.opt.disableflags ^= _NO_CONTACT
    after = ctypes.string_at(model._address, _BEGINNING)
    flags = [place for place in range(_BEGINNING) if before[place] != after[place]]
    addresses = [getattr(model, name).ctypes.data for name in _POINTERS]
    found = [(8 * np.flatnonzero(np.frombuffer(after, np.uint64) == address)).tolist() for address in addresses]
    is_clear = len(flags) == 1 and flags[0] % 4 == 0 and all(len(each) == 1 for each in found)
    return (flags[0], *(each[0] for each in found)) if is_clear else None


class GroupClearance:
    """Clearances of robots in MuJoCo, for native code; ``kinematics`` is the address of ``mj_kinematics``.

    ``tables`` come from :func:`shape_tables`; ``models`` and ``data`` have one entry for each robot. Native code
    disables contacts in a model during a part of each sim step, so groups that share a model must take turns. A reset
    of a robot needs no call, because a jump of its positions counts as motion of its joints.

    Attributes
    ----------
    arrays
        Arrays by the names of the fields in ``clearance.h``.
    """

    def __init__(self, tables: Arrays, kinematics: int, models: Sequence[Any], data: Sequence[Any], dof: int) -> None:
        robots, pairs, bodies = len(data), len(tables["pairs"]), models[0].nbody
        floats = bool((models[0].jnt_type == _FREE).any())
        ways = dof + 2 * floats
        addresses = {
            "models": [model._address for model in models],
            "places": [each.geom_xpos.ctypes.data for each in data],
            "turns": [each.geom_xmat.ctypes.data for each in data],
            "shapes": [model.body_geomnum.ctypes.data for model in models],
            "types": [model.body_contype.ctypes.data for model in models],
            "affinities": [model.body_conaffinity.ctypes.data for model in models],
        }
        arrays: Arrays = {name: np.array(rows, np.uint64) for name, rows in addresses.items()}
        arrays |= tables | {name: np.zeros((robots, ways)) for name in ("moved", "rate")}
        arrays |= {"last": np.zeros((robots, dof + 7 * floats)), "open": np.zeros((robots, bodies), np.int8)}
        arrays |= {"left": np.zeros((robots, pairs), np.uint16), "wait": np.ones(robots, np.int32)}
        arrays |= {name: np.zeros(bodies, np.int32) for name in ("no_shapes", "some_types", "some_affinities")}
        arrays["brief"] = np.zeros(robots, np.int8)
        arrays["near"] = np.full((robots, _MOST_NEAR), -1, np.int32)
        arrays["age"] = np.full(robots, _NEVER, np.int32)
        self.arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        self._kept = models, data
        flags, counts, types, affinities = places() or (0, 0, 0, 0)
        self._fields = Clearance(
            kinematics=kinematics,
            number=pairs,
            ways=ways,
            size=bodies,
            flags=flags,
            counts=counts,
            types_at=types,
            affinities_at=affinities,
            contact=_NO_CONTACT,
            floats=floats,
            **{name: array.ctypes.data for name, array in self.arrays.items()},
        )

    @property
    def left(self) -> NDArray[np.float32]:
        """Proved clearances (robots, pairs) [m]; 0 without a proof."""
        return (self.arrays["left"].astype(np.uint32) << 16).view(np.float32)

    @property
    def address(self) -> int:
        """Address of the ``Clearance`` structure."""
        return ctypes.addressof(self._fields)


FUNCTIONS = {
    "step1": "mj_step1",
    "step2": "mj_step2",
    "set_log_handler": "mju_setLogHandler",
    "kinematics": "mj_kinematics",
}
"""Functions of MuJoCo's library, by field of the structures in :mod:`batchpid.sim.engine.native.interface`."""
CLOCK = "mjcb_time"
"""Variable of the library that holds its clock."""
FIELDS = {"qpos": "qpos", "qvel": "qvel", "applied": "qfrc_applied", "bias": "qfrc_bias", "ctrl": "ctrl"}
FIELDS |= {"sensors": "sensordata"}
"""Arrays of ``mujoco.MjData``, by field."""


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
    """Return the addresses of functions and clock by field; None if this version of MuJoCo lacks one of them."""
    try:
        library = ctypes.CDLL(str(mujoco_library()))
        found = {field: ctypes.cast(getattr(library, name), ctypes.c_void_p).value for field, name in FUNCTIONS.items()}
        found["clock"] = ctypes.addressof(ctypes.c_void_p.in_dll(library, CLOCK))
        data = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
        has_addresses = bool(data._address and data.model._address)
    except (ValueError, OSError, AttributeError):
        return None
    return {field: address or 0 for field, address in found.items()} if has_addresses else None


class MujocoStep(NativeStep):
    """Sim step of robots in MuJoCo.

    Parameters
    ----------
    robot
        Places of the joints in MuJoCo's arrays.
    models
        Of each robot.
    take_data
        Function that returns the ``mujoco.MjData`` of each robot, the same at every call, in its state.
    qf, skip
        Efforts last applied (robots, dof), and the robots that are not stepped (robots,).
    reads_force
        Whether to read the forces of gravity and Coriolis; otherwise they are zero.
    speed_limit
        Joint speed beyond which the status says so (dof,), or None.
    constraint
        Address of the constraint of coupled joints, or None.
    sensed
        Sums of the sensors over sim steps (robots, values).
    drives
        Stiffness and rate gain of the drives (robots, dof), if the targets move within a tick.
    """

    def __init__(
        self,
        robot: RobotMj,
        models: Sequence[Any],
        take_data: Callable[[], Sequence[Any]],
        qf: NDArray[np.float64],
        skip: NDArray[np.bool_],
        reads_force: bool,
        speed_limit: NDArray[np.float64] | None,
        constraint: int | None = None,
        drives: tuple[Rows, ...] | None = None,
        *,
        sensed: NDArray[np.float64],
    ) -> None:
        found, data = functions(), take_data()
        assert found is not None
        addresses = dict(found)
        kinematics, shapes = addresses.pop("kinematics"), shape_tables(robot)
        clearance = None if shapes is None else GroupClearance(shapes, kinematics, models, data, qf.shape[1])
        tables = {
            "models": [model._address for model in models],
            "data": [each._address for each in data],
            **{field: [getattr(each, name).ctypes.data for each in data] for field, name in FIELDS.items()},
        }
        arrays: dict[str, Rows] = {name: np.array(rows, np.uint64) for name, rows in tables.items()}
        arrays |= {"qpos_at": robot.qpos.astype(np.int64), "qvel_at": robot.qvel.astype(np.int64), "qf": qf}
        arrays |= {"turn": np.ascontiguousarray(rotation_matrix(robot.turn)), "sensed": sensed}
        if drives is not None:
            arrays |= zip(("stiffness", "rate_gain"), drives, strict=True)
        robots = Mujoco(**addresses, **{name: array.ctypes.data for name, array in arrays.items()})
        robots.sensor_size = sensed.shape[1]
        robots.base_qpos, robots.base_qvel = robot.base or (0, 0)
        robots.clearance = None if clearance is None else clearance.address
        self._take_data, self._kept = take_data, (models, data, arrays, robots, clearance)
        super().__init__(
            len(data),
            qf.shape[1],
            {"skip": skip},
            speed_limit,
            mujoco=ctypes.addressof(robots),
            gravity=reads_force,
            coriolis=reads_force,
            velocities=True,
            constraint=constraint,
        )

    def prepare(self) -> int:
        """Return the address of the group, for a call of the extension or of XLA; the robots are in their states."""
        self._take_data()
        return super().prepare()
