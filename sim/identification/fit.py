r"""Fit: nonlinear least squares of simulated against measured positions, and its intervals.

A log of efforts is simulated in windows, each from a free initial state, whose effect is projected
out of residuals and derivatives (H. G. Bock, "Recent advances in parameter identification
techniques for ODE", 1983). A log of setpoints is simulated as a whole. Residuals over their size,
with the loss of SciPy's "soft_l1" against outliers, and the unknowns' distances from the prior are
minimised by ``scipy.optimize.least_squares``. All candidates of an evaluation - the present point,
one change of each unknown and of each initial state - are simulated in one batch.

Intervals are a jackknife over parts of the logs, combined with the curvature. With derivatives J
and weighted residuals r of all rows, prior precision P and H = J^T J + P, the estimate without the
part g of the rows is, to first order::

    x_g = x + (H - J_g^T J_g)^-1 J_g^T r_g

(B. Efron, "The jackknife, the bootstrap and other resampling plans", SIAM 1982). The parts are ten
stretches of equal length of all logs, so that residuals that are correlated in time and differences
between the logs count. The variance is the larger of the jackknife's and
s^2 H^-1, with the mean square s^2 of the residuals, and the square of the step that is left,
H^-1 J^T r: a fit that stops early, or leans on its prior, is off by it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64
from batchpid.arrays.trees import structure
from batchpid.sim.identification.regression import LogData
from batchpid.sim.identification.simulator import PlantCandidates, Stretch, simulate
from batchpid.sim.identification.unknowns import KINDS, Unknowns

WINDOW = 0.3
"""Length of a window of a log of efforts [s]."""
PAST = 0.1
"""Time before a window whose commands may still act in it [s]."""
SETTLE = 0.3
"""Time after the start of a log under the PID law in which the initial state is forgotten [s]: it
is not fitted.
"""
HELD_OUT = 0.25
"""Share of each log, at its end, that is held out."""
MOST_WINDOWS = 500
"""Largest number of windows; of more, evenly spaced ones are used."""
MOST_NUMBERS = 2**24
"""Largest number of entries of the derivatives; of more, evenly spaced rows are fitted."""
ENVS = 2048
"""Most simulations at once."""
STEP = 1e-3
"""Change of an unknown's coordinate for a finite difference."""
STATE_STEPS = 1e-3, 1e-2
"""Changes of initial positions and velocities."""
FARTHEST = 3.0
"""Bound of the residuals [rad or m], reached where a simulation diverges."""
OUTLIER = 2.0
"""Ratio of a residual to its size above which its weight in the loss decreases."""
ROUNDS = 4
"""Most fits, each with residuals of the size that the one before has left."""
SETTLED = 0.5
"""Ratio of that size to the one before from which no further fit follows."""
SHORT = 2e-3
"""Delay of setpoints up to which the fit is repeated without it [s]."""
EVIDENCE = 5.0
"""Least decrease of the cost for such a delay: about three standard deviations."""
PARTS = 10
"""Number of parts of the logs for the jackknife."""
INTERVAL = 2.0
"""Half width of a 95 % interval, over the standard deviation."""
LEAST = 2.5e-3
"""Least standard deviation over the value: the fit ends at changes of a thousandth."""
SHOWN = 0.7
"""Ratio of the standard deviation to the prior's from which an unknown counts as not identified."""


class Window(NamedTuple):
    """Stretch of a log to simulate, and the rows of the log that it is compared with."""

    log: int
    stretch: Stretch
    measured: Float64
    """Positions (rows, joints)."""
    time: Float64
    """Times (rows,) [s]."""
    fitted: Any
    """Fitted rows; the others are held out (rows,) bool."""


class FitResiduals(NamedTuple):
    """Residuals of each window (rows, joints), and their changes (rows, joints, n)."""

    residuals: list[Float64]
    changes: list[Float64]


class Solution(NamedTuple):
    """Result of a fit."""

    point: Float64
    """Coordinates of the unknowns."""
    size: Float64
    """Size of the residuals that the fit was weighted with (joints,)."""
    cost: float
    converged: bool


class Intervals(NamedTuple):
    """Uncertainty of values, in their units."""

    deviation: Float64
    """Standard deviations (unknowns,)."""
    correlation: Float64
    """(unknowns, unknowns)."""
    shown: Bool
    """Unknowns that the logs say something about (unknowns,)."""


class Fit(NamedTuple):
    """A fit of the unknowns that the logs show."""

    hidden: Unknowns
    """Unknowns that the logs do not identify; they have the values of ideal motors."""
    fitted: Problem
    """Problem of the fitted windows."""
    problem: Problem
    """Problem of all windows."""
    solution: Solution
    intervals: Intervals


