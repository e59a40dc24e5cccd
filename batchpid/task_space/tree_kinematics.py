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
Jacobians are (linear, angular). Rows of robots are the last axis, along which processors make
vectors: positions are (dof, rows), a vector is three arrays of that shape. Constants of the bodies
have a last axis of 1, or of the rows. A row does not depend on the others, under NumPy to the last
bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.arrays.elementwise import namespace
from batchpid.checks import instance, is_traced, read_array
from batchpid.errors import InvalidArgumentError
from batchpid.task_space.frames import (
    Vector,
    added,
    components,
    crossed,
    rotate,
    scaled,
)
from batchpid.task_space.rigid_tree import MAKE_TREE, Bodies, RigidTree

Motions = tuple[Array, Vector, Vector]
"""Frames of the bodies (dof, 3, 4, rows) at given joint positions; and motions per rate of each joint
in the world: the velocity of the body's point that is at the origin of the world, and its angular
velocity; components (dof, rows).
"""
Velocities = tuple[Vector, Vector, Vector, Vector]
"""Velocities of the bodies, linear and angular, and their accelerations at q'' = 0, as fields about the
origin; components (dof, rows).
"""


def prepared(tree: RigidTree, **arrays: Array) -> tuple[list[Array], Bodies, ArrayModule]:
    """Return checked arrays (..., dof) in one dtype, the tree's bodies in it, and their
    namespace.
    """
    instance("tree", tree, RigidTree, MAKE_TREE)
    xp = namespace(*arrays.values())
    checked: list[Array] = []
    for name, value in arrays.items():
        array = value
        if xp is np and not is_traced(value):
            array = read_array(name, value).astype(np.float64, copy=False)
        # All are for the same envs.
        like = checked[0] if checked else array
        shape = (*like.shape[:-1], tree.dof)
        if array.shape != shape:
            remedy = f"the last axis counts the joints {', '.join(tree.joint_names)}"
            raise InvalidArgumentError(name, f"has shape {array.shape}, not {shape}", remedy=remedy)
        checked.append(array)
    if xp is np:
        return checked, tree.bodies, xp
    dtype = xp.result_type(*checked)
    return (
        [a.astype(dtype) for a in checked],
        Bodies(*(xp.asarray(leaf, dtype) for leaf in tree.bodies)),
        xp,
    )


def check_masses(tree: RigidTree) -> None:
    """Raise InvalidArgumentError for a joint that moves no mass and has no armature: its mass
    matrix is singular.
    """
    # A leader moves the masses of its followers, too.
    moved = tree.bodies.moves.T @ tree.bodies.mass[:-1, 0] + tree.bodies.armature
    moved = tree.coupling.of_all(tree.coupling.reduced_damping(moved))
    for joint, kg in zip(tree.joint_names, moved, strict=True):
        if not kg > 0:
            problem = "has a joint that moves no mass and has no armature"
            raise InvalidArgumentError(
                "tree", problem, joint=joint, remedy="give one of its links a mass"
            )


_SHIFT = np.array([0.0, 0.0, 0.0, 1.0]).reshape(1, 4, 1)
"""Share of a frame's columns that shift with the frame above."""


def _turned(frame: Array, inner: Array) -> Array:
    """Return the frames ``inner`` (3, 4, rows), given in ``frame``, where that is given."""
    return (
        frame[:, :1] * inner[:1]
        + frame[:, 1:2] * inner[1:2]
        + frame[:, 2:3] * inner[2:3]
        + frame[:, 3:] * _SHIFT.astype(inner.dtype)
    )


def motions_of(
    tree: RigidTree,
    bodies: Bodies,
    qpos: Array,
    xp: ArrayModule,
) -> Motions:
    """Return the frames of the bodies and the motions of the joints at ``qpos`` (dof, rows)."""
    x, y, z, place = (bodies.at_zero[:, :, k] for k in range(4))
    slides = bodies.slides[:, None]
    q = qpos[:, None]
    cosine = xp.cos((1 - slides) * q)
    sine = xp.sin((1 - slides) * q)
    columns = x + 0 * q, cosine * y + sine * z, cosine * z - sine * y, place + slides * q * x
    local = xp.stack(columns, axis=2)
    base = xp.broadcast_to(xp.eye(3, 4, dtype=q.dtype)[None, ..., None], local[:1].shape)
    # The base is the last row, whose index is -1.
    frames = xp.concatenate([local, base])
    if xp is np:
        for joint, above in enumerate(tree.body_parents):
            frames[joint] = _turned(frames[above], frames[joint])
    else:
        from jax import lax

        def placed(frames: Any, at: Any) -> Any:
            joint, above = at
            return frames.at[joint].set(_turned(frames[above], frames[joint])), None

        # A loop, since XLA would compute all frames above again for each frame.
        joints = xp.arange(tree.dof), xp.asarray(tree.body_parents)
        frames, _ = lax.scan(placed, frames, joints)
    frames = frames[:-1]
    axis = frames[:, 0, 0], frames[:, 1, 0], frames[:, 2, 0]
    origin = frames[:, 0, 3], frames[:, 1, 3], frames[:, 2, 3]
    turning = scaled(axis, 1 - bodies.slides)
    moving = added(crossed(origin, turning), scaled(axis, bodies.slides))
    return frames, moving, turning


