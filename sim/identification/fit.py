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
"""Largest number of windows; if there are more, evenly spaced ones are used."""
MOST_ROWS = 40_000
"""Largest number of rows of all logs; if there are more, evenly spaced ones are used."""
ENVS = 2048
"""Most simulations at once."""
STEP = 1e-3
"""Change of an unknown's coordinate for a finite difference."""
STATE_STEPS = 1e-3, 1e-2
"""Changes of initial positions and velocities."""
FARTHEST = 3.0
"""Bound of the residuals [rad or m], reached where a simulation diverges."""
RESOLUTION = 1e-5
"""Least size of residuals [rad or m]: encoders show no less."""
OUTLIER = 2.0
"""Ratio of a residual to its size above which its weight in the loss decreases."""
ROUNDS = 4
"""Largest number of fits; each scales the residuals by the size that the last one left."""
SETTLED = 0.5
"""Ratio of that size to the one before from which no further fit follows."""
SHORT = 2e-3
"""Delay of setpoints below which it counts as none [s]."""
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


class Solution(NamedTuple):
    """Result of a least-squares fit."""

    point: Float64
    """Coordinates of the unknowns."""
    size: Float64
    """Size of the residuals that the fit was weighted with (joints,)."""
    converged: bool


class Intervals(NamedTuple):
    """Uncertainty of values, in their units."""

    deviation: Float64
    """Standard deviations (unknowns,)."""
    root: Float64
    """Root L of the covariance L L^T (unknowns, unknowns)."""
    shown: Bool
    """Unknowns that the logs say something about (unknowns,)."""


