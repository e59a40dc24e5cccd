"""Tables for native proofs that shapes of a robot do not touch (``clearance.h``), of models built
from URDFs.

Such a model has one joint a body, through the body's origin, shapes of the kinds in
``clearance.h``, and no moving bodies but the robot's. Models of MJCF files can hold any element, so
MuJoCo checks all of their contacts.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64, MjModel
from batchpid.sim.engine.mujoco.model_builder import RobotMj
from batchpid.sim.engine.native.interface import Clearance

Arrays = dict[str, NDArray[Any]]

_BEYOND = 0.01
"""Distance beyond its limits up to which a sliding joint's arms are valid [m]: MuJoCo's limits are
soft.
"""
_NO_CONTACT = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
_NEVER = 1 << 30
"""Age without a proof: NEVER in ``clearance.h``."""
_MOST_NEAR = 16
"""MOST_NEAR in ``clearance.h``."""
_POINTERS = "body_geomnum", "body_contype", "body_conaffinity"
_BEGINNING = 4096
"""Number of bytes at the start of ``mjModel`` that are searched for its options; ``mjModel`` is
larger.
"""


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
    at = arms > 0
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
        "arms": arms[at],
        "arm_ways": at.nonzero()[1].astype(np.int32),
        "begins": np.cumsum([0, *at.sum(axis=1)], dtype=np.int32),
        "travel": travel,
    }


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
    ways) [m or 1].

    A way is a joint; a floating base adds its displacement and its rotation. The bounds hold within
    a range of joint positions (2, dof), which is returned, too. A body's shapes and children are
    balls around points of the body; the ball of a child contains everything that moves with it, at
    any pose. A way that moves both bodies of a pair, or neither, does not change their distance.
    """
    model = robot.model
    dof = len(robot.qvel)
    travel = np.tile([[-np.inf], [np.inf]], (1, dof))
    arms = np.ones(dof + 2 * (robot.base is not None))
    moved = np.zeros((model.nbody, len(arms)), bool)
    # Points and radii that a body carries; its children add theirs, from the last body to the root.
    balls: list[list[tuple[Any, float]]] = [[] for _ in range(model.nbody)]
    for shape, body in enumerate(model.geom_bodyid):
        balls[body].append((model.geom_pos[shape], model.geom_rbound[shape]))
    for body in reversed(range(1, model.nbody)):
        joint = int(model.body_jntadr[body])
        slide = 0.0
        points = np.array([point for point, _ in balls[body]]).reshape(-1, 3)
        radii = np.array([radius for _, radius in balls[body]])
        farthest = (np.linalg.norm(points, axis=1) + radii).max(initial=0.0)
        if joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            moved[body, dof:] = True
            arms[dof + 1] = farthest
        elif joint >= 0:
            column = int(np.flatnonzero(robot.qvel == model.jnt_dofadr[joint])[0])
            moved[body, column] = True
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
                # A hinge moves a point at its distance from the axis, not from the origin.
                across = np.cross(points, model.jnt_axis[joint])
                arms[column] = (np.linalg.norm(across, axis=1) + radii).max(initial=0.0)
            else:
                if model.jnt_limited[joint]:
                    travel[:, column] = model.jnt_range[joint] + (-_BEYOND, _BEYOND)
                slide = float(np.abs(travel[:, column]).max())
        balls[model.body_parentid[body]].append((model.body_pos[body], slide + farthest))
    for body in range(1, model.nbody):
        # What moves a body moves its children.
        moved[body] |= moved[model.body_parentid[body]]
    return np.where(moved[pairs[:, 0]] != moved[pairs[:, 1]], arms, 0.0), travel


@cache
def places() -> tuple[int, ...] | None:
    """Return the offsets of ``opt.disableflags`` and of the pointers :data:`_POINTERS` in
    ``mjModel`` [bytes].

    The flags are found by a change of one of them, the pointers by their values. None if one is
    ambiguous.
    """
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    before = ctypes.string_at(model._address, _BEGINNING)
    # One bit differs between the two copies of the model's beginning.
    model.opt.disableflags ^= _NO_CONTACT
    after = ctypes.string_at(model._address, _BEGINNING)
    flags = [place for place in range(_BEGINNING) if before[place] != after[place]]
    addresses = [getattr(model, name).ctypes.data for name in _POINTERS]
    offsets = [
        (8 * np.flatnonzero(np.frombuffer(after, np.uint64) == address)).tolist()
        for address in addresses
    ]
    is_clear = len(flags) == 1 and flags[0] % 4 == 0 and all(len(words) == 1 for words in offsets)
    if is_clear:
        return (flags[0], *(words[0] for words in offsets))
    return None


class GroupClearance:
    """Clearances of robots in MuJoCo, for native code; ``kinematics`` is the address of
    ``mj_kinematics``.

    ``tables`` come from :func:`shape_tables`; ``models`` and ``data`` have one entry for each
    robot. Native code disables contacts in a model during a part of each sim step, so groups that
    share a model must take turns. A reset of a robot needs no call, because a jump of its positions
    counts as motion of its joints.
    """

    def __init__(
        self, tables: Arrays, kinematics: int, models: Sequence[Any], data: Sequence[Any], dof: int
    ) -> None:
        robots = len(data)
        pairs = len(tables["pairs"])
        bodies = models[0].nbody
        floats = bool((models[0].jnt_type == mujoco.mjtJoint.mjJNT_FREE).any())
        ways = dof + 2 * floats
        arrays = tables | {
            # Native code reads the places of shapes where MuJoCo writes them.
            "models": np.array([model._address for model in models], np.uint64),
            "places": np.array([scene.geom_xpos.ctypes.data for scene in data], np.uint64),
            "turns": np.array([scene.geom_xmat.ctypes.data for scene in data], np.uint64),
            "moved": np.zeros((robots, ways)),
            "rate": np.zeros((robots, ways)),
            "last": np.zeros((robots, dof + 7 * floats)),
            "open": np.zeros((robots, bodies), np.int8),
            "left": np.zeros((robots, pairs), np.uint16),
            "wait": np.ones(robots, np.int32),
            "no_shapes": np.zeros(bodies, np.int32),
            "some_types": np.zeros(bodies, np.int32),
            "brief": np.zeros(robots, np.int8),
            # No pair is near, and no proof is young enough: the first step checks all pairs.
            "near": np.full((robots, _MOST_NEAR), -1, np.int32),
            "age": np.full(robots, _NEVER, np.int32),
        }
        self.arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        # Native code has their addresses.
        self._kept = models, data
        fields = zip(("flags", "counts", "types_at", "affinities_at"), places() or (), strict=True)
        self._fields = Clearance(
            kinematics=kinematics,
            number=pairs,
            ways=ways,
            size=bodies,
            contact=_NO_CONTACT,
            floats=floats,
            **dict(fields),
            **{name: array.ctypes.data for name, array in self.arrays.items()},
        )

    @property
    def address(self) -> int:
        """Address of the ``Clearance`` structure."""
        return ctypes.addressof(self._fields)
