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

from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.arrays.records import array_summary
from batchpid.checks import array, choice, entries, instance, integer, positive
from batchpid.errors import InvalidArgumentError
from batchpid.task_space import native_rows
from batchpid.task_space.frames import pose_error
from batchpid.task_space.rigid_tree import MAKE_TREE, RigidTree
from batchpid.task_space.symmetric import gram, product, quiet, whitened
from batchpid.task_space.tree_kinematics import read_point
from batchpid.task_space.tree_quantities import evaluated

ON_FAILURE = ("raise", "return")
_DAMPING, _DAMPING_PER_ERROR = 1e-8, 0.1
_LARGEST_ACCELERATION = 0.75  # relative to the velocity
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
    on_failure: str = "raise",
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
    integer("seed", seed, 0, 2**63)
    position = positive("position_tolerance", position_tolerance, "m")
    rotation = positive("rotation_tolerance", rotation_tolerance, "rad")
    goal, rows = _goals_and_starts(tree, pose, start)
    if point is not None:
        point = array("point", read_point(goal[0], point), (3,), "xyz", kind="entry")
    search = _Search(tree, link, point, np.array([position, rotation]), iterations)
    # The draws are shares of the range, the same for every env, whatever the others do.
    shares = np.random.default_rng(seed).uniform(size=(starts - 1, tree.dof))
    number = np.zeros(len(goal), np.intp)
    with quiet():
        best = search.solve(goal, rows)
        # Most poses are reached from one of the first five starts.
        for first, last in ((0, 4), (4, starts - 1)):
            left = np.flatnonzero(~search.reached(best))
            drawn = shares[first:last]
            if not len(left) or not len(drawn):
                continue
            began = np.concatenate([search.drawn(rows[left], share) for share in drawn])
            results = search.solve(np.tile(goal[left], (len(drawn), 1)), began)
            for at in range(len(drawn)):
                part = results.rows(slice(at * len(left), (at + 1) * len(left)))
                present = best.rows(left)
                # The first start that reaches a pose is kept, else the nearest.
                nearer = search.size(part) < search.size(present)
                nearer &= ~search.reached(present)
                best.write(left[nearer], part.rows(nearer))
                number[left[nearer]] = first + 1 + at
    success = search.reached(best)
    steps = best.steps[:, 0].astype(np.intp)
    result = IKResult(
        best.qpos,
        best.errors[:, 0],
        best.errors[:, 1],
        success,
        number,
        steps,
    )
    if on_failure != "return" and not success.all():
        raise _failure(result)
    return result


class _Found(NamedTuple):
    """Nearest poses of some searches."""

    qpos: Float64
    """Positions (n, dof)."""
    errors: Float64
    """Errors of position and rotation (n, 2) [m, rad]."""
    steps: Float64
    """Numbers of steps (n, 1)."""

    def rows(self, chosen: Rows | slice) -> _Found:
        """Return some rows."""
        return _Found(*(leaf[chosen] for leaf in self))

    def write(self, rows: Rows, part: _Found) -> None:
        """Write ``part`` over some rows."""
        for leaf, values in zip(self, part, strict=True):
            leaf[rows] = values


class _Search(NamedTuple):
    """Searches for the poses of one tool."""

    tree: RigidTree
    link: str
    point: Float64 | None
    tolerance: Float64
    """Of position and rotation (2,) [m, rad]."""
    iterations: int

    @property
    def limits(self) -> tuple[Float64, Float64]:
        """Position limits of the joints (dof,)."""
        return np.asarray(self.tree.lower), np.asarray(self.tree.upper)

    def size(self, nearest: _Found) -> Float64:
        """Return the larger of position and rotation error over its tolerance (n,)."""
        worst: Float64 = (nearest.errors / self.tolerance).max(-1)
        return worst

    def reached(self, nearest: _Found) -> Bool:
        """Return the rows (n,) with both errors within the tolerances."""
        within: Bool = nearest.errors <= self.tolerance
        return within[:, 0] & within[:, 1]

    def drawn(self, rows: Float64, share: Float64) -> Float64:
        """Return starts at a ``share`` (dof,) of the range of each joint, half a turn about
        ``rows`` without limits.
        """
        low, high = self.limits
        low = np.where(np.isfinite(low), low, rows - np.pi)
        high = np.where(np.isfinite(high), high, rows + np.pi)
        # Joints outside of the chain stay where they are.
        chain = self.tree.chain(self.link)
        return self.tree.positions(np.where(chain, low + share * (high - low), rows))

    def solve(self, goal: Float64, qpos: Float64) -> _Found:
        """Return the results of searches that begin at ``qpos`` (n, dof), within the limits."""
        tool = self.tree, self.tree.index(self.link), self.point
        native = native_rows.search(
            *tool,
            self.limits,
            goal,
            qpos,
            self.tolerance,
            self.iterations,
        )
        if native is not None:
            return _Found(*native)
        # The same search in NumPy: the definition of the native one.
        count = len(goal)
        best = _Found(
            qpos.copy(),
            np.full((count, 2), np.inf),
            np.zeros((count, 1)),
        )
        # Rows that have arrived leave, so the others pay for themselves alone.
        going = np.arange(count)
        q = qpos
        for step in range(self.iterations + 1):
            present = evaluated(self.tree, ("pose", "jacobian"), q, None, self.link, self.point)
            error = pose_error(goal[going], present["pose"])
            lengths = np.sqrt((error * error).reshape(-1, 2, 3).sum(-1))
            nearest = _Found(q, lengths, np.full((len(q), 1), float(step)))
            better = self.size(nearest) < self.size(best.rows(going))
            best.write(going[better], nearest.rows(better))
            stay = ~self.reached(nearest)
            going = going[stay]
            q = self.tree.positions(self._stepped(present["jacobian"], q, error))[stay]
            if not len(going):
                break
        return best

    def _stepped(
        self,
        jacobian: Float64,
        qpos: Float64,
        error: Float64,
    ) -> Float64:
        """Return the positions (n, dof) after a step within the limits."""
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
            within = np.clip(target, *self.limits)
            beyond = free & (target != within)
            move = np.where(beyond, within - qpos, move)
            free = free & ~beyond
            if not beyond.any():
                break
        # Geodesic acceleration: the curvature of the path of the tool.
        names = ("jacobian_rate",)
        rates = evaluated(self.tree, names, qpos, self.tree.rates(move), self.link, self.point)
        acceleration = -_damped(part, damping, rates["jacobian_rate"])
        size = np.sqrt((acceleration * acceleration).sum(-1, keepdims=True))
        most = _LARGEST_ACCELERATION * np.sqrt((move * move).sum(-1, keepdims=True))
        share = np.where(size > most, most / size, 1.0) / 2
        return np.clip(qpos + move + np.where(free, share * acceleration, 0.0), *self.limits)


def _damped(part: Float64, damping: Float64, vector: Float64) -> Float64:
    """Return J^T (J J^T + damping 1)^-1 v (n, dof) of the columns ``part`` (n, 6, dof) of J."""
    rows = part.swapaxes(-1, -2)
    # One Cholesky factor serves both J and the error: J^T (L L^T)^-1 v.
    factor = whitened(
        gram(rows, rows) + damping * np.eye(6), np.concatenate([part, vector[..., None]], axis=-1)
    )
    return gram(factor[..., :-1], factor[..., -1:])[..., 0]


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
    remedy = "check that it is in reach, or give more starts or larger tolerances"
    return InvalidArgumentError("pose", problem, env=env, remedy=remedy)
