"""Windows of logs: stretches that are simulated from their start and compared with the measured positions."""

from __future__ import annotations

from threading import local
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.arrays.digest import digest
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.logged_control import LoggedDrive
from batchpid.sim.identification.plant import Plant, Segment
from batchpid.sim.identification.regression import Motion
from batchpid.sim.identification.unknowns import Motors, take
from batchpid.sim.robot.robot import Robot

WINDOW = 0.3
"""Length of a window of a log of efforts [s]."""
SETTLE = 0.3
"""Time after the start of a log under the PID law in which the initial state is forgotten [s]: it is not fitted."""
START, RESTS = 0.03, 0.05
"""Length of the part of a log that gives its initial state [s]; initial speed by prior, over its root mean square."""
MOVES = 4.0
"""Initial speed from which a joint counts as moving, over the combined standard deviations of estimate and prior."""
HELD_OUT = 0.25
"""Share of each log, at its end, that is held out."""


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
    """Fitted rows; the others are held out (rows,) bool."""
    errors: Float64
    """Draws of the error of the segment's noise, or of logged efforts (draws, past + steps, joints)."""
    speed_error: Float64
    """Standard deviations of the velocity at its start (joints,)."""

    def drawn(self, draw: int) -> Segment:
        """Return the segment with a draw of the errors, from 1 on; without any for 0."""
        if not draw:
            return self.segment
        changed = "command" if self.past else "noise"
        return self.segment._replace(**{changed: getattr(self.segment, changed) + self.errors[draw - 1]})


class Subject(NamedTuple):
    """Robot of the logs, their joints and control."""

    robot: Robot
    joints: tuple[int, ...]
    drive: LoggedDrive
    key: str
    """Digest of these."""

    @classmethod
    def of(cls, robot: Robot, joints: tuple[int, ...], drive: LoggedDrive) -> Subject:
        """Return the subject with its digest."""
        return cls(robot, joints, drive, digest(robot.describe(), joints, drive))


_kept = local()
"""Last plant of each thread. A worker process gets many tasks of one subject in a row."""


def plant_of(subject: Subject) -> Plant:
    """Return the plant of ``subject``; successive calls with equal subjects return the same object."""
    if getattr(_kept, "key", None) != subject.key:
        _kept.plant, _kept.key = Plant(*subject[:-1]), subject.key
    return _kept.plant


def simulate(
    subject: Subject,
    windows: list[Window],
    motors: Motors,
    states: Float64,
    draws: NDArray[np.intp],
) -> list[Float64]:
    """Return for each of ``windows`` the positions (candidates, rows, joints) of all candidates at its rows.

    ``states`` are added to the states at the start of a window; ``draws`` are the numbers of the candidates' noise.
    """
    segments = []
    for window in windows:
        drawn = {draw: window.drawn(draw) for draw in set(draws.tolist())}
        for shift, draw in zip(states, draws.tolist(), strict=True):
            given = drawn[draw]
            segments.append(given._replace(qpos=given.qpos + shift[0], qvel=given.qvel + shift[1]))
    count = len(states)
    everyone = take(motors, np.tile(np.arange(count), len(windows)))
    out = plant_of(subject).simulate(everyone, segments, windows[0].past)
    found = []
    with np.errstate(invalid="ignore"):
        for number, window in enumerate(windows):
            rows = out[number * count : (number + 1) * count]
            before, after = rows[:, window.index], rows[:, np.minimum(window.index + 1, rows.shape[1] - 1)]
            found.append(before + window.part * (after - before))
    return found


def project(basis: Float64, residual: Float64, columns: Float64) -> tuple[Float64, Float64]:
    """Return residual (rows, joints) and ``columns`` (rows, joints, n) without the part that ``basis`` explains.

    ``basis`` is (rows, joints, states).
    """
    if not (np.isfinite(basis).all() and np.isfinite(residual).all()):
        return residual, columns
    flat = basis.reshape(-1, basis.shape[2])
    q, _ = np.linalg.qr(flat / (np.linalg.norm(flat, axis=0) + 1e-12))
    left = residual.reshape(-1) - q @ (q.T @ residual.reshape(-1))
    table = columns.reshape(len(flat), -1)
    return left.reshape(residual.shape), (table - q @ (q.T @ table)).reshape(columns.shape)


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
    steps = np.maximum(np.arange(first - past, last), 0)
    command, given = motion.command[steps], (motion.jitter if past else motion.sensor)
    noise = np.zeros_like(command) if past else motion.sensor.values[steps]
    errors = np.zeros((0, *command.shape)) if given is None else given.errors[:, steps]
    start = (motion.qpos[first], motion.qvel[first], np.zeros(len(log.joints))) if first else _start(log, motion)
    forward = None if motion.feedforward is None else motion.feedforward[steps]
    segment = Segment(start[0], start[1], command, noise, forward)
    fitted = log.time[rows] <= log.time[0] + share_fitted(log) * log.seconds
    compared = index - first, part, log.qpos[rows], int(rows[0]), fitted
    return Window(number, segment, past, *compared, errors, start[2])


def _start(log: Log, motion: Motion) -> tuple[Float64, Float64, Float64]:
    """Return position, velocity and its standard deviation (joints,) at the start of a log.

    The filter of ``motion`` is unreliable there. A parabola is fitted to the first rows instead, with the prior that
    the robot rests. A joint that moves too fast for the prior, for example after a gap in time, is fitted without it.
    """
    time = log.time - log.time[0]
    count = max(4, int((time <= START).sum()))
    end = time[count - 1]
    columns = np.vander(time[:count] / end, 3, increasing=True)
    rest = np.maximum(RESTS * np.sqrt((motion.qvel**2).mean(0)), 1e-9)
    noise = np.maximum(motion.sensor.size, 1e-9)
    found = []
    for qpos, size, speed in zip(log.qpos[:count].T, noise, rest * end, strict=True):
        for weight in (0.0, (size / speed) ** 2):
            inverse = np.linalg.inv(columns.T @ columns + np.diag([0.0, weight, 0.0]))
            position, velocity = (inverse @ columns.T @ (qpos - qpos[0]))[:2]
            if velocity**2 > MOVES**2 * (size**2 * inverse[1, 1] + speed**2):
                break
        found.append([position, velocity, np.sqrt(inverse[1, 1])])
    position, velocity, deviation = np.array(found).T
    return log.qpos[0] + position, velocity / end, np.maximum(deviation * noise / end, 0.1 * rest)


def share_fitted(log: Log) -> float:
    """Return the share of a log, at its start, that is fitted."""
    return {None: 1 - HELD_OUT, False: np.inf, True: -1.0}[log.settings.held_out]


def whole(number: int, log: Log, motion: Motion, dt: float) -> list[Window]:
    """Return one window that covers the log."""
    settle = min(SETTLE, 0.2 * log.seconds)
    return [_window(number, log, motion, dt, 0, len(motion.qpos) - 1, 0, settle)]


def cut(number: int, log: Log, motion: Motion, dt: float) -> list[Window]:
    """Return windows of WINDOW seconds; a window begins where the held-out part begins."""
    total, past, edge = len(motion.qpos) - 1, round(0.1 / dt), round(0.05 / dt)
    split = int(min(share_fitted(log), 1.0) * total)
    first, rest = max(split + 1, edge), total - split - 2
    length = min(round(WINDOW / dt), rest if split < total else total - edge)
    starts = [*range(edge, split - length + 1, length), *range(first, total - length + 1, length)]
    return [_window(number, log, motion, dt, first, first + length, past, 0.0) for first in starts]
