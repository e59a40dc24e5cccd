r"""Uncertainty of a fit: covariance, intervals, and unidentified unknowns.

The residuals of a fit are not white: the feedback loop filters the sensors' noise, and no model is exact. With weighted
residuals r and Jacobian J of the N rows of each joint, the covariance of the estimates for coloured residuals is::

    cov = H^-1 S H^-1,     H = J^T J,     S = sum over joints, k and l of J_k^T c(k - l) J_l

c is the autocovariance of the joint's residuals, tapered (E. A. Morelli and V. Klein, "Accuracy of aerodynamic model
parameters estimated from flight test data", Journal of Guidance, Control, and Dynamics 20(1), 1997). For white
residuals it is H^-1. What the residuals of a log cannot show, such as friction that depends on load or temperature,
shows in the scatter of the parts of the logs. The estimate without part p is theta - (H - H_p)^-1 (J^T r - J_p^T r_p),
and the jackknife makes of these a variance of the estimate (B. Efron, The Jackknife, the Bootstrap and Other Resampling
Plans, SIAM, 1982); where it exceeds cov, the excess is added.

Small singular values of J, in units of typical sizes, mark combinations of unknowns that a log does not show.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.fit import Solution
from batchpid.sim.identification.problem import NOISES, Problem

MEMORY = 1.0
"""Longest lag of the autocovariance [s]."""
MODEL_ERROR = 2.0
"""Factor of the standard deviations that allows for errors of the model, such as friction near rest under a law that
sees noise. Without it 30 % of the intervals missed the truth on logs of a two-joint arm in MuJoCo."""
LEAST_DEVIATION, LEAST_OF_BIAS = 5e-3, 2e-2
"""Least standard deviation of an unknown, over its estimate, and of a bias: no model is more exact."""
PARTS, LEAST_PARTS = 10, 4
"""Most parts of the logs, each a stretch or more, that the jackknife leaves out in turn, and least number of them."""
INTERVAL = 1.96
"""Half width of a 95 % interval, in standard deviations."""
RESOLVED, DELAY_RESOLVED = 0.05, 0.1
"""Largest half width of an interval, over the estimate, of an unknown that counts as identified, and of the delay."""

LEAST_MOTION = 30.0
"""Least standard deviation of a joint's positions, over their noise, of a joint that is moved and not only shaken."""
LARGEST_MISFIT = 1.5
"""Largest of the :func:`misfits` of a right model. Measured: up to 1.2 for right models, 4 to 12 for wrong ones."""


class Uncertainty(NamedTuple):
    """Uncertainty of the unknowns (unknowns,)."""

    deviation: Float64
    """Standard deviations."""
    identified: NDArray[np.bool_]
    moves: NDArray[np.bool_]
    """Joints (joints,) that the motion moves, and not only the noise of their sensor."""
    singular_values: Float64
    """Singular values of the Jacobian in units of typical sizes, over the largest, descending."""
    correlation: Float64
    """Correlations of the estimates (unknowns, unknowns)."""

    def plus(self, kinds: list[str], estimate: Float64, deviation: Float64) -> Uncertainty:
        """Return the uncertainty with further values (n,) of some ``kinds``."""
        more, own = _resolved(kinds, estimate, deviation), len(self.deviation)
        correlation = np.eye(own + len(kinds))
        correlation[:own, :own] = self.correlation
        return self._replace(
            deviation=np.append(self.deviation, deviation),
            identified=np.append(self.identified, more),
            correlation=correlation,
        )


def uncertainty(problem: Problem, point: Solution) -> Uncertainty:
    """Return the uncertainty of the fitted ``point``."""
    unknowns = problem.unknowns
    count = len(unknowns.scale)
    normal, spread = np.zeros((count, count)), np.zeros((count, count))
    weights = _sizes_of_rows(problem, point)
    covariances = _autocovariances(problem, point, weights)
    for evaluation, window, sigma in zip(point.windows, problem.windows, weights, strict=True):
        jacobian = evaluation.jacobian
        for joint in range(jacobian.shape[1]):
            columns = np.nan_to_num(jacobian[window.fitted, joint] * unknowns.scale) / sigma[:, joint, None]
            if not len(columns):
                continue
            normal += columns.T @ columns
            length = 2 ** int(np.ceil(np.log2(len(columns) + len(covariances))))
            c = np.zeros(length)
            c[: len(covariances)] = covariances[:, joint]
            c[-len(covariances) + 1 :] = covariances[1:, joint][::-1]
            power = np.maximum(np.fft.rfft(c).real, 0.0)
            spectrum = np.fft.rfft(columns, length, axis=0)
            both_sides = np.full(len(power), 2.0)
            both_sides[[0, -1]] = 1.0
            spread += ((spectrum.conj() * (both_sides * power)[:, None]).T @ spectrum).real / length
    prior = (unknowns.scale / unknowns.spread) ** 2
    inverse = np.linalg.inv(normal + np.diag(prior))
    covariance = inverse @ (spread + np.diag(prior)) @ inverse
    variance = np.maximum(np.diagonal(covariance), np.diagonal(inverse))
    parts = _parts(problem, point)
    excess = np.maximum(jackknife_variance(parts, prior) - variance, 0.0)
    own = unknowns.scale * np.sqrt(MODEL_ERROR**2 * variance + excess)
    deviation = np.hypot(own, LEAST_DEVIATION * np.abs(point.theta))
    values = np.sqrt(np.maximum(np.linalg.eigvalsh(normal)[::-1], 0.0))
    moves = _motion(problem) > LEAST_MOTION * problem.noise / NOISES
    known = np.array([joint is None or moves[joint] for _, joint in unknowns.names])
    identified = known & _resolved([kind for kind, _ in unknowns.names], point.theta, deviation)
    raised = covariance + np.diag(variance - np.diagonal(covariance))
    correlation = raised / np.sqrt(np.outer(variance, variance))
    return Uncertainty(deviation, identified, moves, values / max(values[0], 1e-300), correlation)


