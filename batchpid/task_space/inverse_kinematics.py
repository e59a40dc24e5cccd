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
pose, further searches begin at other poses. In these, a joint with a full turn between its limits
passes them, and is turned back at the end.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Array, Float64
from batchpid.arrays.display import array_summary
from batchpid.checks.validate import array, choice, entries, instance, integer, positive
from batchpid.checks.warn import warn
from batchpid.errors import InvalidArgumentError
from batchpid.task_space import native_rows
from batchpid.task_space.frames import pose_error, pose_of
from batchpid.task_space.rigid_tree import MAKE_TREE, RigidTree
from batchpid.task_space.symmetric import gram, product, quiet, whitened
from batchpid.task_space.tree_kinematics import (
    jacobian_at,
    motions_of,
    rate_at,
    read_point,
    tool_frame,
    velocities_of,
)

ON_FAILURE = ("warn", "raise", "return")
_DAMPING, _DAMPING_PER_ERROR = 1e-8, 0.1
_LARGEST_ACCELERATION = 0.75  # relative to the velocity
_FULL_TURN = 2 * np.pi - 1e-6  # [rad]; limits are often rounded
_PASSES = 4  # of the active set; joints that pass a limit after the last are clipped


class InverseKinematicsWarning(UserWarning):
    """Some poses were not reached."""


class IKResult(NamedTuple):
    """Solutions of :func:`inverse_kinematics`."""

    qpos: Float64
    """Joint positions (envs, dof) [rad or m]; the nearest found where ``success`` is False."""
    position_error: Float64
    """Distance to the pose (envs,) [m]."""
    rotation_error: Float64
    """Angle to it (envs,) [rad]."""
    success: NDArray[np.bool_]
    """Whether both are within the tolerances (envs,)."""
    start: NDArray[np.intp]
    """Number of the start that led there (envs,): 0 for the given one."""
    iterations: NDArray[np.intp]
    """Steps from that start (envs,)."""

    def __repr__(self) -> str:
        return array_summary(self, "envs", "joints")


def inverse_kinematics(
    tree: RigidTree,
    link: str,
    pose: ArrayLike,
    start: ArrayLike,
    *,
    point: ArrayLike | None = None,
    starts: int = 20,
    iterations: int = 60,
    position_tolerance: float = 1e-5,
    rotation_tolerance: float = 1e-4,
    seed: int = 0,
    on_failure: str = "warn",
) -> IKResult:
    """Return joint positions that bring a tool to ``pose``, within the joint limits of ``tree``.

    The first search starts at ``start``, others at poses drawn from ``seed``, the same for every
    env: the result of an env does not depend on the others. Joints outside the chain to the tool
    stay at ``start``.

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
    position_tolerance, rotation_tolerance
        Largest errors of a success [m, rad].
    on_failure
        "warn": an :class:`InverseKinematicsWarning` names the first env that failed; "raise": an
        error; "return": the caller checks ``success``.

    Raises
    ------
    InvalidArgumentError
        An argument has a wrong shape or range, a quaternion is not of unit length, or, with
        "raise", a pose was not reached.
    """
    index, how = (
        instance("tree", tree, RigidTree, MAKE_TREE).index(link),
        choice("on_failure", on_failure, ON_FAILURE),
    )
    integer("starts", starts, 1, 10_000)
    integer("iterations", iterations, 1, 100_000)
    tolerances = {
        "position_tolerance": (position_tolerance, "m"),
        "rotation_tolerance": (rotation_tolerance, "rad"),
    }
    tolerance = np.array([positive(name, *value) for name, value in tolerances.items()])
    goal, rows = _goals_and_starts(tree, pose, start)
    at = (
        None
        if point is None
        else array("point", read_point(goal[0], point), (3,), "xyz", kind="entry")
    )
    search = _Search(tree, index, at, tolerance, iterations)
    integer("seed", seed, 0, 2**63)
    with quiet():
        best = search.solve(goal, rows)
        if best.success.all():
            return best
        shares = np.random.default_rng(seed).uniform(size=(starts - 1, tree.dof))
        for first, last in (
            (0, 4),
            (4, starts - 1),
        ):  # most poses are reached from one of the first five
            left, drawn = np.flatnonzero(~best.success), shares[first:last]
            if len(left) and len(drawn):
                began = np.concatenate([search.drawn(rows[left], share) for share in drawn])
                found = search.solve_past_limits(np.tile(goal[left], (len(drawn), 1)), began)
                for number, part in enumerate(
                    np.arange(len(began)).reshape(len(drawn), -1), start=first + 1
                ):
                    _replace(
                        best, left, IKResult._make(leaf[part] for leaf in found), number, tolerance
                    )
    if how != "return" and not best.success.all():
        _report(best, how)
    return best


