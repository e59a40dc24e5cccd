r"""Fit of simulated motions to logs: maximum likelihood by nonlinear least squares.

The negative logarithm of the likelihood (:mod:`batchpid.sim.identification.problem`) depends on the sizes sigma of the
residuals r. Since log(x) <= x - 1, it decreases whenever the weighted sum of squares does::

    sum over rows and joints of (r / sigma)^2 + sum over unknowns of ((theta - m) / s)^2

with the sizes before the step and a weak prior of means m and standard deviations s. Steps that reduce it, by
``scipy.optimize.least_squares`` in a trust region within the bounds (M. A. Branch, T. F. Coleman and Y. Li, "A
subspace, interior, and conjugate gradient method for large-scale bound-constrained minimization problems", SIAM Journal
on Scientific Computing 21, 1999), alternate with new sizes.

Residuals and Jacobian of a joint in a stretch, [J r], have many rows. The steps depend on its products of columns only,
so the triangular QR factor of [J r], which has the same products, takes its place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.errors import InvalidArgumentError
from batchpid.sim.identification.problem import FitEvaluation, Problem

GAIN, LEAST_GAIN, STEP = 5e-3, 2e-4, 0.1
"""The fit ends with a step that decreases the cost by less than LEAST_GAIN, or by less than GAIN if it is shorter than
STEP standard deviations of the unknowns; and if linear residuals promise less than LEAST_GAIN."""
TRIES = 4
"""Most evaluations for one good step."""
_ONE_STEP = 1.0
"""Relative tolerance of the sum of squares that ends least_squares with its first good step."""
_INSIDE = 1e-9
"""Least distance of points from the bounds, over typical sizes."""


class FitStep(NamedTuple):
    """State of a fit before a step: all that the rest of the fit depends on."""

    theta: Float64
    """Point (unknowns,)."""
    left: int
    """Evaluations that are left."""
    last: Float64
    """Point before the last step; ``theta`` at the start."""
    cost: float
    """Cost there; inf at the start."""

    @classmethod
    def first(cls, theta: Float64, evaluations: int) -> FitStep:
        """Return the state at the start of a fit."""
        return cls(theta, evaluations, theta, np.inf)


class Solution(NamedTuple):
    """Best point of a fit."""

    theta: Float64
    cost: float
    """Negative logarithm of the likelihood, over rows and joints."""
    sizes: Float64
    """Sizes of the residuals (stretches, joints) [rad or m]."""
    windows: list[FitEvaluation]
    promised: float
    """Further decrease of the cost that linear residuals would allow; not small if the fit stopped before an
    optimum."""


def fit(problem: Problem, begin: FitStep, report: Callable[[FitStep, float], None] = lambda *_: None) -> Solution:
    """Return the best point from ``begin`` on.

    ``report`` is called before each step with the state and the cost.
    """
    from scipy.optimize import least_squares

    factors = _Factors(problem, begin.left)
    scale, spread = problem.unknowns.scale, problem.unknowns.spread
    bounds = problem.unknowns.low / scale, problem.unknowns.high / scale
    x, last, cost = _inside(begin.theta / scale, bounds), begin.last / scale, begin.cost
    if not np.isfinite(factors.at(x * scale)[0]).all():
        remedy = "check the params that drove the robot, --timestep and the units of the logs"
        raise InvalidArgumentError(
            "logs", "move otherwise than any robot that was simulated: all diverge", remedy=remedy
        )
    while True:
        factors.keep(x * scale)
        factor, sizes, windows = factors.at(x * scale)
        determinants = np.concatenate([window.determinant for window in windows])
        before, cost = cost, float(problem.costs(sizes, determinants).mean())
        report(FitStep(x * scale, factors.left, last * scale, before), cost)
        gain = before - cost
        weighed = factor / sizes[..., None, None]
        moved = np.max(np.abs(x - last) / _deviations(weighed, scale / spread))
        promised = _promised(weighed, (bounds[0] - x, bounds[1] - x)) / problem.count
        done = gain < LEAST_GAIN or (gain < GAIN and moved < STEP) or promised < LEAST_GAIN
        if done or factors.left <= 0:
            return Solution(x * scale, cost, sizes, windows, promised)

        def residuals(x: Float64, sizes: Float64 = sizes) -> Float64:
            found = factors.at(x * scale)[0][..., -1] / sizes[..., None]
            return np.append(found.ravel(), (x * scale - problem.unknowns.prior) / spread)

        def jacobian(x: Float64, sizes: Float64 = sizes) -> Float64:
            found = -factors.at(x * scale)[0][..., :-1] / sizes[..., None, None]
            return np.vstack([found.reshape(-1, len(x)), np.diag(scale / spread)])

        # One evaluation is of x itself, whose value is known.
        most = min(TRIES, factors.left) + 1
        options: Any = {"ftol": _ONE_STEP, "xtol": 1e-6, "gtol": None, "x_scale": "jac"}
        last = x
        x = _inside(least_squares(residuals, x, jacobian, bounds, max_nfev=most, **options).x, bounds)


def _inside(x: Float64, bounds: tuple[Float64, Float64]) -> Float64:
    return np.clip(x, bounds[0] + _INSIDE, bounds[1] - _INSIDE)


def _deviations(factors: Float64, prior: Float64) -> Float64:
    """Return the standard deviations of the unknowns for white noise, from the weighted factors."""
    table = factors[..., :-1].reshape(-1, len(prior))
    root = np.linalg.qr(np.vstack([table, np.diag(prior)]), mode="r")
    return np.linalg.norm(np.linalg.inv(root), axis=1)


def _promised(factors: Float64, bounds: tuple[Float64, Float64]) -> float:
    """Return the decrease of the negative logarithm of the likelihood by the best step within ``bounds``.

    Residuals are taken as linear, r - J d. A direction that a bound closes, such as to a payload below 0, promises
    nothing.
    """
    from scipy.optimize import lsq_linear

    table = factors.reshape(-1, factors.shape[-1])
    if not np.isfinite(table).all():
        return np.inf
    residuals = table[:, -1]
    left = residuals - table[:, :-1] @ lsq_linear(table[:, :-1], residuals, bounds, method="bvls").x
    return 0.5 * float(residuals @ residuals - left @ left)


class _Factors:
    """Triangular factors of [J r] by point, with J in units of the unknowns' typical sizes."""

    def __init__(self, problem: Problem, left: int) -> None:
        self.left = left
        self._problem = problem
        self._known: dict[bytes, tuple[Float64, Float64, list[FitEvaluation]]] = {}

    def keep(self, theta: Float64) -> None:
        """Discard all points except ``theta``."""
        self._known = {theta.tobytes(): self.at(theta)}

    def at(self, theta: Float64) -> tuple[Float64, Float64, list[FitEvaluation]]:
        """Return the factors, the sizes of the residuals, and residuals and Jacobian of all windows.

        Factors are (stretches, joints, rows, unknowns + 1), inf if the simulation diverges; sizes (stretches, joints).
        """
        key = theta.tobytes()
        if key not in self._known:
            # The one at the start does not count, so that a fit may resume there. A point that is moved off a bound
            # may be one too many.
            self.left = max(0, self.left - bool(self._known))
            self._known[key] = self._evaluate(theta)
        return self._known[key]

    def _evaluate(self, theta: Float64) -> tuple[Float64, Float64, list[FitEvaluation]]:
        problem, scale = self._problem, self._problem.unknowns.scale
        with np.errstate(invalid="ignore", over="ignore"):  # simulations that diverge end at inf
            windows = problem.evaluate(theta)
        sizes = problem.sizes([window.white for window in windows])
        count = len(theta) + 1
        factors = np.zeros((*sizes.shape, count, count))
        places = [
            (window, rows) for window, stretches in zip(windows, problem.stretches, strict=True) for rows in stretches
        ]
        for number, (window, rows) in enumerate(places):
            for joint in range(sizes.shape[1]):
                table = np.column_stack([window.jacobian[rows, joint] * scale, window.white[rows, joint]])
                if np.isfinite(table[:, -1]).all():
                    factor = np.linalg.qr(np.nan_to_num(table), mode="r")
                    factors[number, joint, : len(factor)] = factor
                else:
                    factors[number, joint] = np.inf
        return factors, sizes, windows
