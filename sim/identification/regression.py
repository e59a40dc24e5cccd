r"""Start of the fit: smoothed motions, and the inverse dynamics as a linear regression at given
delays.

With the measured motion filtered without phase lag, and the effort u filtered in the same way, each
joint obeys::

    s u(t - d) + b - h - (M q'')_j = A q''_j + B q'_j + F sgn(q'_j)

which is solved by least squares with A, B, F, s >= 0, where the joint moves fast enough not to
stick (J. Swevers, W. Verdonck and J. De Schutter, "Dynamic model identification for industrial
robots", IEEE Control Systems Magazine 27(5), 2007). Under the PID law u follows from the setpoints
and the filtered positions. The delays with the least residual are taken from a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import wrap
from batchpid.motors.friction import compensation
from batchpid.sim.identification.log import Log, interpolated
from batchpid.sim.identification.simulator import LogData, Motion
from batchpid.task_space.tree_quantities import inverse_dynamics

VALUES = "armature", "damping", "friction", "strength", "bias", "cost"
"""Results of a joint."""
CUTOFF = 15.0
"""Corner of the filter [Hz]."""
EFFORT_DELAYS = np.arange(0.0, 0.03, 1e-3)
LOOP_DELAYS = EFFORT_DELAYS[:9]
SETPOINT_DELAYS = np.arange(-0.05, 0.06, 5e-3)
"""Delays that are tried [s]: of logged efforts, of the efforts of a PID law, and of setpoints. A
delay of setpoints is negative where they were logged late. Loops have short delays of efforts.
"""
EDGE_SECONDS = 0.15
"""Time left out at both ends of a log, where the filter begins [s]."""
LONGEST_PART = 30.0
"""Length of a log that is used [s]."""
MOST_REGRESSION_ROWS = 4000
"""Most rows of a regression."""
MOVES = 0.4
"""Speed, over its root mean square, below which a joint may stick."""
WEIGHT = 0.02
"""Weight of the prior at strength 1, over the effort's size."""
ALIKE_COSTS = 1.4
"""Difference of costs below which two explanations count as equally good: a factor of 2 in the
residuals.
"""
LEAST_SHARE = 0.05
"""Share of a joint's effort that moves the links, below which its strength is not identifiable: the
motor's inertia and friction take the rest, which determines their ratios to the strength only.
"""


Guess = dict[str, Float64]
"""Motors by a regression: values (joints,) or (1,) by kind of unknown, and "cost": log(mean square of
the residual / mean square of the motor's effort) of each joint.
"""


def smooth(log: Log, timestep: float) -> Motion:
    """Return the motion of ``log`` on the grid, filtered without phase lag."""
    time = log.time[0] + timestep * np.arange(int(log.seconds / timestep + 1e-6) + 1)
    qpos = lowpass(interpolated(time, log.time, log.qpos), _cutoff(log), timestep)
    qvel = np.gradient(qpos, timestep, axis=0)
    qacc = np.gradient(qvel, timestep, axis=0)
    return Motion(qpos, qvel, qacc, log.commands_at(time))


def _cutoff(log: Log) -> float:
    return min(CUTOFF, 0.2 / float(np.median(np.diff(log.time))))


def lowpass(table: Float64, cutoff: float, timestep: float) -> Float64:
    """Return the columns of a table (steps, columns) without frequencies above ``cutoff`` [Hz],
    without phase lag: a Butterworth filter of order 4, forwards and backwards.
    """
    from scipy import signal

    sections = signal.butter(4, cutoff, fs=1 / timestep, output="sos")
    # The filter settles on an odd extension of the ends.
    added = min(round(EDGE_SECONDS / timestep), len(table) - 1)
    return np.asarray(signal.sosfiltfilt(sections, table, 0, padlen=added), float)


def regress(data: Sequence[LogData]) -> Guess:
    """Return the motors of logs at the delays of the least cost. Setpoints count as logged late, at
    a negative delay, only if no other delay explains the logs as well.
    """
    every = 1 + sum(len(part.motion.qpos) for part in data) // MOST_REGRESSION_ROWS
    cutoff = min(_cutoff(part.log) for part in data)
    shifts, delays = SETPOINT_DELAYS, LOOP_DELAYS
    if data[0].drive.mode == "effort":
        shifts, delays = np.zeros(1), EFFORT_DELAYS
    tables = [_table(part, delays, every, cutoff) for part in data]
    *columns, efforts = (np.concatenate(parts, axis=-2) for parts in zip(*tables, strict=True))
    speed = np.abs(columns[2])
    moves = speed > MOVES * np.sqrt((speed**2).mean(0))
    moves |= moves.sum(0) < 50
    guesses = list[Guess]()
    for shift, delay in np.ndindex(efforts.shape[:2]):
        joints = []
        for joint, fast in enumerate(moves.T):
            table = [column[fast, joint] for column in (*columns, efforts[shift, delay])]
            joints.append(_solve(table))
        guess = dict(zip(VALUES, np.array(joints).T, strict=True))
        guess |= {"delay": delays[[delay]], "setpoint_delay": shifts[[shift]]}
        guesses.append(guess)
    least = min(map(cost_of, guesses))
    # Logs show the sum of both delays; armature and damping can hide how it is divided.
    alike = [guess for guess in guesses if cost_of(guess) < least + ALIKE_COSTS]
    usual = [guess for guess in alike if guess["setpoint_delay"] > -1e-9]
    return min(usual or alike, key=cost_of)


