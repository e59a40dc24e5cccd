r"""Poses, Jacobians and velocity products of a kinematic tree.

With the axis a_j and the place o_j of joint j in the world, a point p of a link that joint j moves
has the velocity::

    (v, w) = J q'      J_j = (a_j x (p - o_j), a_j), or (a_j, 0) for a prismatic joint; 0 for a joint that moves it not
    (v', w') = J q'' + J' q'

J' q' is the acceleration at q'' = 0. With the velocity (v_o, w) and the acceleration (A_o, A_w) of
a body, as fields about the origin, accumulated from the base to the tips with the motions s_j of
the joints::

    V_j = V_above + s_j q'_j        A_j = A_above + V_j x s_j q'_j
    J' q' = (A_o + A_w x p + w x (v_o + w x p), A_w)

R. Featherstone, Rigid Body Dynamics Algorithms (Springer, 2008), sections 2.11 and 5.3. Twists and
Jacobians are (linear, angular). Arrays have any leading axes; an env's result does not depend on
the others, to the last bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.arrays.elementwise import namespace
from batchpid.checks.validate import instance, is_traced, read_array
from batchpid.errors import InvalidArgumentError
from batchpid.task_space.frames import cross, rotate, turned
from batchpid.task_space.rigid_tree import MAKE_TREE, Bodies, RigidTree
from batchpid.task_space.symmetric import quiet


class Motions(NamedTuple):
    """Frames of the bodies, and motions per rate of each joint, in the world, at given joint
    positions.
    """

    frames: Array
    """(..., dof, 3, 4)."""
    linear: Array
    """Velocity per rate of the joint, of the body's point that is at the origin of the world (...,
    dof, 3).
    """
    angular: Array
    """Angular velocity per rate of the joint (..., dof, 3)."""


class Velocities(NamedTuple):
    """Velocities of the bodies, and their accelerations at q'' = 0, as fields about the origin
    (..., dof, 3).
    """

    linear: Array
    angular: Array
    linear_rate: Array
    angular_rate: Array


def prepared(tree: RigidTree, **arrays: Array) -> tuple[list[Array], Bodies, ArrayModule]:
    """Return checked arrays (..., dof) in one dtype, the tree's bodies in it, and their
    namespace.
    """
    instance("tree", tree, RigidTree, MAKE_TREE)
    xp = namespace(*arrays.values())
    checked = []
    shape = None
    for name, value in arrays.items():
        if xp is not np or is_traced(value):
            array = value
        else:
            array = read_array(name, value).astype(np.float64, copy=False)
        if array.ndim < 1 or array.shape[-1] != tree.dof:
            remedy = f"the last axis counts the joints {', '.join(tree.joint_names)}"
            raise InvalidArgumentError(
                name, f"has shape {array.shape}, not (..., {tree.dof})", remedy=remedy
            )
        if shape is not None and array.shape != shape:
            remedy = "give both for the same envs"
            raise InvalidArgumentError(
                name, f"has shape {array.shape}, but the first has {shape}", remedy=remedy
            )
        shape = array.shape
        checked.append(array)
    if xp is np:
        return checked, tree.bodies, xp
    dtype = xp.result_type(*checked)
    return (
        [a.astype(dtype) for a in checked],
        Bodies(*(xp.asarray(leaf, dtype) for leaf in tree.bodies)),
        xp,
    )


def frames_of_bodies(
    tree: RigidTree,
    bodies: Bodies,
    qpos: Array,
    xp: ArrayModule,
) -> Array:
    """Return the frames (..., dof, 3, 4) of the bodies in the world."""
    with quiet():
        # Rodrigues' formula with the placement multiplied in: four constant matrices a joint.
        q = qpos[..., None, None]
        local = (
            bodies.at_zero
            + xp.sin(q) * bodies.sine
            + (1 - xp.cos(q)) * bodies.cosine
            + q * bodies.slide
        )
        frames: list[Array] = []
        for joint, above in enumerate(tree.body_parents):
            part = local[..., joint, :, :]
            frames.append(part if above < 0 else turned(frames[above], part))
        return xp.stack(frames, axis=-3)


def motions_of(
    tree: RigidTree,
    bodies: Bodies,
    qpos: Array,
    xp: ArrayModule,
) -> Motions:
    """Return the frames of the bodies and the motions of the joints."""
    frames = frames_of_bodies(tree, bodies, qpos, xp)
    axis = frames[..., 0]
    turning = axis * (1 - bodies.slides)
    return Motions(
        frames,
        cross(frames[..., 3], turning) + axis * bodies.slides,
        turning,
    )


def velocities_of(
    tree: RigidTree,
    motions: Motions,
    qvel: Array,
    xp: ArrayModule,
    turning: Array = None,
) -> Velocities:
    """Return the velocities of the bodies, and their accelerations at q'' = 0, on a base that turns
    at ``turning``.
    """
    linear = motions.linear * qvel[..., None]
    angular = motions.angular * qvel[..., None]
    # Velocities about the world's origin add up along the chain without a shift.
    v = from_base(tree, linear, xp)
    w = from_base(tree, angular, xp)
    if turning is not None:
        w = w + turning[..., None, :]
    return Velocities(
        v,
        w,
        from_base(tree, cross(w, linear) + cross(v, angular), xp),
        from_base(tree, cross(w, angular), xp),
    )


def from_base(tree: RigidTree, steps: Array, xp: ArrayModule) -> Array:
    """Return the sums of ``steps`` (..., dof, k) over the joints between the base and each body."""
    sums: list[Array] = []
    for joint, above in enumerate(tree.body_parents):
        sums.append(steps[..., joint, :] if above < 0 else sums[above] + steps[..., joint, :])
    return xp.stack(sums, axis=-2)


def from_tips(tree: RigidTree, parts: Array, xp: ArrayModule) -> Array:
    """Return the sums of ``parts`` (..., dof, k) over the bodies that each joint moves."""
    sums = [parts[..., joint, :] for joint in range(tree.dof)]
    for joint, above in reversed(list(enumerate(tree.body_parents))):
        if above >= 0:
            sums[above] = sums[above] + sums[joint]
    return xp.stack(sums, axis=-2)


def tool_frame(
    tree: RigidTree,
    bodies: Bodies,
    frames: Array,
    index: int,
    point: Array,
) -> Array:
    """Return the frame (..., 3, 4) of a link, from the frames of the bodies, with its origin at
    ``point`` (..., 3) of the link.
    """
    body = tree.link_bodies[index]
    frame = bodies.link_frames[index]
    # A link of the base does not move, but has a frame in each row.
    if body >= 0:
        frame = turned(frames[..., body, :, :], frame)
    else:
        frame = frame + namespace(frames).zeros_like(frames[..., 0, :, :])
    if point is None:
        return frame
    xp = namespace(frame, point)
    at = read_point(frame[..., 0, :], point)
    place = rotate(frame[..., :3], at + xp.zeros_like(frame[..., 3])) + frame[..., 3]
    return xp.concatenate([frame[..., :3], place[..., None]], axis=-1)


def read_point(like: Array, point: Array) -> Array:
    """Return ``point`` as a checked array (3,) or (..., 3), where ``like`` is (..., n); None where
    it is None.
    """
    if point is None:
        return None
    xp = namespace(like, point)
    if xp is np:
        at = read_array("point", point).astype(np.float64, copy=False)
    else:
        at = xp.asarray(point, like.dtype)
    shapes = dict.fromkeys([(3,), (*like.shape[:-1], 3)])
    if at.shape not in shapes:
        problem = f"has shape {at.shape}, not {' or '.join(map(str, shapes))}"
        raise InvalidArgumentError("point", problem, remedy="give x, y, z in the link's frame [m]")
    return at


def jacobian_at(
    tree: RigidTree,
    bodies: Bodies,
    motions: Motions,
    index: int,
    place: Array,
) -> Array:
    """Return the Jacobian (..., 6, dof) of a link's point at ``place`` (..., 3) in the world, J G
    of coupled joints.
    """
    xp = namespace(place)
    body = tree.link_bodies[index]
    linear = motions.linear + cross(motions.angular, place[..., None, :])
    columns = xp.concatenate([linear, motions.angular], axis=-1)
    if body >= 0:
        moved = bodies.moves[body][:, None] > 0
    else:
        moved = xp.asarray(False)
    return tree.efforts(
        xp.moveaxis(
            xp.where(moved, columns, xp.zeros_like(columns)),
            -1,
            -2,
        )
    )


def rate_at(
    tree: RigidTree,
    velocities: Velocities,
    index: int,
    place: Array,
) -> Array:
    """Return J' q' (..., 6) of a link's point at ``place`` (..., 3) in the world."""
    xp = namespace(place)
    body = tree.link_bodies[index]
    if body < 0:
        return xp.concatenate([xp.zeros_like(place)] * 2, axis=-1)
    v, w, linear, angular = (leaf[..., body, :] for leaf in velocities)
    return xp.concatenate(
        [linear + cross(angular, place) + cross(w, v + cross(w, place)), angular], axis=-1
    )
