r"""Start of the fit: smoothed motions, and the inverse dynamics as a linear regression at given
delays.

With the measured motion filtered without phase lag, and the effort u filtered in the same way, each
joint obeys::

    s u(t - d) + b - h - (M q'')_j = A q''_j + B q'_j + F sgn(q'_j)

which is solved by least squares with A, B, F >= 0, where the joint moves fast enough not to stick
(J. Swevers, W. Verdonck and J. De Schutter, "Dynamic model identification for industrial robots",
IEEE Control Systems Magazine 27(5), 2007). Under the PID law u follows from the setpoints and the
filtered positions. The delays with the least residual are taken from a grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.motors.actuators import Actuators
from batchpid.sim.identification.log import Log, interpolated
from batchpid.sim.identification.simulator import Control, LogControl, Plant, PlantCandidates

CUTOFF = 15.0
"""Corner of the filter [Hz]."""
DELAYS = np.arange(0.0, 0.03, 1e-3)
SETPOINT_DELAYS = np.arange(0.0, 0.06, 5e-3)
"""Delays that are tried [s]."""
EDGE = 0.15
"""Time left out at both ends of a log, where the filter begins [s]."""
MOST_ROWS = 4000
"""Most rows of a regression."""
STRENGTHS = 0.2, 3.0
"""Bounds of the strength."""
MOVES = 0.4
"""Speed, over its root mean square, below which a joint may stick."""
WEIGHT = 0.02
"""Weight of the prior at strength 1, over the effort's size."""
EVIDENCE = 0.7
"""Least decrease of :attr:`Guess.unexplained` for another reading of a log to be reported."""
WORST = -1.0
"""Largest :attr:`Guess.unexplained` of a reading that is reported."""
ALIKE = 0.5
"""Difference below which two readings count as equally good: the first one is reported."""
TRIED = 10.0
"""Length of a log from which other readings are tried [s]."""
LEAST_SHARE = 0.05
"""Share of a joint's effort that moves the links, below which its strength is not identifiable: the
motor's inertia and friction take the rest, which determines their ratios to the strength only.
"""


class Motion(NamedTuple):
    """Smoothed motion of a log on the grid of the sim steps, from its first row on; arrays (steps,
    joints).
    """

    qpos: Float64
    qvel: Float64
    qacc: Float64
    command: Float64
    feedforward: Float64 | None


class Guess(NamedTuple):
    """Motors by a regression."""

    values: dict[str, Float64]
    """Values (joints,) or (1,) by kind of unknown."""
    cost: float
    """Mean over the joints of log(mean square of the residual / mean square of all efforts)."""
    unexplained: float
    """Mean over the joints of log(mean square of the residual / mean square of the motors'
    efforts).
    """


def smooth(log: Log, timestep: float) -> Motion:
    """Return the motion of ``log`` on the grid, filtered without phase lag."""
    time = log.time[0] + timestep * np.arange(int(log.seconds / timestep + 1e-6) + 1)
    period = float(np.median(np.diff(log.time)))
    qpos = lowpass(interpolated(time, log.time, log.qpos), min(CUTOFF, 0.2 / period), timestep)
    qvel = np.gradient(qpos, timestep, axis=0)
    forward = None if log.feedforward is None else log.commands_at(time, log.feedforward)
    q, v, a = map(np.ascontiguousarray, (qpos, qvel, np.gradient(qvel, timestep, axis=0)))
    return Motion(q, v, a, log.commands_at(time), forward)


def lowpass(table: Float64, cutoff: float, timestep: float) -> Float64:
    """Return the columns of a table (steps, columns) without frequencies above ``cutoff`` [Hz],
    without phase lag.
    """
    from scipy.signal import butter, sosfiltfilt

    pad = min(len(table) - 1, round(0.5 / timestep))
    return sosfiltfilt(butter(4, cutoff, fs=1 / timestep, output="sos"), table, axis=0, padlen=pad)


def better_reading(plant: Plant, drive: LogControl, log: Log, names: Sequence[str]) -> str:
    """Return the reading of a log that explains its efforts far better than the present one, in
    words; "" for none.

    Signs, exchanged joints, factors of units and times of the commands are tried. ``names`` are the
    joints' names.
    """
    first = log.part(log.time < log.time[0] + TRIED, log.command_time < log.time[0] + TRIED)
    present, costs = _cost(plant, drive, first), dict[str, float]()
    for words, changed in _readings(first, names):
        costs[words] = _cost(plant, drive, changed)
    if min(costs.values()) > min(present - EVIDENCE, WORST):
        return ""
    return next(words for words, cost in costs.items() if cost < min(costs.values()) + ALIKE)


