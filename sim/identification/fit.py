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

A fit may end in a local minimum, for example with a payload at the wrong link, or with the law's
limit far from the error that saturates it. A short fit from each start shows the better one.

Unknowns besides those of the motors have to lower the error at held-out rows, with free initial
states of windows. A delay or a lag of setpoints is left out unless its absence raises that error.
Where residuals are correlated, friction at rest, masses, offsets and load friction are added, the
most helpful first, as long as the error falls. One evaluation with all of them, and the linear step
of each, give the order of the trials.

With the residuals r and their derivatives J in units of the prior's deviations, the information of
the data is ``J^T J / s^2`` with the mean square s^2 of the residuals. J comes from differences along
the axes of the covariance in passes until their lengths stay, so that a direction without effect
carries no information. The prior has a quarter of its weight: ``H = J^T J / s^2 + 1 / 4``.

The variance is the larger of H^-1 and K times that of the scores of PARTS stretches, each with the
sum g of its scores ``J^T r / s^2``::

    H^-1 (sum of g g^T) H^-1 PARTS / (PARTS - 1),     K = 1 + c (PARTS - 1)

(P. J. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967).
Noise averages out over the stretches, but an error of the model, as between the friction of two
engines, is common to all of them, and no resampling can see it. Its share c of the scores' variance
is what white noise does not explain: one minus the median of ``(1 - rho) H^-1`` over that variance,
at least the correlation rho of neighbouring residuals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.unknowns import SENDER, Problem, kinds_of, size_of

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


FIRST_PASS_CHANGE = 0.005
"""Change of each unknown in the first pass, over its value or typical size."""
PASSES = 4
"""Most passes."""
SAME_LENGTH = 0.3
"""Relative change of the axes' lengths at which the passes end."""
PRIOR_WEIGHT = 0.25
"""Weight of the prior in the intervals."""
FAINT_WEIGHT = 0.01
"""Weight of the prior in the test of what the data show."""
PARTS = 12
"""Number of stretches of the logs."""
INTERVAL = 2.2
"""Half width of a 95 % interval over the standard deviation: t with PARTS - 1 degrees."""
LEAST_DEVIATION = 5e-3
"""Least standard deviation over the value: two engines differ by as much."""
SHOWN = 0.7
"""Standard deviation by the data, over the prior's, from which an unknown is not shown."""
ALIKE_CORRELATION = 0.8
"""Correlation from which one unknown cannot be told from another."""
TRIAL = 5
"""Evaluations of a short fit."""
KEPT = 0.95
"""Share of the held-out error that an unknown has to leave for it to be kept."""
COLORED = 0.2
"""Correlation of the residuals from which further effects are tried."""
EFFECTS = {
    "stribeck": KEPT,
    "mass": 0.8,
    "offset": 0.8,
    "load_friction": 0.8,
}
"""Effects that are tried, and the share of the held-out error that each has to leave: every motor
has more friction at rest, but a few percent may be an error of the model that looks like a mass.
"""


class Fit(NamedTuple):
    """End of a fit, the certainty of its unknowns, and what was left out or added."""

    problem: Problem
    point: Float64
    size: Float64
    """Size of the residuals that the fit was weighted with (joints,)."""
    converged: bool
    deviation: Any = None
    """Standard deviations (unknowns,) of the values, in their units."""
    root: Any = None
    """Root L of their covariance L L^T (unknowns, unknowns), at most as wide as the prior."""
    shown: Any = None
    """Mask (unknowns,) of those that the logs show."""
    alike: Any = None
    """Pairs (unknowns, unknowns) that cannot be told from one another."""
    colored: float = 0.0
    """Correlation of neighbouring residuals, 0 for white noise."""
    dropped: Sequence[str] = ()
    """"setpoint_delay" and "setpoint_lag", where the logs do not need them."""
    effects: Mapping[str, float] = {}
    """Effects that were added, with the share of the held-out error that each left."""


