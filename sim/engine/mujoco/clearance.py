"""Tables for native proofs that shapes of a robot do not touch (``clearance.h``), of models built
from URDFs.

Such a model has at most one joint a body, through the body's origin; bodies without one are welded
to their parents. It has shapes of the kinds in ``clearance.h``, and nothing moves but the robot.
Models of MJCF files can hold any element, so MuJoCo checks all of their contacts.
"""

from __future__ import annotations

import ctypes
from collections import defaultdict
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64, MjData, MjModel
from batchpid.sim.engine.mujoco.model_builder import RobotMj
from batchpid.sim.engine.native.interface import WIDTH, structure
from batchpid.sim.engine.native_model import aligned

Arrays = dict[str, NDArray[Any]]

_NO_CONTACT = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
_NEVER = 1 << 30
"""Age without a proof: NEVER in ``clearance.h``."""
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
    floats = robot.base is not None
    moved = np.zeros((model.nbody, dof + 2 * floats), bool)
    for body in range(1, model.nbody):
        # What moves a body moves its children.
        moved[body] = moved[model.body_parentid[body]]
        moved[body, dof:] = model.body_weldid[body] > 0
        if numbers[body] >= 0:
            moved[body, numbers[body]] = True
    differs = moved[pairs[:, 0]] != moved[pairs[:, 1]]
    return np.where(differs, arms[: moved.shape[1]], 0.0), travel


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
        floats = bool((models[0].jnt_type == mujoco.mjtJoint.mjJNT_FREE).any())
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
