r"""Fit: nonlinear least squares of simulated against measured positions.

A log of efforts is simulated in windows, each from a free initial state, whose effect is projected
out of residuals and derivatives (H. G. Bock, "Recent advances in parameter identification
techniques for ODE", 1983). A log of setpoints is simulated as a whole. Residuals over their size,
with the loss of SciPy's "soft_l1" against outliers, and the unknowns' distances from the prior are
minimised by ``scipy.optimize.least_squares``. All candidates of an evaluation - the present point,
one change of each unknown and of each initial state - are simulated in one batch.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.arrays.trees import structure
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.regression import Motion
from batchpid.sim.identification.simulator import (
    LogControl,
    Plant,
    PlantCandidates,
    Stretch,
    simulate,
)
from batchpid.sim.identification.unknowns import Unknowns

WINDOW = 0.3
"""Length of a window of a log of efforts [s]."""
SETTLE = 0.3
"""Time after the start of a log under the PID law in which the initial state is forgotten [s]: it
is not fitted.
"""
HELD_OUT = 0.25
"""Share of each log, at its end, that is held out."""
MOST_WINDOWS = 500
"""Largest number of fitted windows; of more, evenly spaced ones are fitted."""
MOST_NUMBERS = 2**24
"""Largest number of entries of the derivatives; of more, evenly spaced rows are fitted."""
ENVS = 2048
"""Most simulations at once."""
STEP = 1e-2
"""Change of an unknown's coordinate for a finite difference."""
STATE_STEPS = 1e-3, 1e-2
"""Changes of initial positions and velocities."""
FARTHEST = 3.0
"""Bound of the residuals [rad or m], reached where a simulation diverges."""
OUTLIER = 2.0
"""Ratio of a residual to its size above which its weight in the loss decreases."""


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
    """Residuals of each window (rows, joints), and derivatives (rows, joints, unknowns)."""

    residuals: list[Float64]
    derivatives: list[Float64]


class Solution(NamedTuple):
    """Result of a fit."""

    point: Float64
    """Coordinates of the unknowns."""
    evaluation: FitResiduals
    """Residuals and derivatives there."""
    size: Float64
    """Size of the residuals (joints,)."""
    converged: bool