def _cost(plant: Plant, drive: LogControl, log: Log) -> float:
    return Regression([plant], [drive], [log], [smooth(log, drive.timestep)]).best().unexplained


def _readings(log: Log, names: Sequence[str]) -> Iterator[tuple[str, Log]]:
    """Yield other readings of a log, in words."""
    columns: dict[str, tuple[bool, bool]] = {log.kind: (False, True), "qpos": (True, False)}
    columns[f"qpos and {log.kind}"] = True, True
    joints = len(names)

    def changed(sides: tuple[bool, bool], matrix: Float64) -> Log:
        qpos, command = log.qpos, log.command
        return replace(
            log,
            qpos=qpos @ matrix if sides[0] else qpos,
            command=command @ matrix if sides[1] else command,
        )

    eye = np.eye(joints)
    for column, sides in columns.items():
        for joint in range(joints):
            words = f"{column} of {names[joint]} with the other sign"
            yield words, changed(sides, eye - 2 * np.outer(eye[joint], eye[joint]))
        for first, second in combinations(range(joints), 2):
            order = np.arange(joints)
            order[[first, second]] = second, first
            yield (
                f"{column} of {names[first]} and {names[second]} exchanged",
                changed(sides, eye[order]),
            )
    yield f"{log.kind} of all joints with the other sign", changed((False, True), -eye)
    if log.kind == "effort":
        yield "effort in thousandths of SI units", changed((False, True), 1e-3 * eye)
        return
    for shift in np.arange(0.01, 0.06, 0.01):
        words = f"setpoints that were logged {1e3 * shift:.0f} ms late"
        yield words, replace(log, command_time=log.command_time - shift)