class Fit(NamedTuple):
    """A fit of the unknowns that the logs show."""

    hidden: Unknowns
    """Unknowns that the logs do not identify; they have the values of the description."""
    problem: Problem
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
        self, point: Float64, changes: Float64, free_states: bool = True, held_out: bool = False
    ) -> list[Float64]:
        """Return the residuals of each window at a point (unknowns,), and their changes by
        ``changes`` (n, unknowns) of the point: (rows, joints, 1 + n).

        Initial states of windows of efforts are projected out if they are free. Windows without
        fitted rows are evaluated if ``held_out``, and are empty otherwise.
        """
        joints = self.windows[0].measured.shape[1]
        free = free_states and self.data[0].drive.params is None
        shifts = np.diag(np.repeat(STATE_STEPS, joints * free))
        # Rows: the point, each change of it, a change of each initial state.
        count = 1 + len(changes)
        points = np.tile(point, (count + len(shifts), 1))
        points[1:count] += changes
        states = np.zeros((len(points), 2, joints))
        states[count:] = shifts.reshape(-1, 2, joints)
        candidates = self.unknowns.candidates(self.unknowns.values(points))
        groups = self._groups(len(points), held_out)
        tasks = [self._task(group, candidates, states) for group in groups]
        tables = [np.zeros((0, joints, count))] * len(self.windows)
        for group, positions in zip(groups, self.run(_simulated, tasks), strict=True):
            for number, table in zip(group, positions, strict=True):
                errors = np.clip(self.windows[number].measured - table, -FARTHEST, FARTHEST)
                errors[1:] -= errors[0]
                tables[number] = _projected(np.moveaxis(errors, 0, 2), count)
        return tables

    def _task(self, group: list[int], candidates: PlantCandidates, states: Float64) -> Any:
        """Return the arguments of :func:`simulate` for a group of windows."""
        parts = [self.data[self.windows[number].log] for number in group]
        drive = parts[0].drive
        if drive.params is not None:
            params: Any = zip(*[part.drive.params for part in parts], strict=True)
            drive = drive._replace(params=bp.PIDParams(*map(_stacked, params)))
        stretches = [self.windows[number].stretch for number in group]
        return parts[0].plant, drive, candidates, states, stretches

    def _groups(self, candidates: int, held_out: bool) -> list[list[int]]:
        """Return the numbers of windows that are simulated at once."""
        alike = defaultdict[Any, list[int]](list)
        for number, window in enumerate(self.windows):
            part = self.data[window.log]
            if held_out or window.fitted.any():
                alike[id(part.plant), structure(part.drive.params)].append(number)
        many = max(1, ENVS // candidates)
        groups = []
        for numbers in alike.values():
            groups += [numbers[first : first + many] for first in range(0, len(numbers), many)]
        return groups

    def system(
        self, evaluation: Sequence[Float64], point: Float64, size: Float64
    ) -> tuple[Float64, Float64]:
        """Return residuals and derivatives (n, unknowns), by changes of STEP, of the fitted rows
        over their ``size``, then of the prior.
        """
        tables = []
        for window, table in zip(self.windows, evaluation, strict=True):
            if len(table):
                weighted = table[window.fitted] / size[:, None]
                tables.append(weighted.reshape(-1, 1 + len(point)))
        table = np.concatenate(tables)
        mean, spread = self.unknowns.prior
        residual = np.append(table[:, 0], (point - mean) / spread)
        return residual, np.vstack([table[:, 1:] / STEP, np.diag(1 / spread)])

    def size(self, evaluation: Sequence[Float64]) -> Float64:
        """Return the size of fitted residuals (joints,): the root mean square, the largest tenth of
        each joint cut.
        """
        errors = np.abs(_residuals(self.windows, evaluation, fitted=True))
        errors = np.minimum(errors, np.quantile(errors, 0.9, axis=0))
        return _root_mean_square(errors) + RESOLUTION

    def error(self, point: Float64, free_states: bool = True) -> Float64:
        """Return the root mean square (joints,) of the position error at the held-out rows; at all
        rows if none is held out.
        """
        still = np.zeros((0, len(point)))
        evaluation = self.evaluate(point, still, free_states, held_out=True)
        errors = _residuals(self.windows, evaluation, fitted=False)
        if not len(errors):
            errors = _residuals(self.windows, evaluation, fitted=True)
        return _root_mean_square(errors)


def fit(
    problems: Sequence[Problem], evaluations: int, progress: Callable[[], object] | None = None
) -> Fit:
    """Fit from the start with the least error: all unknowns once, then only those that the logs
    show.
    """

    def start_error(problem: Problem) -> float:
        start = problem.unknowns.start
        size = problem.size(problem.evaluate(start, np.zeros((0, len(start)))))
        return float(np.linalg.norm(size))

    problem = problems[0] if len(problems) == 1 else min(problems, key=start_error)
    unknowns = problem.unknowns
    solution = solve(problem, unknowns.start, evaluations, None, progress)
    uncertainty = intervals(problem, solution)
    shown = uncertainty.shown
    if not shown.all():
        values = unknowns.values(solution.point[None])[:, shown]
        problem = replace(problem, unknowns=unknowns.only(shown))
        start = problem.unknowns.points(values)[0]
        solution = solve(problem, start, evaluations, solution.size, progress)
        uncertainty = intervals(problem, solution)
    # Worker processes end with the fit.
    return Fit(unknowns.only(~shown), replace(problem, run=map), solution, uncertainty)


def solve(
    problem: Problem,
    start: Float64,
    evaluations: int,
    size: Float64 | None = None,
    progress: Callable[[], object] | None = None,
) -> Solution:
    """Return the fit from a point ``start``, with residuals of a ``size`` (joints,), or that at the
    start.

    The size of residuals that are left may be far smaller, which would give the prior too much
    weight: further fits follow until it stays.
    """
    from scipy.optimize import least_squares

    steps = STEP * np.eye(len(start))
    cache = dict[bytes, list[Float64]]()

    def evaluated(point: Float64) -> list[Float64]:
        if point.tobytes() not in cache:
            cache.clear()
            cache[point.tobytes()] = problem.evaluate(point, steps)
            if progress is not None:
                progress()
        return cache[point.tobytes()]

    def residual(point: Float64, weight: Float64) -> Float64:
        return problem.system(evaluated(point), point, weight)[0]

    def derivative(point: Float64, weight: Float64) -> Float64:
        return problem.system(evaluated(point), point, weight)[1]

    point = start
    if size is None:
        size = problem.size(evaluated(start))
    for _ in range(ROUNDS):
        weight = size
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
            args=(weight,),
        )
        point = optimum.x
        evaluations -= optimum.nfev
        size = problem.size(evaluated(point))
        if evaluations < 1 or np.median(size / weight) > SETTLED:
            break
    return Solution(point, weight, optimum.status > 0)


