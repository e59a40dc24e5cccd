r"""Dynamics of a kinematic tree: M(q) q'' + h(q, q') = tau, without friction and damping.

All quantities are in the axes of the world and about its origin. With the motions s_j = (v_j, w_j) of the joints, and
for all that joint j moves the mass m, the first moment c and the inertia tensor I, the momenta under s_j and the mass
matrix are (composite rigid bodies; R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, section 6.2)::

    linear  l_j = m v_j + w_j x c        angular  k_j = I w_j + c x v_j
    M_ij = M_ji = s_i . (l_j, k_j)   for a joint i that moves joint j, or is joint j; else 0;   M_jj += armature

and the bias h, gravity and the Coriolis and centrifugal forces, is the sum of the rates of momentum of the bodies at
q'' = 0, less their weight (recursive Newton-Euler algorithm, section 5.3). With the acceleration a of the center of
mass r of a body, its inertia tensor I about it, its angular velocity w and its angular acceleration w'::

    f = m (a - g)      n = I w' + w x I w + r x f      h_j = s_j . (sum of (f, n) of all that joint j moves)

The results for coupled joints are reduced to their leaders, G^T M G and G^T h (:mod:`batchpid.motors.coupling`).
"""

from __future__ import annotations

from typing import Any

from batchpid.errors import InvalidArgumentError
from batchpid.task_space import native_rows
from batchpid.task_space.frames import cross, multiply, rotate
from batchpid.task_space.kinematic_tree import Bodies, KinematicTree
from batchpid.task_space.symmetric import product, quiet, solve
from batchpid.task_space.tree_kinematics import (
    Motions,
    Velocities,
    from_base,
    from_tips,
    motions_of,
    prepared,
    velocities_of,
)


def mass_matrix(tree: KinematicTree, qpos: Any) -> Any:
    """Return the mass matrices (..., dof, dof) [kg m^2 or kg] at ``qpos`` (..., dof), armature included.

    Raises
    ------
    InvalidArgumentError
        The shape is wrong.
    """
    (q,), bodies, xp = prepared(tree, qpos=qpos)
    if (found := native_rows.kinematics(tree, ("mass_matrix",), q)) is not None:
        return found[0]
    with quiet():
        return mass_matrix_of(tree, bodies, motions_of(tree, bodies, q, xp), xp)


def bias(tree: KinematicTree, qpos: Any, qvel: Any) -> Any:
    """Return h(q, q') (..., dof) [N m or N]: the efforts that cancel gravity and Coriolis and centrifugal forces.

    Raises
    ------
    InvalidArgumentError
        A shape is wrong.
    """
    (q, v), bodies, xp = prepared(tree, qpos=qpos, qvel=qvel)
    if (found := native_rows.kinematics(tree, ("bias",), q, v)) is not None:
        return found[0]
    with quiet():
        motions = motions_of(tree, bodies, q, xp)
        return effort_of(tree, bodies, motions, velocities_of(tree, motions, v, xp), xp)


def gravity(tree: KinematicTree, qpos: Any) -> Any:
    """Return the efforts (..., dof) [N m or N] that hold the robot at ``qpos`` (..., dof): h(q, 0)."""
    return bias(tree, qpos, 0 * qpos if hasattr(qpos, "shape") else [0 * entry for entry in qpos])


def inverse_dynamics(tree: KinematicTree, qpos: Any, qvel: Any, qacc: Any) -> Any:
    """Return the efforts (..., dof) [N m or N] of the accelerations ``qacc`` (..., dof): M q'' + h.

    Raises
    ------
    InvalidArgumentError
        A shape is wrong.
    """
    (q, v, a), bodies, xp = prepared(tree, qpos=qpos, qvel=qvel, qacc=qacc)
    if (found := native_rows.kinematics(tree, ("mass_matrix", "bias"), q, v)) is not None:
        with quiet():
            return product(found[0], tree.independent * a) + found[1]
    a = tree.rates(a)
    with quiet():
        motions = motions_of(tree, bodies, q, xp)
        still = velocities_of(tree, motions, v, xp)
        moving = still._replace(
            linear_rate=still.linear_rate + from_base(tree, motions.linear * a[..., None], xp),
            angular_rate=still.angular_rate + from_base(tree, motions.angular * a[..., None], xp),
        )
        return tree.efforts(effort_of(tree, bodies, motions, moving, xp) + bodies.armature * a)