class Regression:
    """Efforts that motions of logs require, and efforts of the motors so far, for regressions at
    any delay.
    """

    def __init__(
        self,
        plants: Sequence[Plant],
        drives: Sequence[LogControl],
        logs: Sequence[Log],
        motions: Sequence[Motion],
    ) -> None:
        dt = drives[0].timestep
        self._setpoints = drives[0].params is not None
        share = sum(len(motion.qpos) for motion in motions) / MOST_ROWS
        cutoff = min(CUTOFF, *(0.2 / float(np.median(np.diff(log.time))) for log in logs))
        tables, efforts = list[Any](), list[Float64]()
        for plant, drive, motion in zip(plants, drives, motions, strict=True):
            edge = min(round(EDGE / dt), len(motion.qpos) // 5)
            rows = np.arange(edge, len(motion.qpos) - edge, max(1, round(share)))
            required, held = _required(plant, drive, motion, rows)
            commanded = _efforts(plant, drive, motion)
            if held is not None and drive.through:
                commanded = commanded + held
            elif held is not None:
                required = required - held[rows]
            time = dt * np.arange(commanded.shape[1])
            late = [
                np.stack([interpolated(time[rows] - delay, time, effort) for delay in DELAYS])
                for effort in (
                    commanded
                    if self._setpoints
                    else [lowpass(effort, cutoff, dt) for effort in commanded]
                )
            ]
            still = 0.01 * np.abs(motion.qvel).max(0) + 1e-9
            sign = lowpass(np.clip(motion.qvel / still, -1, 1), cutoff, dt)[rows]
            tables.append((required, motion.qacc[rows], motion.qvel[rows], sign))
            efforts.append(np.stack(late))
        self.required, self._acceleration, self._velocity, self._sign = map(
            np.concatenate, zip(*tables, strict=True)
        )
        self.efforts = np.concatenate(efforts, axis=2)
        """Efforts of the motors (setpoint delays, delays, rows, joints)."""
        speed = np.abs(self._velocity)
        fast = speed > MOVES * np.sqrt((speed**2).mean(0))
        self._moves = fast | (fast.sum(0) < 50)

    def best(self) -> Guess:
        """Return the guess with the least cost over all delays."""
        places = np.ndindex(self.efforts.shape[:2])
        return min((self._at(*place) for place in places), key=lambda guess: guess.cost)

    def _at(self, first: int, second: int) -> Guess:
        effort, rows = self.efforts[first, second], list[Float64]()
        cost = unexplained = 0.0
        for joint, moves in enumerate(self._moves.T):
            columns = [
                -self._acceleration,
                -self._velocity,
                -self._sign,
                effort,
                np.ones_like(effort),
            ]
            matrix = np.stack([column[moves, joint] for column in columns], axis=1)
            target = self.required[moves, joint]
            links, whole = (np.mean(table**2) for table in (target, matrix[:, 3]))
            values, residual = _bounded(matrix, target, links < LEAST_SHARE**2 * whole)
            size = np.sqrt((matrix[:, 3] ** 2).mean()) + np.sqrt((target**2).mean()) + 1e-12
            share = 1 / len(self._moves.T)
            cost += share * np.log((residual**2).mean() / size**2 + 1e-12)
            motor = values[3] ** 2 * (matrix[:, 3] ** 2).mean()
            unexplained += share * np.log((residual**2).mean() / (motor + 1e-12) + 1e-12)
            rows.append(values)
        names = ("armature", "damping", "friction", "strength", "bias")
        motors = dict(zip(names, np.array(rows).T, strict=True))
        delays = {"delay": DELAYS[[second]], "setpoint_delay": SETPOINT_DELAYS[[first]]}
        return Guess(motors | delays, float(cost), float(unexplained))


def _bounded(matrix: Float64, target: Float64, is_strong: bool) -> tuple[Float64, Float64]:
    """Return armature, damping, friction (at least 0), strength (0.2 to 3) and bias, and the
    residual.

    The strength is 1 if ``is_strong``.
    """
    size = np.abs(matrix).max(0) + 1e-12
    scaled = matrix / size
    gram = scaled.T @ scaled
    weight = (
        WEIGHT**2
        * len(target)
        * size[3] ** -2
        * (target**2).mean()
        / max((target**2).mean(), 1e-12)
    )
    gram[np.arange(5), np.arange(5)] += 1e-8 * len(target)
    gram[3, 3] += weight
    moment = scaled.T @ target
    moment[3] += weight * size[3]
    fixed = np.array([False, False, False, is_strong, False])
    values = size * fixed
    for _ in range(4):
        free = ~fixed
        rest = moment[free] - gram[np.ix_(free, fixed)] @ values[fixed]
        values[free] = np.linalg.solve(gram[np.ix_(free, free)], rest)
        low = np.array([0, 0, 0, STRENGTHS[0] * size[3], -np.inf])
        high = np.array([np.inf, np.inf, np.inf, STRENGTHS[1] * size[3], np.inf])
        outside = free & ((values < low) | (values > high))
        if not outside.any():
            break
        values, fixed = np.clip(values, low, high), fixed | outside
    values /= size
    values[3] = np.clip(values[3], *STRENGTHS)  # exactly, after the rounding of the division
    return values, target - matrix @ values


def _required(
    plant: Plant, drive: LogControl, motion: Motion, rows: Any
) -> tuple[Float64, Float64 | None]:
    """Return the efforts (rows, joints) that a motion requires, and the compensation (steps,
    joints).
    """
    q, v, a = (np.ascontiguousarray(table[rows]) for table in motion[:3])
    dynamics = plant.dynamics([()] * len(q), q, v)
    dynamics.update()
    required = (dynamics.matrix @ a[..., None])[..., 0] + dynamics.force
    if drive.compensate == "none":
        return required, None
    speed = 0.0 if drive.compensate == "gravity" else 1.0
    held = plant.dynamics([()] * len(motion.qpos), motion.qpos, speed * motion.qvel)
    held.update()
    return required, held.force


def _efforts(plant: Plant, drive: LogControl, motion: Motion) -> Float64:
    """Return logged efforts (1, steps, joints), or the law's along a motion (setpoint delays,
    steps, joints).
    """
    if drive.params is None:
        return motion.command[None]
    count, steps = len(SETPOINT_DELAYS), len(motion.qpos)
    ideal = PlantCandidates(Actuators(), {}, SETPOINT_DELAYS, ((),) * count)
    first = np.tile(motion.qpos[0], (count, 1))
    control = Control(drive, ideal, first, np.tile(motion.qvel[0], (count, 1)), None, plant.turns)
    late = np.rint(SETPOINT_DELAYS / drive.timestep).astype(int)
    efforts = np.empty((count, steps, motion.qpos.shape[1]))
    for step in range(steps):
        q, v = (np.tile(table[step], (count, 1)) for table in (motion.qpos, motion.qvel))
        efforts[:, step] = control.advance(motion.command[np.maximum(step - late, 0)], q, v, None)
    return efforts if motion.feedforward is None else efforts + motion.feedforward