def solve(
    problem: Problem,
    point: Float64,
    *,
    evaluations: int,
    progress: Callable[[], object],
    tolerance: float = TOLERANCE,
) -> Fit:
    """Return the fit from a ``point``.

    Residuals are weighted by their size. It may become far smaller in the fit, and the prior would
    have too much weight: the weights are then renewed, until the size settles.
    """
    low, high = problem.unknowns.bounds
    point = np.clip(point, low, high)
    table = problem.fitted(point, FIRST_CHANGE * np.eye(len(point)))
    weight = size_of(table)
    count = table[..., 0].size
    damping = DAMPING
    growth = GROWTH
    rounds = 1
    settled = False
    for _ in range(evaluations - 1):
        progress()
        before = cost(problem, point, table, weight)
        triangle = triangle_of(problem, point, table, weight)
        step, expected = bounded_step(triangle, damping, low - point, high - point)
        further = point + step
        gain = before - cost(problem, further, problem.fitted(further), weight)
        if gain > 0:
            square = max(float(triangle[:, 0] @ triangle[:, 0]) / count, 1e-6)
            hessian = triangle[:, 1:].T @ triangle[:, 1:] / square
            point = further
            axes, _ = axes_of(hessian, np.maximum(abs(point), 1))
            table = problem.fitted(point, inward(point, axes, low, high))
            damping = max(damping * (0.1 if gain > 0.5 * expected else 0.5), 1e-9)
            growth = GROWTH
        else:
            damping *= growth
            growth *= GROWTH
        settled = expected < tolerance * before or damping > MOST_DAMPING
        size = size_of(table)
        shrunk = rounds < ROUNDS and bool(np.median(size / weight) < SETTLED)
        if shrunk and (settled or gain > 0):
            weight = size
            rounds += 1
            damping = min(damping, DAMPING)
            settled = False
        elif settled:
            break
    return Fit(problem, point, weight, settled)


def weighted(table: Float64, size: Float64) -> Float64:
    """Return residuals and derivatives (rows, joints, 1 + unknowns) over the residuals' ``size``,
    with the weights of the loss: (rows, 1 + unknowns).
    """
    rows = (table / size[:, None]).reshape(-1, table.shape[2])
    return np.asarray(rows * (1 + (rows[:, :1] / OUTLIER) ** 2) ** -0.25, float)


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


def cost(
    problem: Problem,
    point: Float64,
    table: Float64,
    size: Float64,
) -> float:
    """Return half the loss of all residuals at a point, the prior's distances included."""
    residual = table[..., 0] / size
    loss = 2 * OUTLIER**2 * (np.sqrt(1 + (residual / OUTLIER) ** 2) - 1).sum()
    mean, spread = problem.unknowns.prior
    return 0.5 * float(loss + (((point - mean) / spread) ** 2).sum())


def triangle_of(
    problem: Problem,
    point: Float64,
    table: Float64,
    size: Float64,
) -> Any:
    """Return the triangle of residuals and derivatives at a point, the prior's rows included."""
    mean, spread = problem.unknowns.prior
    prior = np.column_stack([(point - mean) / spread, np.diag(1 / spread)])
    return np.linalg.qr(np.vstack([weighted(table, size), prior]), mode="r")


def bounded_step(
    triangle: Float64,
    damping: float,
    low: Float64,
    high: Float64,
) -> tuple[Float64, float]:
    """Return the damped step within bounds, and the decrease of the cost that it promises."""
    from scipy import optimize

    residual, slopes = triangle[:, 0], triangle[:, 1:]
    ridge = np.diag(np.sqrt(damping) * np.linalg.norm(slopes, axis=0))
    rows = np.vstack([slopes, ridge])
    target = -np.append(residual, np.zeros(len(ridge)))
    # The solution may lie beyond a bound by its last bit.
    step = np.clip(optimize.lsq_linear(rows, target, (low, high), method="bvls").x, low, high)
    decrease = target @ target - ((rows @ step - target) ** 2).sum()
    return step, 0.5 * float(decrease)