def velocities_of(
    tree: RigidTree,
    bodies: Bodies,
    motions: Motions,
    qvel: Array,
    xp: ArrayModule,
    turning: Array = None,
) -> Velocities:
    """Return the velocities of the bodies, and their accelerations at q'' = 0, on a base that turns
    at ``turning`` (rows, 3).
    """
    linear, angular = (scaled(motion, qvel) for motion in motions[1:])
    # Velocities about the world's origin add up along the chain without a shift.
    sums = summed(tree, bodies, (*linear, *angular), xp, outwards=True)
    v, w = (sums[0], sums[1], sums[2]), (sums[3], sums[4], sums[5])
    if turning is not None:
        w = added(w, components(turning[None]))
    rates = *added(crossed(w, linear), crossed(v, angular)), *crossed(w, angular)
    sums = summed(tree, bodies, rates, xp, outwards=True)
    return (v, w, (sums[0], sums[1], sums[2]), (sums[3], sums[4], sums[5]))


def summed(
    tree: RigidTree,
    bodies: Bodies,
    parts: Sequence[Array],
    xp: ArrayModule,
    *,
    outwards: bool,
) -> list[Array]:
    """Return the sums of each of ``parts`` (dof, rows) over the joints between the base and each
    body, or over the bodies that each joint moves.
    """
    table = xp.stack(parts, axis=1)
    if xp is not np:
        moves = bodies.moves if outwards else bodies.moves.T
        table = xp.tensordot(moves, table, 1, precision="highest")
    else:
        # A library's product would round by the number of rows.
        pairs = [(joint, above) for joint, above in enumerate(tree.body_parents) if above >= 0]
        for joint, above in pairs if outwards else reversed(pairs):
            if outwards:
                table[joint] += table[above]
            else:
                table[above] += table[joint]
    return [table[:, k] for k in range(len(parts))]


def tool_frame(
    tree: RigidTree,
    bodies: Bodies,
    motions: Motions,
    index: int,
    point: Array,
) -> Array:
    """Return the frame (rows, 3, 4) of a link, with its origin at ``point`` (3,) or (rows, 3) of
    the link.
    """
    frames, *_ = motions
    xp = namespace(frames)
    body = tree.link_bodies[index]
    frame = bodies.link_frames[index]
    # A link of the base does not move, but has a frame in each row.
    frame = frame + xp.zeros_like(frames[0]) if body < 0 else _turned(frames[body], frame)
    frame = xp.moveaxis(frame, -1, 0)
    if point is None:
        return frame
    at = xp.broadcast_to(xp.asarray(point, dtype=frame.dtype), frame[..., 3].shape)
    place = rotate(frame[..., :3], at) + frame[..., 3]
    return xp.concatenate([frame[..., :3], place[..., None]], axis=-1)


def read_point(like: Array, point: Array) -> Array:
    """Return ``point`` as a checked array (3,) or (..., 3), where ``like`` is (..., n); None where
    it is None.
    """
    if point is None:
        return None
    xp = namespace(like, point)
    at = xp.asarray(read_array("point", point, traced=True), like.dtype)
    if at.shape not in ((3,), (*like.shape[:-1], 3)):
        problem = f"has shape {at.shape}, not (3,) or {(*like.shape[:-1], 3)}"
        raise InvalidArgumentError("point", problem, remedy="give x, y, z in the link's frame [m]")
    return at


def jacobian_at(
    tree: RigidTree,
    bodies: Bodies,
    motions: Motions,
    index: int,
    place: Array,
) -> Array:
    """Return the Jacobian (rows, 6, dof) of a link's point at ``place`` (rows, 3) in the world, J G
    of coupled joints.
    """
    xp = namespace(place)
    body = tree.link_bodies[index]
    _, linear, angular = motions
    linear = added(linear, crossed(angular, components(place[None])))
    twists = xp.moveaxis(xp.stack((*linear, *angular)), -1, 0)
    if body < 0:
        return xp.zeros_like(twists)
    return tree.efforts(xp.where(bodies.moves[body][None, None] > 0, twists, 0.0 * twists))


def rate_at(
    tree: RigidTree,
    velocities: Velocities,
    index: int,
    place: Array,
) -> Array:
    """Return J' q' (rows, 6) of a link's point at ``place`` (rows, 3) in the world."""
    xp = namespace(place)
    body = tree.link_bodies[index]
    if body < 0:
        return xp.concatenate([xp.zeros_like(place)] * 2, axis=-1)
    v, w, linear, angular = ((x[body], y[body], z[body]) for x, y, z in velocities)
    at = components(place)
    around = added(crossed(angular, at), crossed(w, added(v, crossed(w, at))))
    return xp.stack((*added(linear, around), *angular), axis=-1)
