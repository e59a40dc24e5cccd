r"""Inverse kinematics by damped least squares, with joint limits and several starts.

With the error e (position, rotation vector) of a pose, the Jacobian J, and E = e^T e / 2, a step
is::

    J# = J^T (J J^T + (1e-8 + 0.1 E) 1)^-1
    v  = J# e
    a  = -J# J' v                            geodesic acceleration, shortened to 0.75 |v|
    dq = v + a / 2

T. Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method", IEEE
Transactions on Robotics 27 (2011): damping in proportion to the error. M. K. Transtrum and J. P.
Sethna, "Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
minimization", arXiv:1201.5885 (2012): geodesic acceleration, which takes the curvature of the
tool's path into account. An active set keeps the joint limits: joints that v would move past a
limit stop at it, and the other joints take over the remaining error. If a search does not reach the
pose, further searches begin at other poses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Array, Float64
from batchpid.checks import array, choice, entries, instance, integer
from batchpid.errors import InvalidArgumentError
from batchpid.task_space import native_rows
from batchpid.task_space.frames import pose_error
from batchpid.task_space.osc_state import Tool
from batchpid.task_space.rigid_tree import MAKE_TREE, RigidTree
from batchpid.task_space.symmetric import gram, product, quiet, solve
from batchpid.task_space.tree_kinematics import read_point
from batchpid.task_space.tree_quantities import evaluated

ON_FAILURE = ("raise", "return")
_DAMPING, _DAMPING_PER_ERROR = 1e-8, 0.1
_LARGEST_ACCELERATION = 0.75  # relative to the velocity
_TOLERANCE = np.array([1e-5, 1e-4])  # [m, rad]
_PASSES = 4  # of the active set; joints that pass a limit after the last are clipped


class IKResult(NamedTuple):
    """Solutions of :func:`inverse_kinematics`."""

    qpos: Float64
    """Joint positions (envs, dof) [rad or m]; the nearest found where ``success`` is False."""
    position_error: Float64
    """Distance to the pose (envs,) [m]."""
    rotation_error: Float64
    """Angle to it (envs,) [rad]."""
    success: NDArray[np.bool_]
    """Whether both are within 0.01 mm and 0.1 mrad (envs,)."""
    iterations: NDArray[np.intp]
    """Steps from the start that led there (envs,)."""


def inverse_kinematics(
    tree: RigidTree,
    link: str,
    pose: ArrayLike,
    start: ArrayLike,
    *,
    point: ArrayLike | None = None,
    starts: int = 20,
    iterations: int = 60,
    on_failure: str = "raise",
) -> IKResult:
    """Return joint positions that bring a tool to ``pose``, within the joint limits of ``tree``.

    The first search starts at ``start``, others at random poses, the same for every env and call:
    the result of an env does not depend on the others. Joints outside the chain to the tool stay at
    ``start``.

    Parameters
    ----------
    link, point
        Tool: a point (3,) [m] of a link, default its origin.
    pose
        (7,) or (envs, 7): position [m] and unit quaternion (w, x, y, z), in the world.
    start
        (dof,) or (envs, dof) [rad or m]; clipped to the limits.
    starts
        Largest number of searches per env; 1 stays near ``start``, or fails.
    iterations
        Largest number of steps of a search.
    on_failure
        "raise": an error names the first env that failed; "return": the caller checks ``success``.

    Raises
    ------
    InvalidArgumentError
        An argument has a wrong shape or range, a quaternion is not of unit length, or, with
        "raise", a pose was not reached.
    """
    # Every argument is checked before the first search.
    instance("tree", tree, RigidTree, MAKE_TREE).index(link)
    choice("on_failure", on_failure, ON_FAILURE)
    integer("starts", starts, 1, 10_000)
    integer("iterations", iterations, 1, 100_000)
    goal, rows = _goals_and_starts(tree, pose, start)
    if point is not None:
        point = array("point", read_point(goal[0], point), (3,), "xyz", kind="entry")
    tool = Tool(tree, link, point)
    low, high = np.asarray(tree.lower), np.asarray(tree.upper)
    # The draws are shares of the range, or of a turn without limits; the same for every env, so
    # that no env depends on the number of envs.
    shares = np.random.default_rng(0).uniform(size=(starts - 1, 1, tree.dof))
    with quiet():
        best = _search(tool, iterations, goal, rows)
        # Most poses are reached from one of the first five starts.
        for drawn in (shares[:4], shares[4:]):
            left = np.flatnonzero(~_reached(best[1]))
            begin = np.where(np.isfinite(low), low, rows[left] - np.pi)
            end = np.where(np.isfinite(high), high, rows[left] + np.pi)
            # Joints outside of the chain stay where they are.
            began = np.where(tree.chain(link), begin + drawn * (end - begin), rows[left])
            goals = np.broadcast_to(goal[left], (*began.shape[:2], 7)).reshape(-1, 7)
            new = _search(tool, iterations, goals, tree.positions(began).reshape(-1, tree.dof))
            results = [
                np.concatenate([old[None, left], leaf.reshape(*began.shape[:2], leaf.shape[1])])
                for old, leaf in zip(best, new, strict=True)
            ]
            # The first start that reaches a pose is kept, else the nearest.
            errors = results[1]
            chosen = np.where(_reached(errors), -1.0, (errors / _TOLERANCE).max(-1)).argmin(0)
            for old, leaf in zip(best, results, strict=True):
                old[left] = leaf[chosen, np.arange(len(left))]
    qpos, errors, steps = best
    success = _reached(errors)
    result = IKResult(
        qpos,
        errors[:, 0],
        errors[:, 1],
        success,
        steps[:, 0].astype(np.intp),
    )
    if on_failure != "return" and not success.all():
        raise _failure(result)
    return result


def _reached(errors: Float64) -> Array:
    """Return where both errors (..., 2) are within the tolerances."""
    within: Array = (errors <= _TOLERANCE).all(-1)
    return within


def _search(
    tool: Tool,
    iterations: int,
    goal: Float64,
    qpos: Float64,
) -> list[Float64]:
    """Search for the poses ``goal`` (n, 7) from ``qpos`` (n, dof), within the limits.

    Return the nearest positions (n, dof), their errors (n, 2) [m, rad] and their numbers of steps
    (n, 1).
    """
    tree, link, point = tool
    native = native_rows.search(
        tree,
        tree.index(link),
        point,
        goal,
        qpos,
        _TOLERANCE,
        iterations,
    )
    if native is not None:
        return native
    # The same search in NumPy: the definition of the native one.
    best = [qpos.copy(), np.full((len(goal), 2), np.inf), np.zeros((len(goal), 1))]
    # Rows that have arrived leave, so the others pay for themselves alone.
    going = np.arange(len(goal))
    for step in range(iterations + 1):
        present = evaluated(tree, ("pose", "jacobian"), qpos, None, link, point)
        error = pose_error(goal[going], present["pose"])
        lengths = np.sqrt((error * error).reshape(-1, 2, 3).sum(-1))
        nearer = (lengths / _TOLERANCE).max(-1) < (best[1][going] / _TOLERANCE).max(-1)
        nearest = qpos, lengths, np.full((len(qpos), 1), float(step))
        for leaf, values in zip(best, nearest, strict=True):
            leaf[going[nearer]] = values[nearer]
        stay = ~_reached(lengths)
        going = going[stay]
        if not len(going):
            break
        qpos = tree.positions(_stepped(tool, present["jacobian"], qpos, error))[stay]
    return best


def _stepped(
    tool: Tool,
    jacobian: Float64,
    qpos: Float64,
    error: Float64,
) -> Float64:
    """Return the positions (n, dof) after a step within the limits."""
    tree, link, point = tool
    limits = np.asarray(tree.lower), np.asarray(tree.upper)
    # Damping grows with the error: far away the steps are short and safe, near by quadratic.
    damping = _DAMPING + _DAMPING_PER_ERROR * (error * error).sum(-1)[:, None, None] / 2
    # Joints that would pass a limit stop there, and the others take over their share.
    free = np.ones(qpos.shape, bool)
    move = np.zeros_like(qpos)
    for _ in range(_PASSES):
        part = np.where(free[:, None], jacobian, 0.0)
        rest = error - product(jacobian, np.where(free, 0.0, move))
        move = np.where(free, _damped(part, damping, rest), move)
        target = qpos + move
        within = np.clip(target, *limits)
        beyond = free & (target != within)
        move = np.where(beyond, within - qpos, move)
        free = free & ~beyond
        if not beyond.any():
            break
    # Geodesic acceleration: the curvature of the path of the tool.
    names = ("jacobian_rate",)
    rates = evaluated(tree, names, qpos, tree.rates(move), link, point)
    acceleration = -_damped(part, damping, rates["jacobian_rate"])
    size = np.sqrt((acceleration * acceleration).sum(-1, keepdims=True))
    most = _LARGEST_ACCELERATION * np.sqrt((move * move).sum(-1, keepdims=True))
    share = np.where(size > most, most / size, 1.0) / 2
    return np.clip(qpos + move + np.where(free, share * acceleration, 0.0), *limits)


def _damped(part: Float64, damping: Float64, vector: Float64) -> Float64:
    """Return J^T (J J^T + damping 1)^-1 v (n, dof) of the columns ``part`` (n, 6, dof) of J."""
    rows = part.swapaxes(-1, -2)
    matrix = gram(rows, rows) + damping * np.eye(6)
    return gram(part, solve(matrix, vector[..., None]))[..., 0]


def _goals_and_starts(
    tree: RigidTree, pose: ArrayLike, start: ArrayLike
) -> tuple[Float64, Float64]:
    """Return checked poses (envs, 7) and starts (envs, dof)."""
    # Either argument may be one row for all envs.
    columns = ("x", "y", "z", "qw", "qx", "qy", "qz")
    counts = [np.shape(arguments)[0] for arguments in (pose, start) if np.ndim(arguments) == 2]
    envs = max([1, *counts])
    goal = array("pose", pose, (envs, 7), columns, kind="entry").copy()
    rows = array("start", start, (envs, tree.dof), tree.joint_names)
    length = np.linalg.norm(goal[:, 3:], axis=1, keepdims=True)
    unit = np.abs(length - 1) < 1e-3
    problem = "has a quaternion whose length is not 1"
    remedy = "normalise w, x, y, z"
    entries(
        "pose",
        length,
        unit,
        problem,
        ["qw"],
        kind="entry",
        remedy=remedy,
    )
    goal[:, 3:] /= length
    return goal, tree.positions(np.clip(rows, tree.lower, tree.upper))


def _failure(result: IKResult) -> InvalidArgumentError:
    """Return the error for the first env that failed."""
    failed = np.flatnonzero(~result.success)
    env = int(failed[0])
    problem = (
        f"was not reached in {len(failed)} of {len(result.success)} envs:"
        f" {result.position_error[env] * 1e3:.3g} mm and"
        f" {result.rotation_error[env] * 1e3:.3g} mrad remain"
    )
    remedy = "check that it is in reach, or give more starts"
    return InvalidArgumentError("pose", problem, env=env, remedy=remedy)