def inward(
    point: Float64,
    axes: Float64,
    low: Float64,
    high: Float64,
) -> Float64:
    """Return the changes (n, unknowns) along ``axes``, forward or, from a bound, backward."""
    ahead, back = (np.clip(point + sign * axes, low, high) - point for sign in (1, -1))
    is_short = np.linalg.norm(ahead, axis=1) < np.linalg.norm(back, axis=1)
    return np.where(is_short[:, None], back, ahead)


def with_certainty(fit: Fit) -> Fit:
    """Return a fit with its certainty."""
    problem, point, size, *_ = fit
    unknowns = problem.unknowns
    prior = unknowns.spread(point)
    residual, score, data = _information(problem, point, size)
    covariance = np.linalg.inv(data + PRIOR_WEIGHT * np.eye(len(point)))
    # Stretches have independent noise.
    sums = np.array([part.sum(0) for part in np.array_split(score, PARTS)])
    spread = covariance @ (sums.T @ sums) @ covariance * PARTS / (PARTS - 1)
    rows = residual.reshape(-1, len(size))
    colored = max(float((rows[1:] * rows[:-1]).sum() / (rows**2).sum()), 0.0)
    variance = np.diagonal(covariance)
    white = (1 - colored) * variance / np.diagonal(spread)
    common = max(1 - float(np.median(white)), colored)
    ratio = np.maximum((1 + common * (PARTS - 1)) * np.diagonal(spread), variance)
    scale = prior * unknowns.sizes
    total = np.abs(unknowns.values(point) + unknowns.described)
    deviation = np.maximum(np.sqrt(ratio) * scale, LEAST_DEVIATION * total)
    is_delay = np.array([entry.kind == "delay" for entry in unknowns.entries])
    deviation += problem.half_row / INTERVAL * is_delay
    # Correlations come from the information.
    spans, axes = np.linalg.eigh(covariance)
    lengths = np.minimum(deviation, scale) / np.sqrt(variance)
    root = lengths[:, None] * axes * np.sqrt(np.maximum(spans, 0.0))
    alone = np.linalg.inv(data + FAINT_WEIGHT * np.eye(len(point)))
    faint = np.sqrt(np.diagonal(alone))
    alike = np.abs(alone) > ALIKE_CORRELATION * np.outer(faint, faint)
    return fit._replace(
        deviation=deviation,
        root=root,
        shown=faint < SHOWN,
        alike=alike,
        colored=colored,
    )


def _information(
    problem: Problem, point: Float64, size: Float64
) -> tuple[Float64, Float64, Float64]:
    """Return residuals (rows,), their scores (rows, unknowns) and the information of the data
    (unknowns, unknowns), in units of the prior.
    """
    low, high = problem.unknowns.bounds
    prior = problem.unknowns.spread(point)
    scale = np.maximum(np.abs(point), 1.0)
    axes = np.diag(FIRST_PASS_CHANGE * scale)
    spans = np.ones(len(point))
    for _ in range(PASSES):
        changes = np.clip(np.vstack([point + axes, point - axes]), low, high) - point
        table = weighted(problem.fitted(point, changes), size)
        residual, matrix = table[:, 0], table[:, 1:] * prior
        square = float(residual @ residual) / max(len(residual) - len(point), 1)
        data = matrix.T @ matrix / square
        before = spans
        axes, spans = axes_of(data + PRIOR_WEIGHT * np.eye(len(point)), scale / prior)
        axes = axes * prior
        if (np.abs(np.log(spans / before)) < SAME_LENGTH).all():
            break
    return residual, matrix * residual[:, None] / square, data


def fit(starts: Sequence[Problem], evaluations: int, progress: Callable[[], object]) -> Fit:
    """Fit from the best of ``starts``, with at most ``evaluations`` of each problem."""
    solver = partial(solve, evaluations=evaluations, progress=progress)
    problem, point = _best_start(starts, solver)
    coarse = problem.coarse()
    if coarse is not problem:
        point = solver(coarse, point, tolerance=ROUGH_TOLERANCE).point
    result = with_certainty(solver(problem, point))
    # The effects that lower the held-out error, the most helpful first.
    while result.colored > COLORED:
        trial = _with_effect(result, solver)
        if trial is result:
            break
        result = trial
    return _without_sender(result, solver)