class _Search:
    """Searches for the poses of one tool."""

    def __init__(
        self,
        tree: RigidTree,
        index: int,
        point: Float64 | None,
        tolerance: Float64,
        iterations: int,
    ) -> None:
        self._tree = tree
        self._index = index
        self._point = point
        self._tolerance, self._iterations = tolerance, iterations
        self._chain = tree.chain(tree.links[index])
        self._limits: tuple[Float64, Float64] = np.asarray(tree.lower), np.asarray(tree.upper)
        turn = self._limits[1] - self._limits[0]
        turns = _wholly_turning(tree)
        self._full = self._chain & turns & (turn > _FULL_TURN) & np.isfinite(turn)

    def drawn(self, rows: Float64, share: Float64) -> Float64:
        """Return starts at a ``share`` (dof,) of the range of each joint, half a turn about
        ``rows`` without limits.
        """
        low, high = self._limits
        low, high = (
            np.where(np.isfinite(low), low, rows - np.pi),
            np.where(np.isfinite(high), high, rows + np.pi),
        )
        return self._tree.positions(np.where(self._chain, low + share * (high - low), rows))

    def solve_past_limits(self, goal: Float64, qpos: Float64) -> IKResult:
        """Return the results of searches in which joints with a full turn between their limits pass
        these.
        """
        low, high = self._limits
        if not self._full.any():
            return self.solve(goal, qpos)
        found = self.solve(
            goal, qpos, (np.where(self._full, -np.inf, low), np.where(self._full, np.inf, high))
        )
        over, turn = found.qpos - np.where(self._full, high, np.inf), 2 * np.pi
        under = np.where(self._full, low, -np.inf) - found.qpos
        back = turn * (np.ceil(np.maximum(under, 0) / turn) - np.ceil(np.maximum(over, 0) / turn))
        past = back.any(axis=1)
        if (
            past.any()
        ):  # a joint between two turns is clipped to its limits, so search again from there
            within = self.solve(goal[past], np.clip(found.qpos[past] + back[past], low, high))
            for whole, part in zip(
                found,
                within._replace(iterations=within.iterations + found.iterations[past]),
                strict=True,
            ):
                whole[past] = part
        return found

    def solve(
        self, goal: Float64, qpos: Float64, limits: tuple[Float64, Float64] | None = None
    ) -> IKResult:
        """Return the results of searches that begin at ``qpos`` (n, dof), within ``limits``, by
        default the tree's.
        """
        limits = limits or self._limits
        found = native_rows.search(
            self._tree,
            self._index,
            self._point,
            limits,
            goal,
            qpos,
            self._tolerance,
            self._iterations,
        )
        if found is None:
            found = self._solve(goal, qpos, limits)
        nearest, lengths, steps = found
        near, start = lengths <= self._tolerance, np.zeros(len(goal), np.intp)
        success, count = near[:, 0] & near[:, 1], steps[:, 0].astype(np.intp)
        return IKResult(nearest, lengths[:, 0], lengths[:, 1], success, start, count)

    def _solve(
        self, goal: Float64, qpos: Float64, limits: tuple[Float64, Float64]
    ) -> list[Float64]:
        """Compute the results of :func:`native_rows.search` in NumPy."""
        count = len(goal)
        nearest, lengths, steps = [qpos.copy(), np.full((count, 2), np.inf), np.zeros((count, 1))]
        going, q = np.arange(count), qpos
        for step in range(self._iterations + 1):
            at = _At(self._tree, self._index, self._point, q)
            error = pose_error(goal[going], at.pose)
            found = np.sqrt((error * error).reshape(-1, 2, 3).sum(-1))
            better = _size(found, self._tolerance) < _size(lengths[going], self._tolerance)
            rows = going[better]
            nearest[rows], lengths[rows], steps[rows] = q[better], found[better], step
            stay = ~(found <= self._tolerance).all(1)
            going, q = going[stay], self._tree.positions(_stepped(limits, at, q, error))[stay]
            if not len(going):
                break
        return [nearest, lengths, steps]


class _At:
    """Tool at given positions (n, dof)."""

    def __init__(self, tree: RigidTree, index: int, point: Float64 | None, qpos: Float64) -> None:
        self._tree, self._index = tree, index
        self._motions = motions_of(tree, tree.bodies, qpos, np)
        tool = tool_frame(tree, tree.bodies, self._motions.frames, index, point)
        self.pose, self._place = pose_of(tool), tool[..., 3]
        self.jacobian = jacobian_at(tree, tree.bodies, self._motions, index, self._place)

    def rate(self, qvel: Float64) -> Float64:
        """Return J' q' (n, 6)."""
        velocities = velocities_of(self._tree, self._motions, self._tree.rates(qvel), np)
        return rate_at(self._tree, velocities, self._index, self._place)


