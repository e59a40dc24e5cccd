r"""Confidence intervals of a fit, and the unknowns that the logs do not determine.

With the residuals r and their derivatives J in units of the prior's deviations, the information of
the data is ``J^T J / s^2`` with the mean square s^2 of the residuals. J comes from differences along
the axes of the covariance (:mod:`batchpid.sim.identification.fit`), in passes until their lengths
stay, so that a direction without effect carries no information. The prior has a quarter of its
weight: ``H = J^T J / s^2 + 1 / 4``.

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

from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Bool, Float64
from batchpid.sim.identification.fit import Iterate, Solution, axes_of, iterate, linearised
from batchpid.sim.identification.problem import Problem

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


class Certainty(NamedTuple):
    """Certainty of the unknowns of a fit."""

    deviation: Float64
    """Standard deviations (unknowns,) of the values, in their units."""
    root: Float64
    """Root L of their covariance L L^T (unknowns, unknowns), at most as wide as the prior."""
    shown: Bool
    """Mask (unknowns,) of those that the logs show."""
    alike: Bool
    """Pairs (unknowns, unknowns) that cannot be told from one another."""
    colored: float
    """Correlation of neighbouring residuals, 0 for white noise."""

    def only(self, mask: Bool) -> Certainty:
        """Return the certainty of the unknowns of a mask (unknowns,)."""
        both = np.ix_(mask, mask)
        vectors = self.deviation[mask], self.root[mask], self.shown[mask]
        return Certainty(*vectors, self.alike[both], self.colored)


def certainty(problem: Problem, solution: Solution) -> Certainty:
    """Return the certainty of a solution."""
    unknowns = problem.unknowns
    point, size, _ = solution
    prior = unknowns.spread(point)
    residual, matrix, covariance = _information(problem, solution)
    square = _mean_square(residual, len(point))
    data = matrix.T @ matrix / square
    # Stretches have independent noise.
    score = matrix * residual[:, None] / square
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
    # Correlations come from the information.
    spans, axes = np.linalg.eigh(covariance)
    lengths = np.minimum(deviation, scale) / np.sqrt(variance)
    root = lengths[:, None] * axes * np.sqrt(np.maximum(spans, 0.0))
    alone = inverse(data + FAINT_WEIGHT * np.eye(len(point)))
    faint = np.sqrt(np.diagonal(alone))
    alike = np.abs(alone) > ALIKE_CORRELATION * np.outer(faint, faint)
    return Certainty(deviation, root, faint < SHOWN, alike, colored)


def _information(problem: Problem, solution: Solution) -> tuple[Float64, Float64, Float64]:
    """Return residuals (rows,), derivatives (rows, unknowns) in units of the prior, and the inverse
    of the information with the prior's.
    """
    point, size, _ = solution
    low, high = problem.unknowns.bounds
    prior = problem.unknowns.spread(point)
    scale = np.maximum(np.abs(point), 1.0)
    axes = np.diag(FIRST_PASS_CHANGE * scale)
    spans = np.ones(len(point))
    for _ in range(PASSES):
        changes = np.clip(np.vstack([point + axes, point - axes]), low, high) - point
        place: Iterate = iterate(problem, point, changes)
        table = linearised(problem, place, size)
        residual, matrix = table[:, 0], table[:, 1:] * prior
        data = matrix.T @ matrix / _mean_square(residual, len(point))
        hessian = data + PRIOR_WEIGHT * np.eye(len(point))
        before = spans
        axes, spans = axes_of(hessian, scale / prior)
        axes = axes * prior
        if (np.abs(np.log(spans / before)) < SAME_LENGTH).all():
            break
    return residual, matrix, inverse(hessian)


def inverse(matrix: Float64) -> Float64:
    """Return the inverse of a matrix (n, n)."""
    return np.asarray(np.linalg.inv(matrix), float)


def _mean_square(residual: Float64, unknowns: int) -> float:
    return float(residual @ residual) / max(len(residual) - unknowns, 1)