def _best_start(starts: Sequence[Problem], solver: partial[Fit]) -> tuple[Problem, Float64]:
    """Return the problem and the point of the start with the least error after a short fit."""
    point = starts[0].unknowns.start
    if len(starts) == 1:
        return starts[0], point
    least = np.inf
    for start in starts:
        coarse = start.coarse()
        end = solver(
            coarse,
            start.unknowns.start,
            evaluations=TRIAL,
            tolerance=ROUGH_TOLERANCE,
        ).point
        error = float(np.linalg.norm(size_of(coarse.fitted(end))))
        if error < least:
            problem = start
            point = end
            least = error
    return problem, point


def _without_sender(result: Fit, solver: partial[Fit]) -> Fit:
    """Return a fit without the delay and the lag of setpoints, or one of them, if the held-out
    error is about the same.

    Intervals stay as wide as with them: the motor's delay may be theirs in part.
    """
    error = _left(result)
    for kinds in (SENDER, SENDER[1:], SENDER[:1]):
        unknowns = result.problem.unknowns
        is_kept = np.array([entry.kind not in kinds for entry in unknowns.entries])
        if is_kept.all():
            continue
        problem = replace(result.problem, unknowns=unknowns.only(is_kept))
        smaller = solver(problem, result.point[is_kept])
        if _left(smaller._replace(size=result.size)) * KEPT <= error:
            return smaller._replace(
                deviation=result.deviation[is_kept],
                root=result.root[is_kept],
                shown=result.shown[is_kept],
                alike=result.alike[np.ix_(is_kept, is_kept)],
                dropped=kinds,
                effects=result.effects,
            )
    return result


def _with_effect(result: Fit, solver: partial[Fit]) -> Fit:
    """Return a fit with the effect whose linear step leaves the least held-out error, or the fit
    itself.
    """
    problem = result.problem
    unknowns = problem.unknowns
    present = [entry.kind for entry in unknowns.entries]
    effects = [effect for effect in EFFECTS if effect not in present]
    if not effects:
        return result
    # All effects at once, at the values where they are none.
    zero = np.zeros(len(unknowns.joints))
    kinds = [kind for effect in effects for kind in kinds_of(effect)]
    wider = unknowns.adding(kinds, {"load_friction": zero, "static": zero})
    wide = replace(problem.coarse(), unknowns=wider)
    count = len(present)
    point = np.append(result.point, wider.start[count:])
    changes = inward(point, FIRST_CHANGE * np.eye(len(point)), *wider.bounds)
    triangle = triangle_of(wide, point, wide.fitted(point, changes), result.size)
    low, high = wider.bounds - point
    names = np.array([entry.kind for entry in wider.entries])
    steps = np.zeros((len(effects), len(point)))
    for step, effect in zip(steps, effects, strict=True):
        is_free = np.isin(names, [*present, *kinds_of(effect)])
        columns = triangle[:, np.append(True, is_free)]
        step[is_free], _ = bounded_step(columns, DAMPING, low[is_free], high[is_free])
    before, *after = np.linalg.norm(wide.errors(point, steps) / result.size, axis=1).tolist()
    best = int(np.argmin(after))
    # A linear step is no fit: half of the decrease will do.
    if after[best] > 0.5 * (1 + EFFECTS[effects[best]]) * before:
        return result
    is_used = np.isin(names, [*present, *kinds_of(effects[best])])
    trial = replace(wide, unknowns=wider.only(is_used))
    start = (point + steps[best])[is_used]
    further = solver(trial, start, tolerance=ROUGH_TOLERANCE)
    share = _left(further._replace(size=result.size)) / before
    if share > EFFECTS[effects[best]]:
        return result
    trial = replace(trial, windows=problem.windows)
    further = solver(trial, further.point)
    added = {**result.effects, effects[best]: share}
    return with_certainty(further._replace(effects=added))


def _left(fit: Fit) -> float:
    """Return the held-out error over the size of the residuals, with free initial states."""
    return float(np.linalg.norm(fit.problem.errors(fit.point)[0] / fit.size))
