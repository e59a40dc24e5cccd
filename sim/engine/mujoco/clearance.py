"""Tables of a robot's shapes in MuJoCo, from which native code proves that no shapes touch (``clearance.h``).

Collision detection takes half of a sim step of a robot with meshes, and usually finds no contact.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from batchpid.sim.engine.link_reach import LinkExtent, closing_arms, link_reach
from batchpid.sim.engine.mujoco.model_builder import RobotMj
from batchpid.sim.engine.native.interface import Clearance

Arrays = dict[str, NDArray[Any]]

_BEYOND = 0.01
"""Distance by which a sliding joint may pass its limits while clearances hold [m]: MuJoCo's limits are soft."""
_NO_CONTACT = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
_BEGINNING = 4096
"""Number of bytes at the start of ``mjModel`` that are searched for its options; ``mjModel`` is larger."""
_GEOM = mujoco.mjtGeom
_KINDS = {
    int(kind) for kind in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_BOX)
} | {int(_GEOM.mjGEOM_MESH), int(_GEOM.mjGEOM_PLANE)}


@lru_cache(maxsize=8)
def shape_tables(robot: RobotMj) -> Arrays | None:
    """Return the tables of shapes and pairs that ``Clearance`` in ``clearance.h`` lists, the same for every robot.

    None where MuJoCo always runs its collision detection: no pair of shapes may touch, a floating base may touch the
    ground, a kind of shape is not supported, or the fields to change are not found in this version of MuJoCo.
    """
    model = robot.model
    pairs = touching_pairs(model) if places() is not None else np.empty((0, 2))
    floats = bool((model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any())
    world = model.body_weldid[model.geom_bodyid] == 0
    if not len(pairs) or (floats and world[pairs].any()) or not set(model.geom_type.tolist()) <= _KINDS:
        return None
    reach, travel = _reach(robot)
    bodies = model.geom_bodyid[pairs]
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
        "arms": closing_arms(reach[bodies[:, 0]], reach[bodies[:, 1]]),
        "travel": travel,
    }


def touching_pairs(model: Any) -> NDArray[np.int32]:
    """Return the pairs of shapes (pairs, 2), by number, that MuJoCo checks for contact; a plane comes first.

    MuJoCo leaves out pairs of planes, of bodies that are welded together, of a body and its parent unless that is the
    world, of excluded bodies, and of shapes whose ``contype`` and ``conaffinity`` do not match ("Collision detection"
    in MuJoCo's documentation).
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
    """Return the reach of the bodies (bodies, dof), and the range of joint positions in which it holds (2, dof)."""
    model, dof = robot.model, len(robot.qvel)
    places = {int(at): number for number, at in enumerate(robot.qvel)}
    travel = np.tile([[-np.inf], [np.inf]], (1, dof))
    links = []
    for body in range(model.nbody):
        pose, in_link = _pose(model.body_pos[body], model.body_quat[body]), np.eye(4)
        number, slides, farthest = None, False, 0.0
        for joint in np.flatnonzero(model.jnt_bodyid == body):
            number = places.get(int(model.jnt_dofadr[joint]))
            if number is None:  # a free joint
                continue
            slides = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
            in_link[:3, :3] = np.linalg.qr(np.column_stack([model.jnt_axis[joint], np.eye(3)]))[0]
            in_link[:3, 3] = model.jnt_pos[joint]
            if slides and model.jnt_limited[joint]:
                travel[:, number] = model.jnt_range[joint] + (-_BEYOND, _BEYOND)
            farthest = float(np.abs(travel[:, number]).max()) if slides else 0.0
        balls = np.column_stack([model.geom_pos, model.geom_rbound])[model.geom_bodyid == body]
        parent = int(model.body_parentid[body]) if body else None
        links.append(LinkExtent(parent, number, slides, pose @ in_link, in_link, farthest, balls))
    return link_reach(links, dof), travel


def _pose(position: NDArray[np.float64], wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    pose, turn = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(turn, wxyz)
    pose[:3, :3], pose[:3, 3] = turn.reshape(3, 3), position
    return pose


@cache
def places() -> tuple[int, int] | None:
    """Return the places of ``opt.disableflags`` and of the pointer ``body_geomnum`` in ``mjModel`` [bytes].

    They are found by flipping a flag, and by the address; None if one is ambiguous.
    """
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    before = ctypes.string_at(model._address, _BEGINNING)
    model.opt.disableflags ^= _NO_CONTACT
    after = ctypes.string_at(model._address, _BEGINNING)
    flags = [place for place in range(_BEGINNING) if before[place] != after[place]]
    counts = (8 * np.flatnonzero(np.frombuffer(after, np.uint64) == model.body_geomnum.ctypes.data)).tolist()
    return (flags[0], counts[0]) if len(flags) == len(counts) == 1 and flags[0] % 4 == 0 else None


class GroupClearance:
    """Clearances of robots in MuJoCo, for native code; ``kinematics`` is the address of ``mj_kinematics``.

    ``tables`` come from :func:`shape_tables`; ``models`` and ``data`` have one entry for each robot. Native code
    disables the contacts of a model during part of a sim step, so groups with the same model take turns. A reset of a
    robot needs no call: a jump of its positions counts as motion of its joints.

    Attributes
    ----------
    arrays
        Arrays by the names of the fields in ``clearance.h``.
    """

    def __init__(self, tables: Arrays, kinematics: int, models: Sequence[Any], data: Sequence[Any], dof: int) -> None:
        robots, pairs = len(data), len(tables["pairs"])
        addresses = {
            "models": [model._address for model in models],
            "places": [each.geom_xpos.ctypes.data for each in data],
            "turns": [each.geom_xmat.ctypes.data for each in data],
            "shapes": [model.body_geomnum.ctypes.data for model in models],
        }
        arrays: Arrays = {name: np.array(rows, np.uint64) for name, rows in addresses.items()}
        arrays |= tables | {name: np.zeros((robots, dof)) for name in ("last", "moved", "rate")}
        arrays |= {"left": np.full((robots, pairs), -1.0, np.float32), "wait": np.ones(robots, np.int32)}
        arrays["no_shapes"] = np.zeros_like(models[0].body_geomnum)
        self.arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        self._kept = models, data
        flags, counts = places() or (0, 0)
        self._fields = Clearance(
            kinematics=kinematics,
            number=pairs,
            flags=flags,
            counts=counts,
            contact=_NO_CONTACT,
            **{name: array.ctypes.data for name, array in self.arrays.items()},
        )

    @property
    def address(self) -> int:
        """Address of the ``Clearance`` structure."""
        return ctypes.addressof(self._fields)
