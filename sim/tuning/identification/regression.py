r"""Start of the fit: inverse-dynamics regression, linear in all unknowns at a given delay.

With the measured motion filtered without phase lag, and the effort u filtered alike, each joint obeys::

    s u(t - d) + b + c - h - (M q'')_j = A q''_j + B q'_j + F sgn(q'_j)

which is solved by least squares with A, B, F >= 0, for each delay d of a grid (J. Swevers, W. Verdonck and J. De
Schutter, "Dynamic model identification for industrial robots", IEEE Control Systems Magazine 27(5), 2007; M. Gautier,
"Dynamic identification of robots with power model", ICRA 1997). Under the PID law u is computed from the filtered
positions. A weak prior keeps what the log does not show at strength 1.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.tuning.identification.logs import Log
from sim.tuning.identification.plant import Drive, Motors, Plant, law_efforts

Float64 = NDArray[np.float64]
CUTOFF = 15.0
"""Corner of the filter [Hz]."""
MAX_DELAY, DELAY_STEP = 0.03, 5e-4
"""Longest delay that is tried, and the step of the grid [s]."""
EDGE = 0.15
"""Time left out at both ends of a log, where the filter begins [s]."""
STOPPING = 5e-3
_EVERY = 0.005
_PRIOR = 0.1


class Motion(NamedTuple):
    """Smoothed motion of a log on the grid of the sim steps, from its first row on; arrays (steps, joints)."""

    qpos: Float64
    qvel: Float64
    qacc: Float64
    command: Float64


class Start(NamedTuple):
    """Result of the regression."""

    motors: Motors
    cost: float
    """Sum of the logarithms of the joints' mean squares of the efforts' residuals."""


def smooth(log: Log, timestep: float) -> Motion:
    """Return the motion of ``log`` on the grid, filtered without phase lag."""
    from scipy.signal import butter, sosfiltfilt

    time = log.time[0] + timestep * np.arange(int(log.seconds / timestep) + 1)
    raw = np.stack([np.interp(time, log.time, column) for column in log.qpos.T], axis=1)
    period = float(np.median(np.diff(log.time)))
    sections = butter(4, min(CUTOFF, 0.2 / period), fs=1 / timestep, output="sos")
    pad = min(len(raw) - 1, round(0.5 / timestep))
    qpos = sosfiltfilt(sections, raw, axis=0, padlen=pad)
    qvel = np.gradient(qpos, timestep, axis=0)
    return Motion(qpos, qvel, np.gradient(qvel, timestep, axis=0), log.commands_at(time))


def regress(plant: Plant, logs: list[Log], motions: list[Motion]) -> Start:
    """Return the motors that explain the filtered efforts best."""
    from scipy.optimize import lsq_linear
    from scipy.signal import butter, sosfiltfilt

    drive, joints = plant.drive, len(plant.joints)
    dt = drive.timestep
    every = max(1, round(_EVERY / dt))
    period = max(float(np.median(np.diff(log.time))) for log in logs)
    sections = butter(4, min(CUTOFF, 0.2 / period), fs=1 / dt, output="sos")
    delays = np.arange(0.0, MAX_DELAY, DELAY_STEP)
    blocks: list[tuple[Float64, ...]] = []
    late: list[Float64] = []
    for motion in motions:
        edge = min(round(EDGE / dt), len(motion.qpos) // 5)
        rows = np.arange(edge, len(motion.qpos) - edge, every)
        q, v, a = (table[rows] for table in motion[:3])
        none = np.zeros((len(rows), 1))
        inertial = (plant.mass_matrix(q, none) @ a[..., None])[..., 0]
        load = plant.passive(q, v, none)
        held = plant.compensation(motion.qpos, motion.qvel) if drive.through else plant.compensation(q, v)
        effort = motion.command if drive.params is None else law_efforts(drive, plant, motion)
        if drive.through and held is not None:
            effort = effort + held
        elif held is not None:
            load = load - held
        if drive.params is None:  # the law's efforts are of filtered positions already
            effort = sosfiltfilt(sections, effort, axis=0)
        time = np.arange(len(effort)) * dt
        late.append(
            np.stack([[np.interp(time[rows] - d, time, column) for column in effort.T] for d in delays]).transpose(
                0, 2, 1
            )
        )
        still = 0.01 * np.abs(v).max(0) + 1e-9
        sign = sosfiltfilt(sections, np.clip(motion.qvel / still, -1, 1), axis=0)[rows]
        blocks.append((inertial + load, v, a, sign))
    known, v, a, sign = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    efforts = np.concatenate(late, axis=1)
    found = np.empty((len(delays), joints, 5))
    rss = np.empty((len(delays), joints))
    for joint in range(joints):
        rms = np.sqrt((efforts[0, :, joint] ** 2).mean()) + 1e-9
        for index in range(len(delays)):
            u = efforts[index, :, joint]
            columns = np.stack([a[:, joint], v[:, joint], sign[:, joint], -u, -np.ones_like(u)], axis=1)
            size = np.abs(columns).max(0) + 1e-12
            matrix, target = columns / size, -known[:, joint]
            prior = _PRIOR * rms * np.sqrt(len(u)) * np.diag([0.05, 0.05, 0.05, 1 / size[3], 0.05])
            aim = np.array([0, 0, 0, prior[3, 3] * size[3], 0])
            low = np.array([0, 0, 0, 0.2, -np.inf]) * size
            high = np.array([np.inf, np.inf, np.inf, 3.0, np.inf]) * size
            fit = lsq_linear(np.vstack([matrix, prior]), np.concatenate([target, aim]), (low, high))
            found[index, joint] = fit.x / size
            rss[index, joint] = ((matrix @ fit.x - target) ** 2).mean()
    cost = np.log(rss + 1e-30).sum(1)
    best = int(np.argmin(cost))
    columns = found[best].T
    a, b, f, g, h = columns[:, None]
    motors = Motors(a, b, f, g, h, np.array([[delays[best]]]), np.array([[STOPPING]]), np.zeros((1, 1)))
    return Start(motors, float(cost[best]))


def hypotheses(drive: Drive) -> list[Drive]:
    """Return the ways in which the robot may compensate: outside its motors, or through them.

    The logged efforts may also hold the compensation.
    """
    if drive.compensate == "none":
        return [drive]
    outside = [drive, replace(drive, through=True)]
    return outside if drive.params is not None else [*outside, replace(drive, compensate="none")]


def best_start(robot: Any, joints: tuple[int, ...], drive: Drive, logs: list[Log]) -> tuple[Drive, Start, list[Motion]]:
    """Return the drive that explains the logs best, with its start."""
    motions = [smooth(log, drive.timestep) for log in logs]
    starts = [(regress(Plant(robot, joints, each), logs, motions), each) for each in hypotheses(drive)]
    start, chosen = min(starts, key=lambda pair: pair[0].cost)
    return chosen, start, motions