def _stepped(limits: tuple[Float64, Float64], at: _At, qpos: Float64, error: Float64) -> Float64:
    """Return the positions (n, dof) after a step within the limits."""
    damping = _DAMPING + _DAMPING_PER_ERROR * (error * error).sum(-1)[:, None, None] / 2
    free, move = np.ones(qpos.shape, bool), np.zeros_like(qpos)
    for _ in range(_PASSES):
        part = np.where(free[:, None], at.jacobian, 0.0)
        rest = error - product(at.jacobian, np.where(free, 0.0, move))
        move = np.where(free, _damped(part, damping, rest), move)
        target = qpos + move
        within = np.clip(target, *limits)
        beyond = free & (target != within)
        move, free = np.where(beyond, within - qpos, move), free & ~beyond
        if not beyond.any():
            break
    acceleration = -_damped(part, damping, at.rate(move))
    size, most = (
        np.sqrt((x * x).sum(-1, keepdims=True))
        for x in (acceleration, _LARGEST_ACCELERATION * move)
    )
    share = np.where(size > most, most / size, 1.0) / 2
    return np.clip(qpos + move + np.where(free, share * acceleration, 0.0), *limits)


def _damped(part: Float64, damping: Float64, vector: Float64) -> Float64:
    """Return J^T (J J^T + damping 1)^-1 v (n, dof) of the columns ``part`` (n, 6, dof) of J."""
    rows = part.swapaxes(-1, -2)
    factor = whitened(
        gram(rows, rows) + damping * np.eye(6), np.concatenate([part, vector[..., None]], axis=-1)
    )
    return gram(factor[..., :-1], factor[..., -1:])[..., 0]


def _goals_and_starts(
    tree: RigidTree, pose: ArrayLike, start: ArrayLike
) -> tuple[Float64, Float64]:
    """Return checked poses (envs, 7) and starts (envs, dof)."""
    columns = ("x", "y", "z", "qw", "qx", "qy", "qz")
    envs = max(1, *(np.shape(given)[0] for given in (pose, start) if np.ndim(given) == 2), 1)
    goal = array("pose", pose, (envs, 7), columns, kind="entry").copy()
    rows = array("start", start, (envs, tree.dof), tree.joint_names)
    length = np.linalg.norm(goal[:, 3:], axis=1, keepdims=True)
    unit = np.abs(length - 1) < 1e-3
    problem, remedy = "has a quaternion that is not of unit length", "normalise w, x, y, z"
    entries("pose", length, unit, problem, ["qw"], kind="entry", remedy=remedy)
    goal[:, 3:] /= length
    return goal, tree.positions(np.clip(rows, tree.lower, tree.upper))


def _wholly_turning(tree: RigidTree) -> NDArray[np.bool_]:
    """Return the joints (dof,) that a whole turn brings back to the same pose of all links."""
    turning = tree.bodies.slides[:, 0] == 0
    pitch = np.where(
        turning, tree.coupling.multiplier % 1, tree.coupling.multiplier
    )  # 0 if the follower is back, too
    back = np.bincount(tree.coupling.leader, pitch != 0, minlength=tree.dof) == 0
    return turning & back & tree.independent


def _lengths(found: IKResult, rows: Any) -> Float64:
    return np.stack([found.position_error[rows], found.rotation_error[rows]], axis=-1)


def _size(lengths: Float64, tolerance: Float64) -> Float64:
    """Return the larger of position and rotation error over its tolerance."""
    return (lengths / tolerance).max(-1)


def _replace(best: IKResult, left: Array, found: IKResult, start: int, tolerance: Float64) -> None:
    """Write ``found`` over the rows ``left`` of ``best`` that have not succeeded, where it is
    nearer.
    """
    nearer = _size(_lengths(found, slice(None)), tolerance) < _size(_lengths(best, left), tolerance)
    rows = nearer & ~best.success[left]
    for whole, part in zip(best, found, strict=True):
        whole[left[rows]] = part[rows]
    best.start[left[rows]] = start


def _report(found: IKResult, how: str) -> None:
    """Warn, or raise, for the first env that failed."""
    failed = np.flatnonzero(~found.success)
    env = int(failed[0])
    problem = (
        f"was not reached in {len(failed)} of {len(found.success)} envs:"
        f" {found.position_error[env] * 1e3:.3g} mm and {found.rotation_error[env] * 1e3:.3g} mrad"
        " are left"
    )
    error = InvalidArgumentError(
        "pose",
        problem,
        env=env,
        remedy="check that it is in reach, or give more starts or larger tolerances",
    )
    if how == "raise":
        raise error
    warn(str(error), InverseKinematicsWarning)