@dataclass(frozen=True, eq=False)
class Problem:
    """Windows of logs, the simulation of each log, and the unknowns."""

    data: Sequence[LogData]
    windows: Sequence[Window]
    unknowns: Unknowns
    run: Callable[..., Any] = map
    """Map over groups of windows: ``map``, or that of worker processes."""

    def evaluate(
        self, point: Float64, changes: Float64 | None = None, free_states: bool = True
    ) -> FitResiduals:
        """Return residuals at a point (unknowns,), and their changes by ``changes`` (n, unknowns)
        of the point; None: none.

        Initial states of windows of efforts are projected out if they are free.
        """
        joints = self.windows[0].measured.shape[1]
        changes = np.zeros((0, len(point))) if changes is None else changes
        free = free_states and self.data[0].drive.params is None
        shifts = np.diag(np.repeat(STATE_STEPS, joints if free else 0))
        # Rows: the point, a change of each unknown, a change of each initial state.
        count = 1 + len(changes)
        points = np.tile(point, (count + len(shifts), 1))
        points[1:count] += changes
        states = np.zeros((len(points), 2, joints))
        states[count:] = shifts.reshape(-1, 2, joints)
        candidates = self.unknowns.candidates(self.unknowns.values(points))
        groups = self._groups(len(points))
        tasks = [self._task(group, candidates, states) for group in groups]
        residuals: list[Any] = [None] * len(self.windows)
        slopes: list[Any] = [None] * len(self.windows)
        for group, tables in zip(groups, self.run(_simulated, tasks), strict=True):
            for number, table in zip(group, tables, strict=True):
                errors = self.windows[number].measured - table
                errors = np.clip(errors, -FARTHEST, FARTHEST)
                change = np.moveaxis(errors[1:] - errors[0], 0, 2)
                residual, slope = _projected(errors[0], change, count - 1)
                residuals[number] = residual
                slopes[number] = slope
        return FitResiduals(residuals, slopes)

    def _task(self, group: list[int], candidates: PlantCandidates, states: Float64) -> Any:
        """Return the arguments of :func:`simulate` for a group of windows."""
        parts = [self.data[self.windows[number].log] for number in group]
        drive = parts[0].drive
        if drive.params is not None:
            params: Any = zip(*[part.drive.params for part in parts], strict=True)
            drive = drive._replace(params=bp.PIDParams(*map(_stacked, params)))
        stretches = [self.windows[number].stretch for number in group]
        return parts[0].plant, drive, candidates, states, stretches

    def _groups(self, candidates: int) -> list[list[int]]:
        """Return the numbers of windows that are simulated at once."""
        alike = defaultdict[Any, list[int]](list)
        for number, window in enumerate(self.windows):
            part = self.data[window.log]
            alike[id(part.plant), structure(part.drive.params)].append(number)
        many = max(1, ENVS // candidates)
        groups = []
        for numbers in alike.values():
            groups += [numbers[at : at + many] for at in range(0, len(numbers), many)]
        return groups

    def start_error(self) -> float:
        """Return the size of the residuals at the start, over all joints."""
        return float(np.linalg.norm(self.size(self.evaluate(self.unknowns.start))))

    def fit(self, evaluations: int, progress: Callable[[], Any] | None = None) -> Fit:
        """Return the fit: first of all unknowns, then of those that the logs show, then without a
        short delay of setpoints if that explains the logs as well.
        """
        fitted = replace(self, windows=[window for window in self.windows if window.fitted.any()])
        solution = fitted.solve(self.unknowns.start, evaluations, None, progress)
        intervals = fitted.intervals(solution)
        values = self.unknowns.values(solution.point[None])[0]
        shown = intervals.shown
        late = [entry.kind == "setpoint_delay" for entry in self.unknowns.entries]
        brief = late & (np.abs(values) < SHORT)
        stays = np.ones(len(values), bool)
        for mask, evidence in ((shown, np.inf), (shown & ~brief, EVIDENCE)):
            if mask.sum() == stays.sum():
                continue
            # The other unknowns make up for a delay, as their correlations say.
            deviation = intervals.deviation
            moved = (brief & ~mask) * values / deviation @ intervals.correlation * deviation
            unknowns = self.unknowns.only(mask)
            point = unknowns.points((values - moved)[None, mask])[0]
            other = replace(fitted, unknowns=unknowns)
            usual = other.solve(point, evaluations, solution.size, progress)
            if usual.cost < solution.cost + evidence:
                fitted, solution, stays = other, usual, mask
        hidden = self.unknowns.only(~stays)
        problem = replace(self, unknowns=fitted.unknowns)
        return Fit(hidden, fitted, problem, solution, fitted.intervals(solution))

    def solve(
        self,
        start: Float64,
        evaluations: int,
        size: Float64 | None = None,
        progress: Callable[[], Any] | None = None,
    ) -> Solution:
        """Return the fit from a point ``start``, with residuals of a ``size`` (joints,), or that at
        the start.

        The size of residuals that are left may be far smaller, which would give the prior too much
        weight: further fits follow until it stays.
        """
        from scipy.optimize import least_squares

        steps = STEP * np.eye(len(start))
        cache = dict[bytes, FitResiduals]()

        def at(point: Float64) -> FitResiduals:
            if point.tobytes() not in cache:
                cache.clear()
                cache[point.tobytes()] = self.evaluate(point, steps)
                if progress is not None:
                    progress()
            return cache[point.tobytes()]

        size = self.size(at(start)) if size is None else size
        point = start
        for _ in range(ROUNDS):
            weight = size

            def residual(point: Float64, weight: Float64 = weight) -> Float64:
                return self.system(at(point), point, weight)[0]

            def derivative(point: Float64, weight: Float64 = weight) -> Float64:
                return self.system(at(point), point, weight)[1]

            optimum = least_squares(
                residual,
                point,
                derivative,
                x_scale="jac",
                loss="soft_l1",
                f_scale=OUTLIER,
                ftol=1e-4,
                xtol=1e-4,
                gtol=1e-8,
                max_nfev=evaluations,
            )
            point = optimum.x
            evaluations -= optimum.nfev
            size = self.size(at(point))
            if evaluations < 1 or np.median(size / weight) > SETTLED:
                break
        return Solution(point, weight, float(optimum.cost), optimum.status > 0)

    def system(
        self, evaluation: FitResiduals, point: Float64, size: Float64
    ) -> tuple[Float64, Float64]:
        """Return residuals and derivatives (n, unknowns), by changes of STEP, of the fitted rows
        over their ``size``, then of the prior.
        """
        rows = sum(int(window.fitted.sum()) for window in self.windows)
        every = 1 + rows * len(size) * len(point) // MOST_NUMBERS
        residuals = list[Float64]()
        slopes = list[Float64]()
        for window, residual, slope in zip(self.windows, *evaluation, strict=True):
            residuals.append((residual[window.fitted][::every] / size).ravel())
            slopes.append(
                (slope[window.fitted][::every] / (STEP * size[:, None])).reshape(-1, len(point))
            )
        mean, spread = self.unknowns.prior
        residuals.append((point - mean) / spread)
        slopes.append(np.diag(1 / spread))
        return np.concatenate(residuals), np.concatenate(slopes)

    def size(self, evaluation: FitResiduals) -> Float64:
        """Return the size of fitted residuals (joints,): the root mean square, the largest tenth of
        each joint cut.
        """
        rows = zip(self.windows, evaluation.residuals, strict=True)
        errors = np.abs(np.concatenate([residual[window.fitted] for window, residual in rows]))
        errors = np.minimum(errors, np.quantile(errors, 0.9, axis=0))
        noise: Float64 = np.sqrt((errors**2).mean(0)) + 1e-9
        return noise

    def error(self, point: Float64, free_states: bool = True) -> Float64:
        """Return the root mean square (joints,) of the position error at the held-out rows; at all
        rows if none is held out.
        """
        residuals = self.evaluate(point, None, free_states).residuals
        judged = any(not window.fitted.all() for window in self.windows)
        rows = []
        for window, residual in zip(self.windows, residuals, strict=True):
            rows.append(residual[~window.fitted] if judged else residual)
        deviations: Float64 = np.sqrt((np.concatenate(rows) ** 2).mean(0))
        return deviations

    def intervals(self, solution: Solution) -> Intervals:
        """Return the intervals at a solution, from derivatives by the values: their
        coordinates have none where an effect is off.
        """
        unknowns = self.unknowns
        entries = unknowns.entries
        values = unknowns.values(solution.point[None])[0]
        sizes = np.array([entry.size for entry in entries])
        change = 0.01 * np.maximum(np.abs(values), sizes)
        point = unknowns.points(values[None])[0]
        further = unknowns.points(values + np.diag(change))
        prior = np.array([KINDS[entry.kind].spread for entry in entries])
        prior *= np.maximum(np.abs(values) / sizes, 1.0)
        evaluation = self.evaluate(point, further - point)
        blocks = self._blocks(evaluation, solution, STEP * sizes / change)
        total = sum(matrix.T @ matrix for matrix, _ in blocks)
        moment = sum(matrix.T @ residual for matrix, residual in blocks)
        count = sum(len(residual) for _, residual in blocks)
        square = sum(float(r @ r) for _, r in blocks) / max(count - len(point), 1)
        hessian = total + np.diag(square / prior**2)
        inverse = np.linalg.inv(hessian)
        shifts = []
        for matrix, residual in blocks:
            shifts.append(np.linalg.solve(hessian - matrix.T @ matrix, matrix.T @ residual))
        change = np.array(shifts) - np.mean(shifts, axis=0)
        jackknife = (len(shifts) - 1) / len(shifts) * (change**2).sum(0)
        curvature = square * np.diagonal(inverse)
        variance = np.maximum(jackknife, curvature) + (inverse @ moment) ** 2
        deviation = np.sqrt(np.minimum(variance, prior**2)) * sizes
        scale = np.sqrt(np.diagonal(inverse))
        return Intervals(
            np.maximum(deviation, LEAST * np.abs(values)),
            inverse / scale[:, None] / scale,
            np.sqrt(curvature) < SHOWN * prior,
        )

    def _blocks(
        self, evaluation: FitResiduals, solution: Solution, factors: Float64
    ) -> list[tuple[Float64, Float64]]:
        """Return derivatives (rows, unknowns) and residuals (rows,) of each part, weighted as by
        the loss.
        """
        residual, matrix = self.system(evaluation, solution.point, solution.size)
        rows = len(residual) - len(solution.point)  # the last ones are of the prior
        weight = (1 + (residual[:rows] / OUTLIER) ** 2) ** -0.25
        residual = weight * residual[:rows]
        matrix = weight[:, None] * matrix[:rows] * factors
        cuts = np.array_split(np.arange(rows), PARTS)
        return [(matrix[cut], residual[cut]) for cut in cuts]


def _simulated(task: Any) -> list[Float64]:
    return simulate(*task)


def _stacked(rows: Any) -> Any:
    """Return the rows of several logs as one array; other options are equal in all logs."""
    return np.concatenate(rows) if isinstance(rows[0], np.ndarray) else rows[0]


def _projected(residual: Float64, change: Float64, count: int) -> tuple[Float64, Float64]:
    """Return residual (rows, joints) and the first ``count`` of the changes (rows, joints, n)
    without what the other changes explain.
    """
    slope = change[..., :count]
    basis = change[..., count:]
    if not basis.shape[2]:
        return residual, slope
    basis = basis.reshape(residual.size, -1)
    q, _ = np.linalg.qr(basis / (np.linalg.norm(basis, axis=0) + 1e-12))
    flat = residual.reshape(-1)
    table = slope.reshape(residual.size, -1)
    left = flat - q @ (q.T @ flat)
    return left.reshape(residual.shape), (table - q @ (q.T @ table)).reshape(slope.shape)


def windows_of(data: Sequence[LogData]) -> list[Window]:
    """Return the windows of logs, one for each log of setpoints. A window begins where the held-out
    part begins.
    """
    windows = list[Window]()
    for number, (log, motion, _, drive) in enumerate(data):
        dt = drive.timestep
        total = len(motion.qpos) - 1
        share = {None: 1 - HELD_OUT, False: np.inf, True: -1.0}[log.settings.held_out]
        if drive.params is not None:
            windows.append(_window(number, data[number], 0, total, share))
            continue
        # Windows of the fitted part, then of the held-out part; the filter begins at the edge.
        edge = round(0.05 / dt)
        split = int(np.clip(share, 0.0, 1.0) * total)
        first = max(split + 1, edge)
        length = min(round(WINDOW / dt), max(total - first, split - edge))
        starts = [*range(edge, split - length + 1, length)]
        starts += range(first, total - length + 1, length)
        windows += [_window(number, data[number], at, at + length, share) for at in starts]
    return windows[:: 1 + len(windows) // MOST_WINDOWS]


def _window(number: int, data: LogData, first: int, last: int, share: float) -> Window:
    """Return the window from sim step ``first`` to ``last`` of the log's grid."""
    log, motion, _, drive = data
    dt = drive.timestep
    settle = min(SETTLE, 0.2 * log.seconds) if drive.params is not None else 0.0
    at = (log.time - log.time[0]) / dt
    rows = np.flatnonzero((at > first + settle / dt + 1e-6) & (at <= last + 1e-6))
    step = np.maximum(np.ceil(at[rows] - 1e-6).astype(int), first + 1)
    before = np.maximum(step - at[rows], 0.0) * dt
    past = round(PAST / dt)
    commands = np.maximum(np.arange(first - past, last), 0)
    forward = None if motion.feedforward is None else motion.feedforward[commands]
    qpos, qvel = (motion.qpos[first], motion.qvel[first]) if first else log.start
    command = motion.command[commands]
    stretch = Stretch(qpos, qvel, command, past, forward, step - first - 1, before)
    fitted = log.time[rows] <= log.time[0] + share * log.seconds
    return Window(number, stretch, log.qpos[rows], log.time[rows], fitted)
