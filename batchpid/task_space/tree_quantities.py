r"""Poses, Jacobians, mass matrices and forces of a kinematic tree: natively where that is possible,
else by the equations below and in :mod:`batchpid.task_space.tree_kinematics`.

Arrays have any leading axes. Every function raises InvalidArgumentError for an unknown link, or an
array of a wrong shape.

The dynamics are M(q) q'' + h(q, q') = tau, without friction and damping. All quantities are in the
axes of the world and about its origin. Joint j has the motion s_j = (v_j, w_j). All bodies that it
moves together have the mass m, the first moment c and the inertia tensor I. Momenta under s_j and
mass matrix are (composite rigid bodies; R. Featherstone, Rigid Body Dynamics Algorithms, Springer,
2008, section 6.2)::

    linear  p_j = m v_j + w_j x c        angular  k_j = I w_j + c x v_j
    M_ij = M_ji = s_i . (p_j, k_j)   for a joint i that moves joint j, or is joint j; else 0;   M_jj += armature

The bias h (gravity, Coriolis and centrifugal forces) is the sum of the rates of momentum of the
bodies at q'' = 0, less their weight (recursive Newton-Euler algorithm, section 5.3). A body with the
velocity (v, w) and the acceleration (A_o, A_w), as fields about the origin, has momenta (p, k) under
its velocity, and (p', k') under its acceleration less gravity, (A_o - g, A_w)::

    f = p' + w x p      n = k' + w x k + v x p      h_j = s_j . (sum of (f, n) of the bodies that j moves)

On a floating base (index b; index j for the joints) M and h of the joints are Schur complements::

    M = M_jj - M_jb M_bb^-1 M_bj        h = h_j - M_jb M_bb^-1 h_b

where the columns of M_bj are the momenta (p_j, k_j), and M_bb and h_b belong to all bodies
together. Gravity, and the velocity and acceleration of the base's origin, cancel. The rate at which
the base turns remains in h.

The results for coupled joints are reduced to their leaders, G^T M G and G^T h
(:mod:`batchpid.motors.coupling`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.arrays.elementwise import namespace
from batchpid.task_space import native_rows
from batchpid.task_space.frames import (
    Inertias,
    added,
    components,
    crossed,
    dotted,
    inertias_in,
    momenta,
    pose_of,
    scaled,
)
from batchpid.task_space.rigid_tree import Bodies, RigidTree
from batchpid.task_space.symmetric import gram, product, quiet, solve
from batchpid.task_space.tree_kinematics import (
    Motions,
    Velocities,
    check_masses,
    jacobian_at,
    motions_of,
    prepared,
    rate_at,
    read_point,
    summed,
    tool_frame,
    velocities_of,
)


def _of_bodies(bodies: Bodies, frames: Array) -> Inertias:
    return inertias_in(bodies.mass[:-1], bodies.center[:-1], bodies.tensor[:-1], frames)


def _on_base(tree: RigidTree, part: Array) -> Array:
    """Return the sum (rows,) over the joints on the base, of numbers (dof, rows)."""
    return part[np.array(tree.body_parents) < 0].sum(0)


def _of_base(
    tree: RigidTree,
    bodies: Bodies,
    whole: Inertias,
    xp: ArrayModule,
) -> tuple[Inertias, Array]:
    """Return the inertias of the base (1, rows), and M_bb (rows, 6, 6), linear parts first: the
    momenta of the whole robot under the motions of its base.
    """
    frame = xp.eye(3, 4, dtype=bodies.mass.dtype)[None, ..., None]
    base = inertias_in(bodies.mass[-1:], bodies.center[-1:], bodies.tensor[-1:], frame)
    # Composites of the joints on the base contain all bodies but the base itself.
    robot = [
        _on_base(tree, part)[None] + of_base for part, of_base in zip(whole, base, strict=True)
    ]
    unit = xp.eye(6, dtype=bodies.mass.dtype)[..., None]
    p, k = momenta(robot, (unit[0], unit[1], unit[2]), (unit[3], unit[4], unit[5]))
    return base, _by_row(xp.stack((*p, *k)), xp)


def _by_row(table: Array, xp: ArrayModule) -> Array:
    """Return ``table`` (..., rows) as (rows, ...)."""
    return xp.moveaxis(table, -1, 0)


def mass_matrix_of(
    tree: RigidTree,
    bodies: Bodies,
    motions: Motions,
    xp: ArrayModule,
) -> Array:
    """Return the mass matrices (rows, dof, dof) at given motions of the joints."""
    frames, linear, angular = motions
    whole = summed(tree, bodies, _of_bodies(bodies, frames), xp, outwards=False)
    p, k = momenta(whole, linear, angular)
    twists = [part[:, None] for part in (*linear, *angular)]
    table = dotted(twists, [part[None] for part in (*p, *k)])
    # Only entries of joints on one branch differ from 0: one of them moves the other.
    moves = bodies.moves[..., None] > 0
    rest = xp.where(moves, xp.swapaxes(table, 0, 1), xp.zeros_like(table))
    matrix = _by_row(xp.where(xp.swapaxes(moves, 0, 1), table, rest), xp)
    if not tree.fixed_base:
        # The free base yields to each joint's momentum.
        of_joints = _by_row(xp.stack((*p, *k)), xp)
        matrix = matrix - gram(of_joints, solve(_of_base(tree, bodies, whole, xp)[1], of_joints))
    matrix = matrix + bodies.armature[None] * xp.eye(tree.dof, dtype=matrix.dtype)[None]
    return xp.asarray(tree.coupling.mass_matrix(matrix), dtype=matrix.dtype)


def effort_of(
    tree: RigidTree,
    bodies: Bodies,
    motions: Motions,
    rates: Velocities,
    xp: ArrayModule,
    turning: Array = None,
) -> Array:
    """Return the efforts (rows, dof) of given velocities and accelerations of the bodies, without
    armature.

    A floating base turns at ``turning`` (rows, 3) [rad/s]; ``rates`` must include this rotation.
    """
    frames, linear, angular = motions
    v, w, acceleration, turning_rate = rates
    inertias = _of_bodies(bodies, frames)
    # A free base falls with its joints: gravity cancels there.
    if tree.fixed_base:
        weight = -bodies.gravity[:, None]
        acceleration = added(acceleration, (weight[0], weight[1], weight[2]))
    p, k = momenta(inertias, v, w)
    p_rate, k_rate = momenta(inertias, acceleration, turning_rate)
    force = added(p_rate, crossed(w, p))
    torque = added(k_rate, added(crossed(w, k), crossed(v, p)))
    wrench = summed(tree, bodies, (*force, *torque), xp, outwards=False)
    effort = dotted((*linear, *angular), wrench).T
    if not tree.fixed_base:
        whole = summed(tree, bodies, inertias, xp, outwards=False)
        base, matrix = _of_base(tree, bodies, whole, xp)
        on_base = xp.stack([_on_base(tree, part) for part in wrench], axis=-1)
        if turning is not None:
            turn = components(turning[None])
            p, k = momenta(base, scaled(turn, 0.0), turn)
            on_base = on_base + xp.stack((*crossed(turn, p), *crossed(turn, k)), axis=-1)[0]
        p, k = momenta(whole, linear, angular)
        falls = solve(matrix, on_base[..., None])
        effort = effort - gram(_by_row(xp.stack((*p, *k)), xp), falls)[..., 0]
    return tree.efforts(effort)


def evaluated(
    tree: RigidTree,
    names: tuple[str, ...],
    qpos: Array,
    qvel: Array = None,
    link: str | None = None,
    point: Array = None,
    *,
    bodies: Bodies | None = None,
    turning: Array = None,
) -> dict[str, Array]:
    """Return quantities by name: "pose", "jacobian" and "jacobian_rate" of a ``point`` of ``link``,
    "mass_matrix" and "bias"; "jacobian_rate" and "bias" need ``qvel``.
    """
    inputs = {"qpos": qpos} if qvel is None else {"qpos": qpos, "qvel": qvel}
    (q, *rates), nominal, xp = prepared(tree, **inputs)
    v = rates[0] if rates else None
    index = 0 if link is None else tree.index(link)
    point = read_point(q, point)
    if bodies is None:
        native = native_rows.kinematics(
            tree,
            names,
            q,
            v,
            index,
            point,
        )
        if native is not None:
            return native
    # The definition, for JAX, for varied bodies, and where no extension was built.
    leading = q.shape[:-1]

    def by_rows(rows: Array) -> Array:
        return rows if rows is None or rows.ndim == 1 else rows.reshape(-1, rows.shape[-1])

    # Rows of robots are the last axis, along which NumPy and XLA make vectors.
    columns = q.reshape(-1, tree.dof).T
    parts = [
        xp.moveaxis(leaf, 0, -1) if leaf.ndim > one.ndim else leaf[..., None]
        for leaf, one in zip(bodies or nominal, nominal, strict=True)
    ]
    of_robots = Bodies(*parts)._replace(moves=nominal.moves)
    of_robots = of_robots._replace(slides=nominal.slides, mass=of_robots.mass[:, 0])
    place, turning = by_rows(point), by_rows(turning)
    with quiet():
        motions = motions_of(tree, of_robots, columns, xp)
        velocities: Any = None
        if v is not None:
            speeds = v.reshape(-1, tree.dof).T
            velocities = velocities_of(
                tree,
                of_robots,
                motions,
                speeds,
                xp,
                turning,
            )
        tool = tool_frame(tree, of_robots, motions, index, place)
        place = tool[..., 3]
        by_name = {
            "pose": lambda: pose_of(tool),
            "jacobian": lambda: jacobian_at(tree, of_robots, motions, index, place),
            "jacobian_rate": lambda: rate_at(tree, velocities, index, place),
            "mass_matrix": lambda: mass_matrix_of(tree, of_robots, motions, xp),
            "bias": lambda: effort_of(
                tree,
                of_robots,
                motions,
                velocities,
                xp,
                turning,
            ),
        }
        results = {name: by_name[name]() for name in names}
    return {name: rows.reshape(*leading, *rows.shape[1:]) for name, rows in results.items()}


def link_poses(
    tree: RigidTree,
    qpos: Array,
    links: Sequence[str] | None = None,
    *,
    point: Array = None,
) -> Array:
    """Return the poses (..., links, 7) of ``links``, by default all, at ``qpos`` (..., dof) [rad or
    m].

    With a ``point`` (3,) in the frame of the links [m], the positions in them are those of the point.
    """
    prepared(tree, qpos=qpos)
    names = tree.links if links is None else links
    poses = [evaluated(tree, ("pose",), qpos, link=link, point=point)["pose"] for link in names]
    return namespace(*poses).stack(poses, axis=-2)


def jacobian(
    tree: RigidTree,
    qpos: Array,
    link: str,
    *,
    point: Array = None,
) -> Array:
    """Return the Jacobian (..., 6, dof) of a point of ``link`` at ``qpos`` (..., dof), in the axes
    of the world.

    ``point`` is in the link's frame, (3,) or (..., 3) [m]; default its origin.
    """
    return evaluated(tree, ("jacobian",), qpos, link=link, point=point)["jacobian"]


def jacobian_rate(
    tree: RigidTree,
    qpos: Array,
    qvel: Array,
    link: str,
    *,
    point: Array = None,
) -> Array:
    """Return J' q' (..., 6): the acceleration [m/s^2, rad/s^2] that a point of ``link`` has by
    velocities alone.

    ``qpos`` and ``qvel`` are (..., dof); ``point`` is as in :func:`jacobian`.
    """
    return evaluated(
        tree,
        ("jacobian_rate",),
        qpos,
        qvel,
        link,
        point,
    )["jacobian_rate"]


def mass_matrix(tree: RigidTree, qpos: Array, bodies: Bodies | None = None) -> Array:
    """Return the mass matrices (..., dof, dof) [kg m^2 or kg] at ``qpos`` (..., dof), armature
    included.

    ``bodies`` belong to robots that differ from the tree, one for each row:
    :meth:`RigidTree.varied`.
    """
    return evaluated(tree, ("mass_matrix",), qpos, bodies=bodies)["mass_matrix"]


def bias(
    tree: RigidTree,
    qpos: Array,
    qvel: Array,
    turning: Array = None,
    *,
    bodies: Bodies | None = None,
) -> Array:
    """Return h(q, q') (..., dof) [N m or N]: the efforts that cancel gravity and Coriolis and
    centrifugal forces.

    A floating base turns at ``turning`` (..., 3) [rad/s], in its own axes; default 0. ``bodies``
    are as in :func:`mass_matrix`.
    """
    return evaluated(
        tree,
        ("bias",),
        qpos,
        qvel,
        bodies=bodies,
        turning=turning,
    )["bias"]


def inverse_dynamics(
    tree: RigidTree,
    qpos: Array,
    qvel: Array,
    qacc: Array,
) -> Array:
    """Return the efforts (..., dof) [N m or N] of the accelerations ``qacc`` (..., dof): M q'' +
    h.
    """
    *_, a = prepared(
        tree,
        qpos=qpos,
        qvel=qvel,
        qacc=qacc,
    )[0]
    results = evaluated(tree, ("mass_matrix", "bias"), qpos, qvel)
    with quiet():
        return product(results["mass_matrix"], tree.coupling.of_independent(a)) + results["bias"]


def forward_dynamics(
    tree: RigidTree,
    qpos: Array,
    qvel: Array,
    effort: Array,
) -> Array:
    """Return the accelerations (..., dof) [rad/s^2 or m/s^2] under ``effort`` (..., dof): M^-1 (tau
    - h).

    Raises
    ------
    InvalidArgumentError
        Also if a joint moves no mass and has no armature.
    """
    *_, u = prepared(
        tree,
        qpos=qpos,
        qvel=qvel,
        effort=effort,
    )[0]
    check_masses(tree)
    results = evaluated(tree, ("mass_matrix", "bias"), qpos, qvel)
    with quiet():
        net = tree.efforts(u) - results["bias"]
        return tree.rates(solve(results["mass_matrix"], net[..., None])[..., 0])
