r"""Dynamics of a rigid tree: M(q) q'' + h(q, q') = tau, without friction and damping.

All quantities are in the axes of the world and about its origin. Joint j has the motion s_j = (v_j,
w_j). All bodies that it moves together have the mass m, the first moment c and the inertia tensor
I. Momenta under s_j and mass matrix are (composite rigid bodies; R. Featherstone, Rigid Body
Dynamics Algorithms, Springer, 2008, section 6.2)::

    linear  l_j = m v_j + w_j x c        angular  k_j = I w_j + c x v_j
    M_ij = M_ji = s_i . (l_j, k_j)   for a joint i that moves joint j, or is joint j; else 0;   M_jj += armature

The bias h (gravity, Coriolis and centrifugal forces) is the sum of the rates of momentum of the
bodies at q'' = 0, less their weight (recursive Newton-Euler algorithm, section 5.3). For a body
with the center of mass r, a is the acceleration of r, I the inertia tensor about r, w the angular
velocity and w' the angular acceleration::

    f = m (a - g)      n = I w' + w x I w + r x f      h_j = s_j . (sum of (f, n) of the bodies that j moves)

On a floating base (index b; index j for the joints) M and h of the joints are Schur complements::

    M = M_jj - M_jb M_bb^-1 M_bj        h = h_j - M_jb M_bb^-1 h_b

where the columns of M_bj are the momenta (l_j, k_j), and M_bb and h_b belong to all bodies
together. Gravity, and the velocity and acceleration of the base's origin, cancel. The rate at which
the base turns remains in h.

The results for coupled joints are reduced to their leaders, G^T M G and G^T h
(:mod:`batchpid.motors.coupling`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.errors import InvalidArgumentError
from batchpid.task_space.frames import cross, multiply, rotate
from batchpid.task_space.rigid_tree import Bodies, RigidTree
from batchpid.task_space.symmetric import solve
from batchpid.task_space.tree_kinematics import (
    Motions,
    Velocities,
    from_tips,
)


def check_masses(tree: RigidTree) -> None:
    """Raise InvalidArgumentError for a joint that moves no mass and has no armature: its mass
    matrix is singular.
    """
    # A leader moves the masses of its followers, too.
    moved = tree.bodies.moves.T @ tree.bodies.mass[:, 0] + tree.bodies.armature
    moved = tree.coupling.of_all(tree.coupling.reduced_damping(moved))
    for joint, kg in zip(tree.joint_names, moved, strict=True):
        if not kg > 0:
            problem = "has a joint that moves no mass and has no armature"
            raise InvalidArgumentError(
                "tree", problem, joint=joint, remedy="give one of its links a mass"
            )


class _Composite(NamedTuple):
    """The bodies that each joint moves, as one rigid body, and the momenta under the motions of the
    joints.
    """

    mass: Array
    """(..., dof, 1)"""
    moment: Array
    """First moment about the origin (..., dof, 3)."""
    tensor: Array
    """Inertia tensor about the origin (..., dof, 3, 3)."""
    momenta: Array
    """Linear and angular (..., dof, 6)."""


def _composite(
    tree: RigidTree,
    bodies: Bodies,
    motions: Motions,
    xp: ArrayModule,
) -> _Composite:
    turn = motions.frames[..., :3]
    center = rotate(turn, bodies.center) + motions.frames[..., 3]
    moment = bodies.mass * center
    tensor = _in_world(turn, bodies.tensor, xp) + _about_origin(moment, center, xp)
    # One pass from the tips for both: sums over everything that a joint moves.
    packed = xp.concatenate([moment, tensor.reshape(*tensor.shape[:-2], 9)], axis=-1)
    composite = from_tips(tree, packed, xp)
    mass = from_tips(tree, bodies.mass, xp)
    moment = composite[..., :3]
    tensor = composite[..., 3:].reshape(tensor.shape)
    v, w = motions.linear, motions.angular
    linear = mass * v + cross(w, moment)
    angular = rotate(tensor, w) + cross(moment, v)
    return _Composite(mass, moment, tensor, xp.concatenate([linear, angular], axis=-1))


def _about_origin(moment: Array, center: Array, xp: ArrayModule) -> Array:
    """Return the inertia tensors (..., 3, 3) about the origin of points with first moments
    ``moment``.
    """
    square = (moment * center).sum(-1)[..., None, None] * xp.eye(3, dtype=center.dtype)
    return square - moment[..., :, None] * center[..., None, :]


def _of_base(
    tree: RigidTree,
    bodies: Bodies,
    all_: _Composite,
    xp: ArrayModule,
) -> Array:
    """Return M_bb (..., 6, 6), linear parts first: the momenta of the whole robot under the motions
    of its base.
    """
    # Composites of the joints on the base contain all bodies but the base itself.
    roots = [joint for joint, above in enumerate(tree.body_parents) if above < 0]
    part = bodies.base_mass * bodies.base_center
    mass = all_.mass[..., roots, :].sum(-2) + bodies.base_mass
    moment = all_.moment[..., roots, :].sum(-2) + part
    tensor = (
        all_.tensor[..., roots, :, :].sum(-3)
        + bodies.base_tensor
        + _about_origin(part, bodies.base_center, xp)
    )
    eye = xp.eye(3, dtype=moment.dtype)
    # The matrix c x.
    columns = [cross(moment, eye[axis] + xp.zeros_like(moment)) for axis in range(3)]
    crossed = xp.stack(columns, axis=-1)
    zero = xp.zeros_like(crossed)
    upper = xp.concatenate([mass[..., None] * eye + zero, -crossed], axis=-1)
    return xp.concatenate([upper, xp.concatenate([crossed, tensor + zero], axis=-1)], axis=-2)


def mass_matrix_of(
    tree: RigidTree,
    bodies: Bodies,
    motions: Motions,
    xp: ArrayModule,
) -> Array:
    """Return the mass matrices (..., dof, dof) at given motions of the joints."""
    all_ = _composite(tree, bodies, motions, xp)
    s = xp.concatenate([motions.linear, motions.angular], axis=-1)
    table = (s[..., :, None, :] * all_.momenta[..., None, :, :]).sum(-1)
    above = xp.swapaxes(bodies.moves, 0, 1) > 0
    # Only entries of joints on one branch differ from 0: one of them moves the other.
    rest = xp.where(
        bodies.moves > 0,
        xp.swapaxes(table, -1, -2),
        xp.zeros_like(table),
    )
    matrix = xp.where(above, table, rest)
    if not tree.fixed_base:
        # The free base yields to each joint's momentum.
        falls = solve(_of_base(tree, bodies, all_, xp), xp.swapaxes(all_.momenta, -1, -2))
        matrix = matrix - (
            all_.momenta[..., :, None, :] * xp.swapaxes(falls, -1, -2)[..., None, :, :]
        ).sum(-1)
    matrix = matrix + bodies.armature * xp.eye(tree.dof, dtype=matrix.dtype)
    return xp.asarray(tree.coupling.mass_matrix(matrix), dtype=matrix.dtype)


def effort_of(
    tree: RigidTree,
    bodies: Bodies,
    motions: Motions,
    rates: Velocities,
    xp: ArrayModule,
    turning: Array = None,
) -> Array:
    """Return the efforts (..., dof) of given velocities and accelerations of the bodies, without
    armature.

    A floating base turns at ``turning`` (..., 3) [rad/s]; ``rates`` must include this rotation.
    """
    turn = motions.frames[..., :3]
    center = rotate(turn, bodies.center) + motions.frames[..., 3]
    tensor = _in_world(turn, bodies.tensor, xp)
    v, w = rates.linear, rates.angular
    acceleration = (
        rates.linear_rate + cross(rates.angular_rate, center) + cross(w, v + cross(w, center))
    )
    # A free base falls with its joints: gravity cancels there.
    force = bodies.mass * (acceleration - bodies.gravity if tree.fixed_base else acceleration)
    spin = rotate(tensor, rates.angular_rate) + cross(w, rotate(tensor, w))
    wrench = from_tips(
        tree,
        xp.concatenate([force, spin + cross(center, force)], axis=-1),
        xp,
    )
    effort = (xp.concatenate([motions.linear, motions.angular], axis=-1) * wrench).sum(-1)
    if not tree.fixed_base:
        all_ = _composite(tree, bodies, motions, xp)
        on_base: Array = sum(
            wrench[..., joint, :] for joint, above in enumerate(tree.body_parents) if above < 0
        )
        if turning is not None:
            part = bodies.base_mass * cross(
                turning, cross(turning, bodies.base_center + xp.zeros_like(turning))
            )
            torque = cross(turning, rotate(bodies.base_tensor, turning)) + cross(
                bodies.base_center + xp.zeros_like(part), part
            )
            on_base = on_base + xp.concatenate([part, torque], axis=-1)
        falls = solve(_of_base(tree, bodies, all_, xp), on_base[..., None])[..., 0]
        effort = effort - (all_.momenta * falls[..., None, :]).sum(-1)
    return tree.efforts(effort)


def _in_world(turn: Any, tensor: Array, xp: ArrayModule) -> Array:
    """Return R I R^T."""
    return multiply(multiply(turn, tensor), xp.swapaxes(turn, -1, -2))