def intervals(problem: Problem, solution: Solution) -> Intervals:
    """Return the intervals at a solution, from derivatives by the values, not the coordinates: near
    0 a coordinate hardly changes its value.
    """
    unknowns = problem.unknowns
    entries = unknowns.entries
    values = unknowns.values(solution.point[None])[0]
    sizes = np.array([entry.size for entry in entries])
    change = 0.01 * np.maximum(np.abs(values), sizes)
    point = unknowns.points(values[None])[0]
    further = unknowns.points(values + np.diag(change))
    prior = np.array([KINDS[entry.kind].spread for entry in entries])
    prior *= np.maximum(np.abs(values) / sizes, 1.0)
    evaluation = problem.evaluate(point, further - point)
    residual, matrix = problem.system(evaluation, solution.point, solution.size)
    # Rows are weighted as by the loss; the last ones are of the prior.
    rows = len(residual) - len(point)
    residual = residual[:rows]
    weight = (1 + (residual / OUTLIER) ** 2) ** -0.25
    residual = weight * residual
    matrix = weight[:, None] * matrix[:rows] * (STEP * sizes / change)
    square = float(residual @ residual) / max(rows - len(point), 1)
    hessian = matrix.T @ matrix + np.diag(square / prior**2)
    inverse = np.linalg.inv(hessian)
    shifts = []
    for part in np.array_split(np.arange(len(residual)), PARTS):
        block = matrix[part]
        shifts.append(np.linalg.solve(hessian - block.T @ block, block.T @ residual[part]))
    jackknife = (PARTS - 1) * np.var(shifts, axis=0)
    curvature = square * np.diagonal(inverse)
    variance = np.maximum(jackknife, curvature) + (inverse @ matrix.T @ residual) ** 2
    deviation = np.sqrt(np.minimum(variance, prior**2)) * sizes
    deviation = np.maximum(deviation, LEAST * np.abs(values))
    # Correlations are those of the curvature.
    scale = deviation / np.sqrt(np.diagonal(inverse))
    root = scale[:, None] * np.linalg.cholesky(inverse)
    # A short delay of setpoints is left out: that of efforts explains the rest.
    late = np.array([entry.kind == "setpoint_delay" for entry in entries])
    shown = (np.sqrt(curvature) < SHOWN * prior) & ~(late & (values < SHORT))
    return Intervals(deviation, root, shown)


def _residuals(windows: Sequence[Window], evaluation: Sequence[Float64], fitted: bool) -> Float64:
    """Return the residuals (rows, joints) of the fitted rows, or of the others."""
    tables = []
    for window, table in zip(windows, evaluation, strict=True):
        if len(table):
            tables.append(table[window.fitted == fitted, :, 0])
    return np.concatenate(tables)


def _root_mean_square(errors: Float64) -> Float64:
    size: Float64 = np.sqrt((errors**2).mean(0))
    return size


def _simulated(task: Any) -> list[Float64]:
    return simulate(*task)


def _stacked(rows: Any) -> Any:
    """Return the rows of several logs as one array; other options are equal in all logs."""
    return np.concatenate(rows) if isinstance(rows[0], np.ndarray) else rows[0]


def _projected(table: Float64, count: int) -> Float64:
    """Return the first ``count`` columns of a table (rows, joints, columns) without what the others
    explain.
    """
    columns = table.reshape(-1, table.shape[2])
    basis = columns[:, count:]
    rest = columns[:, :count]
    if basis.shape[1]:
        q, _ = np.linalg.qr(basis / (np.linalg.norm(basis, axis=0) + 1e-12))
        rest = rest - q @ (q.T @ rest)
    return rest.reshape(*table.shape[:2], count)


def windows_of(data: Sequence[LogData]) -> list[Window]:
    """Return the windows of logs, one for each log of setpoints. A window begins where the held-out
    part begins.
    """
    windows = list[Window]()
    every = 1 + sum(len(part.log.time) for part in data) // MOST_ROWS
    for number, part in enumerate(data):
        total = len(part.motion.qpos) - 1
        share = {None: 1 - HELD_OUT, False: 1.0, True: 0.0}[part.log.held_out]
        split = round(share * total)
        if part.drive.params is not None:
            windows.append(_window(number, part, (0, total), split, every))
            continue
        # Windows of the fitted part, then of the held-out part; the filter begins at the edge.
        edge = round(0.05 / part.drive.timestep)
        first = max(split + 1, edge)
        length = min(round(WINDOW / part.drive.timestep), max(total - first, split - edge))
        starts = [*range(edge, split - length + 1, length)]
        starts += range(first, total - length + 1, length)
        windows += [
            _window(number, part, (start, start + length), split, every) for start in starts
        ]
    return windows[:: 1 + len(windows) // MOST_WINDOWS]


def _window(number: int, data: LogData, steps: tuple[int, int], split: int, every: int) -> Window:
    """Return the window between two sim ``steps`` of a log's grid, of one row of ``every``; rows are
    held out from the step ``split`` on.
    """
    first, last = steps
    log, motion, _, drive = data
    dt = drive.timestep
    settle = 0.0
    if drive.params is not None:
        settle = min(SETTLE, 0.2 * log.seconds) / dt
    place = (log.time - log.time[0]) / dt
    rows = np.flatnonzero((place > first + settle + 1e-6) & (place <= last + 1e-6))[::every]
    place = place[rows]
    step = np.maximum(np.ceil(place - 1e-6).astype(int), first + 1)
    past = round(PAST / dt)
    command = motion.command[np.maximum(np.arange(first - past, last), 0)]
    before = np.maximum(step - place, 0.0) * dt
    stretch = Stretch(
        motion.qpos[first], motion.qvel[first], command, past, step - first - 1, before
    )
    fitted = place <= split + 1e-6
    return Window(number, stretch, log.qpos[rows], log.time[rows], fitted)
