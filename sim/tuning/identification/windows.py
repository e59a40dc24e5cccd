"""Windows of logs: stretches that are simulated from their start and compared with the measured positions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.robot.robot import Robot
from sim.tuning.identification.drive import Drive
from sim.tuning.identification.logs import Log
from sim.tuning.identification.plant import Motors, Plant, Segment
from sim.tuning.identification.regression import Motion

Float64 = NDArray[np.float64]
WINDOW = 0.3
"""Length of a window of a log of efforts [s]."""
SETTLE = 0.3
"""Time after the start of a log under the PID law in which the initial state is forgotten [s]: it is not fitted."""
HELD_OUT = 0.25
"""Share of each log, at its end, that is kept to judge."""


class Window(NamedTuple):
    """Stretch of a log to simulate from its start, and the rows of the log that it is compared with."""

    log: int
    segment: Segment
    past: int
    """Sim steps of the segment's commands before its start."""
    index: Any
    """Sim step before each row (rows,)."""
    part: Float64
    """Fraction of a sim step from there to the row (rows, 1)."""
    measured: Float64
    """Positions (rows, joints)."""
    first: int
    """Number of its first row in the log."""
    fitted: Any
    """Rows that are fitted; the others are kept to judge (rows,) bool."""


_plants: dict[int, Plant] = {}


def simulate(
    about: tuple[Robot, tuple[int, ...], Drive], windows: list[Window], motors: Motors, states: Float64
) -> list[Float64]:
    """Return for each of ``windows`` the positions (candidates, rows, joints) of all candidates at its rows."""
    robot, joints, drive = about
    key = hash((robot.urdf, joints, repr(drive)))
    if key not in _plants:
        _plants.clear()
        _plants[key] = Plant(robot, joints, drive)
    segments = [
        window.segment._replace(qpos=window.segment.qpos + shift[0], qvel=window.segment.qvel + shift[1])
        for window in windows
        for shift in states
    ]
    count = len(states)
    everyone = motors.take(np.tile(np.arange(count), len(windows)))
    out = _plants[key].simulate(everyone, segments, windows[0].past)
    found = []
    with np.errstate(invalid="ignore"):
        for number, window in enumerate(windows):
            rows = out[number * count : (number + 1) * count]
            before, after = rows[:, window.index], rows[:, np.minimum(window.index + 1, rows.shape[1] - 1)]
            found.append(before + window.part * (after - before))
    return found


def project(basis: Float64, residual: Float64, columns: Float64 | None) -> tuple[Float64, Float64 | None]:
    """Return residual (rows, joints) and Jacobian without what ``basis`` (rows, joints, states) explains."""
    if not (np.isfinite(basis).all() and np.isfinite(residual).all()):
        return residual, columns
    flat = basis.reshape(-1, basis.shape[2])
    q, _ = np.linalg.qr(flat / (np.linalg.norm(flat, axis=0) + 1e-12))
    left = residual.reshape(-1) - q @ (q.T @ residual.reshape(-1))
    if columns is not None:
        table = columns.reshape(len(flat), -1)
        columns = (table - q @ (q.T @ table)).reshape(columns.shape)
    return left.reshape(residual.shape), columns


def rows_of(window: Window) -> slice:
    """Return the rows of its log that ``window`` is compared with."""
    return slice(window.first, window.first + len(window.measured))


def _window(
    number: int, log: Log, motion: Motion, dt: float, first: int, last: int, past: int, settle: float
) -> Window:
    """Return the window from sim step ``first`` to ``last`` of the log's grid."""
    at = (log.time - log.time[0]) / dt
    rows = np.flatnonzero((at >= first + settle / dt - 1e-6) & (at <= last + 1e-6))
    index = np.floor(at[rows] + 1e-6).astype(int)
    part = np.clip(at[rows] - index, 0, 1)[:, None]
    before = log.time[0] + dt * np.arange(first - past, first)
    command = np.vstack([log.commands_at(before), motion.command[first:last]]) if past else motion.command[first:last]
    noise = np.zeros_like(command)
    noise[past:] = motion.noise[first:last]
    segment = Segment(motion.qpos[first], motion.qvel[first], command, noise)
    fitted = log.time[rows] <= log.time[0] + (1 - HELD_OUT) * log.seconds
    return Window(number, segment, past, index - first, part, log.qpos[rows], int(rows[0]), fitted)


def whole(number: int, log: Log, motion: Motion, dt: float) -> list[Window]:
    """Return one window of all the log."""
    settle = min(SETTLE, 0.2 * log.seconds)
    return [_window(number, log, motion, dt, 0, len(motion.qpos) - 1, 0, settle)]


def cut(number: int, log: Log, motion: Motion, dt: float) -> list[Window]:
    """Return windows of WINDOW seconds; one that would lie across the kept part begins there."""
    total, past, edge = len(motion.qpos) - 1, round(0.1 / dt), round(0.05 / dt)
    split = int((1 - HELD_OUT) * total)
    length = min(round(WINDOW / dt), total - split - 2)
    starts = [*range(edge, split - length + 1, length), *range(split + 1, total - length + 1, length)]
    return [_window(number, log, motion, dt, first, first + length, past, 0.0) for first in starts]