def forward_dynamics(tree: KinematicTree, qpos: Any, qvel: Any, effort: Any) -> Any:
    """Return the accelerations (..., dof) [rad/s^2 or m/s^2] under ``effort`` (..., dof): M^-1 (tau - h).

    Raises
    ------
    InvalidArgumentError
        A shape is wrong, or a joint moves no mass and has no armature.
    """
    check_masses(tree)
    (q, v, u), bodies, xp = prepared(tree, qpos=qpos, qvel=qvel, effort=effort)
    u = tree.efforts(u)
    if (found := native_rows.kinematics(tree, ("mass_matrix", "bias"), q, v)) is not None:
        with quiet():
            return tree.rates(solve(found[0], (u - found[1])[..., None])[..., 0])
    with quiet():
        motions = motions_of(tree, bodies, q, xp)
        force = effort_of(tree, bodies, motions, velocities_of(tree, motions, v, xp), xp)
        return tree.rates(solve(mass_matrix_of(tree, bodies, motions, xp), (u - force)[..., None])[..., 0])


def check_masses(tree: KinematicTree) -> None:
    """Raise InvalidArgumentError for a joint that moves no mass and has no armature: its mass matrix is singular."""
    moved = tree.bodies.moves.T @ tree.bodies.mass[:, 0] + tree.bodies.armature
    moved = tree.coupling.of_all(tree.coupling.reduced_damping(moved))
    for joint, kg in zip(tree.joint_names, moved, strict=True):
        if not kg > 0:
            problem = "has a joint that moves no mass and has no armature"
            raise InvalidArgumentError("tree", problem, joint=joint, remedy="give one of its links a mass")


def mass_matrix_of(tree: KinematicTree, bodies: Bodies, motions: Motions, xp: Any) -> Any:
    """Return the mass matrices (..., dof, dof) at given motions of the joints."""
    turn = motions.frames[..., :3]
    center = rotate(turn, bodies.center) + motions.frames[..., 3]
    moment = bodies.mass * center
    square = (moment * center).sum(-1)[..., None, None] * xp.eye(3, dtype=center.dtype)
    tensor = _in_world(turn, bodies.tensor, xp) + square - moment[..., :, None] * center[..., None, :]
    packed = xp.concatenate([moment, tensor.reshape(*tensor.shape[:-2], 9)], axis=-1)
    composite = from_tips(tree, packed, xp)
    mass = from_tips(tree, bodies.mass, xp)
    moment, tensor = composite[..., :3], composite[..., 3:].reshape(tensor.shape)
    v, w = motions.linear, motions.angular
    linear = mass * v + cross(w, moment)
    angular = rotate(tensor, w) + cross(moment, v)
    s, momentum = xp.concatenate([v, w], axis=-1), xp.concatenate([linear, angular], axis=-1)
    table = (s[..., :, None, :] * momentum[..., None, :, :]).sum(-1)
    above = xp.swapaxes(bodies.moves, 0, 1) > 0
    rest = xp.where(bodies.moves > 0, xp.swapaxes(table, -1, -2), xp.zeros_like(table))
    matrix = xp.where(above, table, rest)
    matrix = matrix + bodies.armature * xp.eye(tree.dof, dtype=matrix.dtype)
    return xp.asarray(tree.coupling.mass_matrix(matrix), dtype=matrix.dtype)


def effort_of(tree: KinematicTree, bodies: Bodies, motions: Motions, rates: Velocities, xp: Any) -> Any:
    """Return the efforts (..., dof) of given velocities and accelerations of the bodies, armature left out."""
    turn = motions.frames[..., :3]
    center = rotate(turn, bodies.center) + motions.frames[..., 3]
    tensor = _in_world(turn, bodies.tensor, xp)
    v, w = rates.linear, rates.angular
    acceleration = rates.linear_rate + cross(rates.angular_rate, center) + cross(w, v + cross(w, center))
    force = bodies.mass * (acceleration - bodies.gravity)
    spin = rotate(tensor, rates.angular_rate) + cross(w, rotate(tensor, w))
    wrench = from_tips(tree, xp.concatenate([force, spin + cross(center, force)], axis=-1), xp)
    return tree.efforts((xp.concatenate([motions.linear, motions.angular], axis=-1) * wrench).sum(-1))


def _in_world(turn: Any, tensor: Any, xp: Any) -> Any:
    """Return R I R^T."""
    return multiply(multiply(turn, tensor), xp.swapaxes(turn, -1, -2))