def cost_of(guess: Guess) -> float:
    """Return the mean cost of the joints."""
    return float(guess["cost"].mean())


def _table(
    part: LogData,
    delays: Float64,
    every: int,
    cutoff: float,
) -> tuple[Float64, ...]:
    """Return columns of a log (rows, joints): the effort that the links need, acceleration,
    velocity, its sign, and the motors' efforts by delay of setpoints and of efforts.
    """
    dt = part.drive.timestep
    # The beginning of a long log is enough for a start.
    motion = Motion(*(table[: round(LONGEST_PART / dt)] for table in part.motion))
    part = part._replace(motion=motion)
    edge = min(round(EDGE_SECONDS / dt), len(motion.qpos) // 5)
    rows = np.arange(edge, len(motion.qpos) - edge, every)
    links = _force(part, motion.qpos[rows], motion.qvel[rows], motion.qacc[rows])
    efforts = _commanded(part)
    if part.drive.gravity:
        speed = float(part.drive.coriolis)
        compensated = _force(part, motion.qpos, speed * motion.qvel, 0 * motion.qacc)
        if part.drive.further:
            links -= compensated[rows]
        else:
            efforts = efforts + compensated
    if part.drive.mode == "effort":
        efforts = lowpass(efforts[0], cutoff, dt)[None]
    time = dt * np.arange(len(motion.qpos))
    late = [[interpolated(time[rows] - delay, time, u) for delay in delays] for u in efforts]
    still = 0.01 * np.abs(motion.qvel).max(0) + 1e-9
    sign = lowpass(np.clip(motion.qvel / still, -1, 1), cutoff, dt)[rows]
    return links, motion.qacc[rows], motion.qvel[rows], sign, np.array(late)


def _force(
    part: LogData,
    qpos: Float64,
    qvel: Float64,
    qacc: Float64,
) -> Float64:
    """Return the efforts (rows, joints) that the links need to move so, without motors."""
    plant = part.plant
    state = map(plant.spread, (qpos, qvel, qacc))
    return np.asarray(inverse_dynamics(plant.tree, *state)[:, plant.columns], float)


def _commanded(part: LogData) -> Float64:
    """Return logged efforts (1, steps, joints), or the law's along a motion (setpoint delays,
    steps, joints).
    """
    motion, drive = part.motion, part.drive
    if drive.mode == "effort":
        return motion.command[None]
    count, steps = len(SETPOINT_DELAYS), len(motion.qpos)
    late = np.rint(SETPOINT_DELAYS / drive.timestep).astype(int)
    setpoints = motion.command[np.clip(np.arange(steps)[:, None] - late, 0, steps - 1)]
    qpos, qvel = (np.repeat(table[:, None], count, axis=1) for table in motion[:2])
    forward = np.zeros_like(setpoints)
    if drive.modelled is not None:
        error = wrap(setpoints - qpos, drive.turns, np)
        forward = compensation(
            drive.modelled,
            error,
            None,
            drive.band,
        )
    law = bp.BatchPID(drive.params, count, drive.timestep)
    rates = qvel if drive.params.measurement_rate is not None else [None] * steps
    inputs = zip(setpoints, qpos, rates, forward, strict=True)
    efforts = [law(row, y, rate, feedforward=f) for row, y, rate, f in inputs]
    return np.array(efforts).swapaxes(0, 1)


def _solve(table: Sequence[Float64]) -> list[float]:
    """Return armature, damping, friction, strength and bias of a joint, and the cost.

    ``table`` has (rows,) the effort that the links need, acceleration, speed, its sign, and the
    effort of the motor.
    """
    from scipy import optimize

    target, *motion, effort = table
    columns: Any = np.stack([*(-column for column in motion), effort, target], axis=1)
    # The bias is the mean of what is left, so that the others are found without it.
    center = columns.mean(0)
    columns = columns - center
    size = np.sqrt((columns**2).mean(0)) + 1e-12
    # Where links need a small share of the effort, its strength cannot be found: it stays 1.
    weight = 1e3 if size[4] < LEAST_SHARE * size[3] else WEIGHT
    prior = np.sqrt(len(target)) * weight * size[3] + 1e-12
    rows = np.vstack([columns, [0.0, 0.0, 0.0, prior, prior]])
    triangle: Any = np.linalg.qr(rows / np.append(size[:4], 1.0), mode="r")
    values = optimize.nnls(triangle[:, :4], triangle[:, 4])[0] / size[:4]
    residual = columns[:, 4] - columns[:, :4] @ values
    bias = center[4] - center[:4] @ values
    motor = (values[3] * size[3]) ** 2 + 1e-3 * size[4] ** 2
    return [*values, bias, float(np.log((residual**2).mean() / motor + 1e-12))]