@dataclass(frozen=True, eq=False)
class Problem:
    """Windows of logs, the simulation of each log, and the unknowns."""

    plants: Sequence[Plant]
    drives: Sequence[LogControl]
    """Plant and drive of each log."""
    windows: Sequence[Window]
    unknowns: Unknowns
    run: Callable[..., Any] = map
    """Map over the logs: ``map``, or ``Pool.map`` of worker processes."""

    def evaluate(
        self, point: Float64, steps: Float64 | None = None, free_states: bool = True
    ) -> FitResiduals:
        """Return residuals at a point (unknowns,), and derivatives by ``steps`` (unknowns,); None:
        no derivatives.

        Initial states of windows are projected out if they are free.
        """
        joints = self.windows[0].measured.shape[1]
        changes = np.zeros((0, len(point))) if steps is None else np.diag(steps)
        shifts = np.zeros(
            (2 * joints if free_states and self.drives[0].params is None else 0, 2, joints)
        )
        for number in range(len(shifts)):
            side = number // joints
            shifts[number, side, number % joints] = STATE_STEPS[side]
        points = np.concatenate(
            [point[None], point + changes, np.repeat(point[None], len(shifts), axis=0)]
        )
        states = np.concatenate([np.zeros((1 + len(changes), 2, joints)), shifts])
        candidates = self.unknowns.candidates(self.unknowns.values(points))
        groups = self._groups(len(points))
        tasks = [self._task(group, candidates, states) for group in groups]
        tables = [table for group in self.run(_simulated, tasks) for table in group]
        residuals: list[Any] = [None] * len(self.windows)
        slopes: list[Any] = [None] * len(self.windows)
        for number, table in zip(
            [number for group in groups for number in group], tables, strict=True
        ):
            errors = np.clip(self.windows[number].measured - table, -FARTHEST, FARTHEST)
            residual, change = errors[0], np.moveaxis(errors[1:] - errors[0], 0, 2)
            slope = change[..., : len(changes)] / (1.0 if steps is None else steps)
            residuals[number], slopes[number] = _projected(
                residual, slope, change[..., len(changes) :]
            )
        return FitResiduals(residuals, slopes)

    def _task(self, group: list[int], candidates: PlantCandidates, states: Float64) -> Any:
        """Return the arguments of :func:`simulate` for a group of windows."""
        logs = [self.windows[number].log for number in group]
        drive = self.drives[logs[0]]
        if drive.params is not None:
            laws = [self.drives[log].params for log in logs]
            drive = drive._replace(params=bp.PIDParams(*map(_stacked, zip(*laws, strict=True))))
        stretches = [self.windows[number].stretch for number in group]
        return self.plants[logs[0]], drive, candidates, states, stretches

    def _groups(self, candidates: int) -> list[list[int]]:
        """Return the numbers of windows that are simulated at once."""
        alike = defaultdict[Any, list[int]](list)
        for number, (log, *_) in enumerate(self.windows):
            alike[id(self.plants[log]), structure(self.drives[log].params)].append(number)
        many = max(1, ENVS // candidates)
        return [
            group[at : at + many] for group in alike.values() for at in range(0, len(group), many)
        ]

    def solve(
        self,
        start: Float64,
        evaluations: int,
        size: Float64 | None = None,
        progress: Callable[[], Any] | None = None,
    ) -> Solution:
        """Return the fit from a point ``start``, with residuals of a ``size`` (joints,), or that at
        the start.
        """
        from scipy.optimize import least_squares

        first = self.evaluate(start, np.full(len(start), STEP))
        size = self.size(first) if size is None else size
        systems = {start.tobytes(): (first, self.system(first, start, size))}

        def at(point: Float64) -> Any:
            if point.tobytes() not in systems:
                evaluation = self.evaluate(point, np.full(len(point), STEP))
                systems.clear()
                systems[point.tobytes()] = evaluation, self.system(evaluation, point, size)
                if progress is not None:
                    progress()
            return systems[point.tobytes()]

        optimum = least_squares(
            lambda point: at(point)[1][0],
            start,
            lambda point: at(point)[1][1],
            x_scale="jac",
            loss="soft_l1",
            f_scale=OUTLIER,
            ftol=1e-5,
            xtol=1e-3,
            gtol=1e-8,
            max_nfev=evaluations,
        )
        evaluation = at(optimum.x)[0]
        return Solution(optimum.x, evaluation, self.size(evaluation), optimum.status > 0)

    def system(
        self, evaluation: FitResiduals, point: Float64, size: Float64
    ) -> tuple[Float64, Float64]:
        """Return residuals and derivatives (n, unknowns) of the fitted rows over their ``size``,
        then of the prior.
        """
        rows = sum(int(window.fitted.sum()) for window in self.windows)
        every = 1 + rows * len(size) * len(point) // MOST_NUMBERS
        residuals, slopes = list[Float64](), list[Float64]()
        for window, residual, slope in zip(self.windows, *evaluation, strict=True):
            residuals.append((residual[window.fitted][::every] / size).ravel())
            slopes.append((slope[window.fitted][::every] / size[:, None]).reshape(-1, len(point)))
        residuals.append((point - self.unknowns.prior) / self.unknowns.spread)
        slopes.append(np.diag(1 / self.unknowns.spread))
        return np.concatenate(residuals), np.concatenate(slopes)

    def size(self, evaluation: FitResiduals) -> Float64:
        """Return the size of fitted residuals (joints,): the root mean square, the largest tenth of
        each joint cut.
        """
        rows = [
            residual[window.fitted]
            for window, residual in zip(self.windows, evaluation.residuals, strict=True)
        ]
        errors = np.abs(np.concatenate(rows))
        return np.sqrt((np.minimum(errors, np.quantile(errors, 0.9, axis=0)) ** 2).mean(0)) + 1e-9

    def error(
        self, point: Float64, mask: Callable[[Window], Any], free_states: bool = True
    ) -> Float64:
        """Return the root mean square (joints,) of the position error at the rows of each window
        that ``mask`` has.
        """
        residuals = self.evaluate(point, None, free_states).residuals
        rows = [
            residual[mask(window)] for window, residual in zip(self.windows, residuals, strict=True)
        ]
        return np.sqrt((np.concatenate(rows) ** 2).mean(0))


def _simulated(task: Any) -> list[Float64]:
    return simulate(*task)


def _stacked(parts: Any) -> Any:
    """Return the rows of several logs as one array; other options are equal in all logs."""
    return np.concatenate(parts) if isinstance(parts[0], np.ndarray) else parts[0]


def _projected(residual: Float64, slope: Float64, basis: Float64) -> tuple[Float64, Float64]:
    """Return residual (rows, joints) and ``slope`` (rows, joints, n) without what ``basis``
    explains.
    """
    if not basis.shape[2]:
        return residual, slope
    flat = basis.reshape(-1, basis.shape[2])
    q, _ = np.linalg.qr(flat / (np.linalg.norm(flat, axis=0) + 1e-12))
    left = residual.reshape(-1) - q @ (q.T @ residual.reshape(-1))
    table = slope.reshape(len(flat), -1)
    return left.reshape(residual.shape), (table - q @ (q.T @ table)).reshape(slope.shape)


def windows_of(number: int, log: Log, motion: Motion, timestep: float, whole: bool) -> list[Window]:
    """Return the windows of a log; one for ``whole``. A window begins where the held-out part
    begins.
    """
    total = len(motion.qpos) - 1
    share = {None: 1 - HELD_OUT, False: np.inf, True: -1.0}[log.settings.held_out]
    if whole:
        settle = min(SETTLE, 0.2 * log.seconds)
        return [_window(number, log, motion, timestep, 0, total, settle, share)]
    edge = round(0.05 / timestep)
    split = int(np.clip(share, 0.0, 1.0) * total)
    first = max(split + 1, edge)
    length = min(round(WINDOW / timestep), max(total - first, split - edge))
    starts = [*range(edge, split - length + 1, length), *range(first, total - length + 1, length)]
    return [
        _window(number, log, motion, timestep, start, start + length, 0.0, share)
        for start in starts
    ]


def _window(
    number: int,
    log: Log,
    motion: Motion,
    dt: float,
    first: int,
    last: int,
    settle: float,
    share: float,
) -> Window:
    """Return the window from sim step ``first`` to ``last`` of the log's grid."""
    at = (log.time - log.time[0]) / dt
    rows = np.flatnonzero((at > first + settle / dt + 1e-6) & (at <= last + 1e-6))
    step = np.maximum(np.ceil(at[rows] - 1e-6).astype(int), first + 1)
    before = np.maximum(step - at[rows], 0.0) * dt
    past = 0 if settle else min(first, round(0.1 / dt))
    commands = slice(first - past, last)
    forward = None if motion.feedforward is None else motion.feedforward[commands]
    qpos, qvel = (motion.qpos[first], motion.qvel[first]) if first else _start(log)
    stretch = Stretch(qpos, qvel, motion.command[commands], past, forward, step - first - 1, before)
    fitted = log.time[rows] <= log.time[0] + share * log.seconds
    return Window(number, stretch, log.qpos[rows], log.time[rows], fitted)


def _start(log: Log) -> tuple[Float64, Float64]:
    """Return position and velocity at the start of a log: a line through its first 30 ms; small
    speeds are rest.
    """
    count = max(4, int((log.time <= log.time[0] + 0.03).sum()))
    slope, place = np.polyfit(log.time[:count] - log.time[0], log.qpos[:count], 1)
    speed = np.abs(np.diff(log.qpos, axis=0) / np.diff(log.time)[:, None])
    moves = np.abs(slope) > 0.2 * np.sqrt((speed**2).mean(0))
    return np.where(moves, place, log.qpos[:count].mean(0)), np.where(moves, slope, 0.0)