def _resolved(kinds: list[str], estimate: Float64, deviation: Float64) -> NDArray[np.bool_]:
    """Return which intervals are narrow enough to count as identified."""
    most = np.array([DELAY_RESOLVED if kind == "delay" else RESOLVED for kind in kinds])
    return np.asarray(INTERVAL * deviation <= most * np.abs(estimate))


def _parts(problem: Problem, point: Solution) -> list[tuple[Float64, Float64]]:
    """Return J^T J and J^T r of parts of the logs, in units of typical sizes, in order of time."""
    tables, sizes = [], iter(point.sizes)
    for evaluation, stretches in zip(point.windows, problem.stretches, strict=True):
        for rows in stretches:
            size = next(sizes)[:, None]
            jacobian = np.nan_to_num(evaluation.jacobian[rows] * problem.unknowns.scale) / size
            columns = np.concatenate([jacobian, evaluation.white[rows][..., None] / size], axis=2)
            flat = columns.reshape(-1, columns.shape[2])
            tables.append(flat.T @ flat)
    parts = [sum(part) for part in np.array_split(np.array(tables), min(PARTS, len(tables)))]
    return [(part[:-1, :-1], part[:-1, -1]) for part in parts]


def jackknife_variance(parts: list[tuple[Float64, Float64]], prior: Float64) -> Float64:
    """Return the variances (unknowns,) of the estimates, from those without each of the parts in turn.

    ``parts`` are J^T J and J^T r; ``prior`` is the information of the prior (unknowns,). It is 0 for too few parts.
    """
    count = len(parts)
    if count < LEAST_PARTS:
        return np.zeros(len(prior))
    whole, gradient = sum(part[0] for part in parts) + np.diag(prior), sum(part[1] for part in parts)
    estimates = np.array([np.linalg.solve(whole - own, gradient - pull) for own, pull in parts])
    return (count - 1) / count * ((estimates - estimates.mean(0)) ** 2).sum(0)


def misfits(problem: Problem, point: Solution) -> Float64:
    """Return the held-out residuals of each joint over their standard deviations by sensor noise alone (joints,)."""
    held_out = zip(point.windows, problem.windows, strict=True)
    ratios = np.concatenate([(each.residual / each.expected)[~window.fitted] for each, window in held_out])
    with np.errstate(invalid="ignore", over="ignore"):
        sizes = np.sqrt((ratios**2).mean(0))
    return np.where(np.isfinite(sizes), sizes, np.inf)


def _motion(problem: Problem) -> Float64:
    """Return the standard deviations of the fitted positions (joints,) [rad or m]."""
    return np.concatenate([window.measured[window.fitted] for window in problem.windows]).std(0)


def _autocovariances(problem: Problem, point: Solution, weights: list[Float64]) -> Float64:
    """Return the tapered autocovariances of the residuals over ``weights`` of each joint (lags, joints)."""
    lags = max(round(MEMORY / float(np.median(np.diff(log.time)))) for log in problem.logs)
    parts = [e.white[w.fitted] / s for e, w, s in zip(point.windows, problem.windows, weights, strict=True)]
    parts = [part for part in parts if len(part)]
    lags = max(2, min(lags, max(map(len, parts)) // 2))  # a short stretch must not reduce the lags
    total = np.zeros((lags, parts[0].shape[1]))
    for part in parts:
        length = 2 ** int(np.ceil(np.log2(len(part) + lags)))
        spectrum = np.abs(np.fft.rfft(part, length, axis=0)) ** 2
        total += np.fft.irfft(spectrum, length, axis=0)[:lags]
    taper = 1 - np.arange(lags) / lags
    return taper[:, None] * total / sum(map(len, parts))


def _sizes_of_rows(problem: Problem, point: Solution) -> list[Float64]:
    """Return the size of the residuals of each fitted row of each window (rows, joints)."""
    sizes = iter(point.sizes)
    return [
        np.concatenate([np.tile(next(sizes), (len(rows), 1)) for rows in stretches])
        if stretches
        else np.zeros((0, len(problem.joints)))
        for stretches in problem.stretches
    ]
