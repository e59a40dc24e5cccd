r"""Intervals of identified unknowns: a jackknife over parts of the logs, combined with the
curvature of the fit.

With derivatives J and weighted residuals r of all rows, prior precision P and H = J^T J + P, the
estimate without the part g of the rows is, to first order::

    x_g = x + (H - J_g^T J_g)^-1 J_g^T r_g

(B. Efron, "The jackknife, the bootstrap and other resampling plans", SIAM 1982). The parts are the
logs where there are five or more, else ten stretches of equal length, so that residuals that are
correlated in time and errors of the model count. The variance is the larger of the jackknife's and
s^2 H^-1, with the mean square s^2 of the residuals.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Bool, Float64
from batchpid.sim.identification.fit import OUTLIER, FitResiduals, Problem, Solution
from batchpid.sim.identification.unknowns import KINDS

PARTS, LEAST_LOGS = 10, 5
"""Number of parts of the logs; least number of logs that are the parts themselves."""
INTERVAL = 2.0
"""Half width of a 95 % interval, over the standard deviation."""
LEAST = 2.5e-3
"""Least standard deviation over the value: the fit ends at changes of a thousandth."""
SHOWN = 0.7
"""Ratio of the standard deviation to the prior's from which an unknown counts as not identified."""


class Intervals(NamedTuple):
    """Uncertainty of values, in their units."""

    deviation: Float64
    """Standard deviations (unknowns,)."""
    correlation: Float64
    """(unknowns, unknowns)."""
    shown: Bool
    """Unknowns that the logs say something about (unknowns,)."""


def intervals_of(problem: Problem, solution: Solution) -> Intervals:
    """Return the intervals at a solution, from derivatives by the values and not their
    logarithms.
    """
    unknowns, point = problem.unknowns, solution.point
    values = unknowns.values(point[None])[0]
    entries = unknowns.entries
    sizes = np.array([entry.size for entry in entries])
    further = values + np.maximum(0.01 * np.abs(values), 0.01 * sizes)
    steps = (
        np.array([entry.coordinate(value) for entry, value in zip(entries, further, strict=True)])
        - point
    )
    evaluation = problem.evaluate(point, steps)
    # Derivatives by a value over its typical size: a logarithm has none where an effect is off.
    factors = steps * sizes / (further - values)
    kinds = [KINDS[entry.kind] for entry in entries]
    positive = np.array([kind.positive for kind in kinds])
    floors = np.array([entry.floor for entry in entries])
    reach = np.where(positive, np.maximum((values - floors) / sizes, 1.0), 1.0)
    prior = np.array([kind.spread for kind in kinds]) * reach
    blocks = _blocks(problem, evaluation, solution.size, factors)
    total = sum(matrix.T @ matrix for matrix, _ in blocks)
    count = sum(len(residual) for _, residual in blocks)
    square = sum(float(residual @ residual) for _, residual in blocks) / max(count - len(point), 1)
    hessian = total + np.diag(square / prior**2)
    inverse = np.linalg.inv(hessian)
    shifts = np.array(
        [np.linalg.solve(hessian - matrix.T @ matrix, matrix.T @ r) for matrix, r in blocks]
    )
    jackknife = (len(shifts) - 1) / len(shifts) * ((shifts - shifts.mean(0)) ** 2).sum(0)
    variance = np.minimum(np.maximum(jackknife, square * np.diagonal(inverse)), prior**2)
    scale = np.sqrt(np.diagonal(inverse))
    shown = np.sqrt(square) * scale < SHOWN * prior
    deviation = np.maximum(np.sqrt(variance) * sizes, LEAST * np.abs(values))
    return Intervals(deviation, inverse / scale[:, None] / scale, shown)


def _blocks(
    problem: Problem, evaluation: FitResiduals, size: Float64, factors: Float64
) -> list[tuple[Float64, Float64]]:
    """Return derivatives (rows, unknowns) and residuals (rows,) of each part, weighted as by the
    loss.
    """
    tables = list[tuple[Float64, Float64, int]]()
    for window, residual, slope in zip(problem.windows, *evaluation, strict=True):
        error = (residual[window.fitted] / size).ravel()
        weight = (1 + (error / OUTLIER) ** 2) ** -0.25
        matrix = (slope[window.fitted] / size[:, None]).reshape(len(error), -1) * factors
        tables.append((weight[:, None] * matrix, weight * error, window.log))
    logs = sorted({log for *_, log in tables})
    if len(logs) >= LEAST_LOGS:
        parts = [[table for table in tables if table[2] == log] for log in logs]
        return [
            (np.concatenate([m for m, *_ in part]), np.concatenate([r for _, r, _ in part]))
            for part in parts
        ]
    matrix, residual = (np.concatenate([table[side] for table in tables]) for side in (0, 1))
    cuts = np.array_split(np.arange(len(residual)), PARTS)
    return [(matrix[cut], residual[cut]) for cut in cuts]
