"""Poses, Jacobians, mass matrices and forces of a kinematic tree: natively where that is possible,
else as :mod:`batchpid.task_space.tree_kinematics` and :mod:`batchpid.task_space.tree_dynamics`
define them.

Arrays have any leading axes. Every function raises InvalidArgumentError for an unknown link, or an
array of a wrong shape.
"""

from __future__ import annotations

from collections.abc import Sequence

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace
from batchpid.task_space import native_rows
from batchpid.task_space.frames import pose_of
from batchpid.task_space.rigid_tree import Bodies, RigidTree
from batchpid.task_space.symmetric import product, quiet, solve
from batchpid.task_space.tree_dynamics import check_masses, effort_of, mass_matrix_of
from batchpid.task_space.tree_kinematics import (
    jacobian_at,
    motions_of,
    prepared,
    rate_at,
    read_point,
    tool_frame,
    velocities_of,
)


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
    if qvel is None:
        inputs = {"qpos": qpos}
    else:
        inputs = {"qpos": qpos, "qvel": qvel}
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
    results: dict[str, Array] = {}
    with quiet():
        motions = motions_of(tree, of_robots, columns, xp)
        if v is None:
            velocities = None
        else:
            speeds = v.reshape(-1, tree.dof).T
            velocities = velocities_of(
                tree,
                of_robots,
                motions,
                speeds,
                xp,
                turning,
            )
        if link is not None:
            tool = tool_frame(tree, of_robots, motions, index, place)
            results["pose"] = pose_of(tool)
            place = tool[..., 3]
            if "jacobian" in names:
                results["jacobian"] = jacobian_at(tree, of_robots, motions, index, place)
            if "jacobian_rate" in names and velocities is not None:
                results["jacobian_rate"] = rate_at(tree, velocities, index, place)
        if "mass_matrix" in names:
            results["mass_matrix"] = mass_matrix_of(tree, of_robots, motions, xp)
        if "bias" in names and velocities is not None:
            results["bias"] = effort_of(
                tree,
                of_robots,
                motions,
                velocities,
                xp,
                turning,
            )
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

    With a ``point`` (3,) in the frame of the links [m], the positions of this point.
    """
    prepared(tree, qpos=qpos)
    names = tree.links if links is None else links
    poses = [
        evaluated(
            tree,
            ("pose",),
            qpos,
            None,
            link,
            point,
        )["pose"]
        for link in names
    ]
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
    return evaluated(
        tree,
        ("jacobian",),
        qpos,
        None,
        link,
        point,
    )["jacobian"]


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


def gravity(tree: RigidTree, qpos: Array) -> Array:
    """Return the efforts (..., dof) [N m or N] that hold the robot at ``qpos`` (..., dof): h(q,
    0).
    """
    (q,), *_ = prepared(tree, qpos=qpos)
    return bias(tree, q, 0 * q)


def inverse_dynamics(
    tree: RigidTree,
    qpos: Array,
    qvel: Array,
    qacc: Array,
) -> Array:
    """Return the efforts (..., dof) [N m or N] of the accelerations ``qacc`` (..., dof): M q'' +
    h.
    """
    *_, a = prepared(tree, qpos=qpos, qvel=qvel, qacc=qacc)[0]
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
    *_, u = prepared(tree, qpos=qpos, qvel=qvel, effort=effort)[0]
    check_masses(tree)
    results = evaluated(tree, ("mass_matrix", "bias"), qpos, qvel)
    with quiet():
        net = tree.efforts(u) - results["bias"]
        return tree.rates(solve(results["mass_matrix"], net[..., None])[..., 0])
