r"""Fit: Levenberg-Marquardt steps within bounds, with derivatives along the covariance's axes.

Residuals over their size, with the loss ``2 C^2 (sqrt(1 + (r / C)^2) - 1)`` against outliers, and
the unknowns' distances from the prior are minimised. With the weighted residuals r and their
derivatives J, a step s solves::

    min |J s + r|^2 + damping |diag(J) s|^2,     low <= point + s <= high

(D. W. Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", 1963; bounds
by "bounded-variable least squares"). Joints that stick and slide make residuals that are not smooth:
differences by single unknowns are off by some percent, which looks like information along directions
that the data do not show. Hence the changes of an evaluation are the axes of the present covariance,
each about a standard deviation long.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.regression import bounded_solution

OUTLIER = 2.0
"""Ratio C of a residual to its size above which its weight in the loss decreases."""
FIRST_CHANGE = 1e-3
"""Change of each unknown for the first derivatives."""
LEAST_CHANGE, MOST_CHANGE = 1e-3, 0.1
"""Bounds of the largest change of an unknown on an axis, over its value or typical size."""
ROUNDS = 4
"""Largest number of weights; each is the size of the residuals that the last one left."""
SETTLED = 0.5
"""Ratio of that size to the one before from which the weight stays."""
TOLERANCE, ROUGH_TOLERANCE = 1e-4, 2e-3
"""Expected decreases over the cost at which a fit ends, and its first steps on few windows."""
DAMPING = 1e-2
"""Damping at the start."""
GROWTH = 10.0
"""Growth of the damping after a step that does not lower the cost, ten times as large after each
further one.
"""
MOST_DAMPING = 1e6
"""Damping at which no step lowers the cost."""


class Iterate(NamedTuple):
    """A point with residuals and their changes."""

    point: Float64
    changes: Float64
    """Changes of the point (n, unknowns)."""
    evaluation: list[Float64]


class Solution(NamedTuple):
    """End of a fit."""

    point: Float64
    size: Float64
    """Size of the residuals that the fit was weighted with (joints,)."""
    converged: bool


def solve(
    problem: Problem,
    point: Float64,
    size: Float64 | None = None,
    evaluations: int = 60,
    progress: Callable[[], object] | None = None,
    tolerance: float = TOLERANCE,
) -> Solution:
    """Return the fit from a ``point``; it begins with a ``size`` (joints,) of the residuals, or the
    one at the point.

    The size of residuals that are left may be far smaller, which would give the prior too much
    weight: it is taken anew until it stays.
    """
    low, high = problem.unknowns.bounds
    point = np.clip(point, low, high)
    place = iterate(problem, point, FIRST_CHANGE * np.eye(len(point)))
    weight = problem.size(place.evaluation) if size is None else size
    damping = DAMPING
    growth = GROWTH
    rounds = 1
    settled = False
    for _ in range(evaluations - 1):
        if progress is not None:
            progress()
        before = cost(problem, place, weight)
        triangle = triangle_of(problem, place, weight)
        step, expected = bounded_step(triangle, damping, low - place.point, high - place.point)
        further = place.point + step
        trial = Iterate(further, place.changes[:0], problem.evaluate(further))
        gain = before - cost(problem, trial, weight)
        if gain > 0:
            square = max(float(triangle[:, 0] @ triangle[:, 0]) / rows_of(problem), 1e-6)
            hessian = triangle[:, 1:].T @ triangle[:, 1:] / square
            axes, _ = axes_of(hessian, np.maximum(abs(further), 1))
            place = iterate(problem, further, _inward(further, axes, low, high))
            damping = max(damping * (0.1 if gain > 0.5 * expected else 0.5), 1e-9)
            growth = GROWTH
        else:
            damping *= growth
            growth *= GROWTH
        settled = expected < tolerance * before or damping > MOST_DAMPING
        size = problem.size(place.evaluation)
        shrunk = rounds < ROUNDS and bool(np.median(size / weight) < SETTLED)
        if shrunk and (settled or gain > 0):
            weight = size
            rounds += 1
            damping = min(damping, DAMPING)
            settled = False
        elif settled:
            break
    return Solution(place.point, weight, settled)


def iterate(problem: Problem, point: Float64, changes: Float64) -> Iterate:
    """Return the evaluation of a point and of ``changes`` (n, unknowns) of it."""
    return Iterate(point, changes, problem.evaluate(point, changes))


def linearised(problem: Problem, place: Iterate, size: Float64) -> Float64:
    """Return residuals over their ``size`` and derivatives by the unknowns (rows, 1 + unknowns),
    with the weights of the loss.
    """
    table = problem.weighted(place.evaluation, size)
    table *= (1 + (table[:, :1] / OUTLIER) ** 2) ** -0.25
    slopes = table[:, 1:] @ np.linalg.pinv(place.changes, rcond=1e-12).T
    return np.column_stack([table[:, 0], slopes])


def axes_of(hessian: Float64, scale: Float64) -> tuple[Float64, Float64]:
    """Return the axes (rows) of the covariance and their standard deviations.

    An axis is a standard deviation long, within the bounds of its largest change over ``scale``
    (unknowns,).
    """
    precisions, turn = np.linalg.eigh(hessian)
    spans = 1 / np.sqrt(np.maximum(precisions, 1e-30))
    axes = (turn * spans).T
    largest = np.abs(axes / scale).max(1, keepdims=True)
    return axes * np.clip(largest, LEAST_CHANGE, MOST_CHANGE) / largest, spans


def cost(problem: Problem, place: Iterate, size: Float64) -> float:
    """Return half the loss of all residuals, the prior's distances included."""
    residual = problem.weighted(place.evaluation, size)[:, 0]
    loss = 2 * OUTLIER**2 * (np.sqrt(1 + (residual / OUTLIER) ** 2) - 1).sum()
    mean, spread = problem.unknowns.prior
    return 0.5 * float(loss + (((place.point - mean) / spread) ** 2).sum())


def triangle_of(problem: Problem, place: Iterate, size: Float64) -> Any:
    """Return the triangle of residuals and derivatives, the prior's rows included."""
    mean, spread = problem.unknowns.prior
    prior = np.column_stack([(place.point - mean) / spread, np.diag(1 / spread)])
    return np.linalg.qr(np.vstack([linearised(problem, place, size), prior]), mode="r")


def bounded_step(
    triangle: Float64,
    damping: float,
    low: Float64,
    high: Float64,
) -> tuple[Float64, float]:
    """Return the damped step within bounds, and the decrease of the cost that it promises."""
    residual, slopes = triangle[:, 0], triangle[:, 1:]
    ridge = np.diag(np.sqrt(damping) * np.linalg.norm(slopes, axis=0))
    rows = np.vstack([slopes, ridge])
    target = -np.append(residual, np.zeros(len(ridge)))
    step = bounded_solution(rows, target, low, high)
    decrease = target @ target - ((rows @ step - target) ** 2).sum()
    return step, 0.5 * float(decrease)


def _inward(
    point: Float64,
    axes: Float64,
    low: Float64,
    high: Float64,
) -> Float64:
    """Return the changes (n, unknowns) along ``axes``, forward or, from a bound, backward."""
    ahead, back = (np.clip(point + sign * axes, low, high) - point for sign in (1, -1))
    is_short = np.linalg.norm(ahead, axis=1) < np.linalg.norm(back, axis=1)
    return np.where(is_short[:, None], back, ahead)


def rows_of(problem: Problem) -> int:
    """Return the number of fitted residuals."""
    return sum(int(window.fitted.sum()) * window.measured.shape[1] for window in problem.windows)
