r"""Problem of a fit: simulated against measured positions of all windows of logs.

A log of efforts is simulated in windows, each from a free initial state, whose effect is projected
out of residuals and derivatives (H. G. Bock, "Recent advances in parameter identification
techniques for ODE", 1983). A log of setpoints is simulated as a whole. All candidates of an
evaluation - the present point, changes of it, and a change of each initial state - are simulated
in one batch.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.regression import LogData
from batchpid.sim.identification.simulator import Stretch, simulate
from batchpid.sim.identification.unknowns import Unknowns

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
FEWER, LEAST_WINDOWS = 4, 12
"""Share of the windows, and their least number, for the first steps of a fit."""
BEGINNING = 4.0
"""Length of a log of setpoints for the first steps of a fit [s]."""
MOST_ROWS = 40_000
"""Largest number of rows of all logs; if there are more, evenly spaced ones are used."""
ENVS = 1024
"""Most simulations at once."""
STATE_STEPS = 1e-3, 1e-2
"""Changes of initial positions and velocities."""
RESIDUAL_BOUND = 3.0
"""Bound of the residuals [rad or m], reached where a simulation diverges."""
RESOLUTION = 1e-5
"""Least size of residuals [rad or m]: encoders show no less."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Windows of logs, the simulation of each log, and the unknowns."""

    data: Sequence[LogData]
    windows: Sequence[Stretch]
    unknowns: Unknowns
    run: Callable[..., Any] = map
    """Map over groups of windows: ``map``, or that of worker processes."""

    @property
    def half_row(self) -> float:
        """Time by which commanded efforts seem late if the robot held them and the log is interpolated
        [s]: half of the time between rows. A delay of setpoints is an unknown of its own.
        """
        log, _, _, drive = self.data[0]
        if log.held or log.measured or drive.mode == "pid":
            return 0.0
        return max(float(np.median(np.diff(log.command_time))) - drive.timestep, 0.0) / 2

    def coarse(self, judged: bool = False) -> Problem:
        """Return the problem with every FEWER-th window, or with the beginnings of logs of
        setpoints, for the first steps of a fit; itself where logs are short.

        A ``judged`` problem has held-out rows.
        """
        windows = self.windows[::FEWER]
        if self.data[0].drive.mode == "pid":
            most = round(BEGINNING / self.data[0].drive.timestep)
            longest = max(len(window.command) for window in self.windows)
            if judged or longest < 2 * most:
                return self
            return replace(self, windows=[window.until(most) for window in self.windows])
        return replace(self, windows=windows) if len(windows) >= LEAST_WINDOWS else self

    def evaluate(
        self,
        windows: Sequence[Stretch],
        point: Float64,
        changes: Float64 | None = None,
        free_states: bool = True,
    ) -> list[Float64]:
        """Return the residuals of each window at a point (unknowns,), and their changes by
        ``changes`` (n, unknowns) of the point: (rows, joints, 1 + n).

        Initial states of windows of efforts are projected out if they are free.
        """
        joints = windows[0].measured.shape[1]
        free = free_states and self.data[0].drive.mode == "effort"
        shifts = np.diag(np.repeat(STATE_STEPS, joints * free))
        # Rows: the point, each change of it, a change of each initial state.
        moved = point[None] if changes is None else np.vstack([point, point + changes])
        count = len(moved)
        points = np.vstack([moved, np.tile(point, (len(shifts), 1))])
        states = np.zeros((len(points), 2, joints))
        states[count:] = shifts.reshape(-1, 2, joints)
        # Windows of one log are simulated at once, as many as are fast together.
        many = max(1, ENVS // len(points))
        groups = defaultdict[Any, list[Stretch]](list)
        for number, window in enumerate(windows):
            groups[window.log, number // many].append(window)
        tasks = [self._task(group, points, states) for group in groups.values()]
        tables = []
        results = chain(*self.run(simulate, *zip(*tasks, strict=True)))
        for window, table in zip(windows, results, strict=True):
            errors = np.clip(window.measured - table, -RESIDUAL_BOUND, RESIDUAL_BOUND)
            errors[1:] -= errors[0]
            tables.append(_projected(np.moveaxis(errors, 0, 2), count))
        return tables

    def _task(self, windows: list[Stretch], points: Float64, states: Float64) -> Any:
        """Return the arguments of :func:`simulate` for windows of a log, each at all points."""
        _, _, plant, drive = self.data[windows[0].log]
        points, states = (np.repeat(table, len(windows), axis=0) for table in (points, states))
        robots = self.unknowns.candidates(self.unknowns.values(points))
        return plant, drive, robots, states, windows

    def fitted(self, point: Float64, changes: Float64 | None = None) -> Float64:
        """Return residuals of the fitted rows and their changes (rows, joints, 1 + n)."""
        windows = [window for window in self.windows if window.fitted.any()]
        pairs = zip(windows, self.evaluate(windows, point, changes), strict=True)
        return np.concatenate([table[window.fitted] for window, table in pairs])

    def errors(
        self,
        point: Float64,
        changes: Float64 | None = None,
        free_states: bool = True,
    ) -> Float64:
        """Return the root mean squares (1 + n, joints) of the position error at the held-out rows,
        at a point and at ``changes`` (n, unknowns) of it; at all rows if none is held out.

        Windows of efforts begin at the logged state, or at the best one if states are free.
        """
        held_out = [window for window in self.windows if not window.fitted.all()]
        windows = held_out or self.windows
        pairs = zip(windows, self.evaluate(windows, point, changes, free_states), strict=True)
        table = np.concatenate([table[window.fitted ^ bool(held_out)] for window, table in pairs])
        table[..., 1:] += table[..., :1]
        size: Float64 = np.sqrt((table**2).mean(0)).T
        return size


def size_of(table: Float64) -> Float64:
    """Return the size of residuals (rows, joints, 1 + n) by joint: the root mean square, the largest
    tenth cut.
    """
    errors = np.abs(table[..., 0])
    errors = np.minimum(errors, np.quantile(errors, 0.9, axis=0))
    size: Float64 = np.sqrt((errors**2).mean(0)) + RESOLUTION
    return size


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


def windows_of(data: Sequence[LogData]) -> list[Stretch]:
    """Return the windows of logs, one for each log of setpoints. A window begins where the held-out
    part begins.
    """
    windows = list[Stretch]()
    every = 1 + sum(len(part.log.time) for part in data) // MOST_ROWS
    for number, part in enumerate(data):
        dt = part.drive.timestep
        total = len(part.motion.qpos) - 1
        share = {None: 1 - HELD_OUT, False: 1.0, True: 0.0}[part.log.held_out]
        split = round(share * total)
        length = total
        starts = [0]
        if part.drive.mode == "effort":
            # Windows of the fitted part, then of the held-out part; the filter begins at the edge.
            edge = round(0.05 / dt)
            first = max(split + 1, edge)
            length = min(round(WINDOW / dt), max(total - first, split - edge))
            starts = [*range(edge, split - length + 1, length)]
            starts += range(first, total - length + 1, length)
        for start in starts:
            windows.append(
                _window(
                    number,
                    part,
                    start,
                    start + length,
                    split,
                    every,
                )
            )
    return windows[:: 1 + len(windows) // MOST_WINDOWS]


def _window(
    number: int,
    data: LogData,
    first: int,
    last: int,
    split: int,
    every: int,
) -> Stretch:
    """Return the window between two sim steps of a log's grid, of one row of ``every``; rows are
    held out from the step ``split`` on.
    """
    log, motion, _, drive = data
    dt = drive.timestep
    settle = 0.0
    if drive.mode == "pid":
        settle = min(SETTLE, 0.2 * log.seconds) / dt
    place = (log.time - log.time[0]) / dt
    rows = np.flatnonzero((place > first + settle + 1e-6) & (place <= last + 1e-6))[::every]
    place = place[rows]
    # Rows lie before the ends of their sim steps.
    step = np.maximum(np.ceil(place - 1e-6).astype(int), first + 1)
    before = np.maximum(step - place, 0.0) * dt
    past = round(PAST / dt)
    command = motion.command[np.maximum(np.arange(first - past, last), 0)]
    return Stretch(
        motion.qpos[first],
        motion.qvel[first],
        command,
        past,
        step - first - 1,
        before,
        number,
        log.qpos[rows],
        log.time[rows],
        place <= split + 1e-6,
    )
