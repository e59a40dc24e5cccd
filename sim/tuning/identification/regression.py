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
PAYLOADS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0)
"""Payloads that are tried [kg]."""
_PRIOR = 0.1
STRONG_PRIOR = 3.0
"""Weight of the prior at strength 1 of a start that is safe where the log hardly shows the strengths."""
_WEAK = (0.05**2,) * 3


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


def regress(plant: Plant, logs: list[Log], motions: list[Motion], payload: bool, prior: float = _PRIOR) -> Start:
    """Return the motors, and the payload if asked, that explain the filtered efforts best."""
    from scipy.signal import butter, sosfiltfilt

    drive, dt = plant.drive, plant.drive.timestep
    period = max(float(np.median(np.diff(log.time))) for log in logs)
    sections = butter(4, min(CUTOFF, 0.2 / period), fs=1 / dt, output="sos")
    delays = np.arange(0.0, MAX_DELAY, DELAY_STEP)
    blocks: list[tuple[Float64, ...]] = []
    late: list[Float64] = []
    for motion in motions:
        edge = min(round(EDGE / dt), len(motion.qpos) // 5)
        rows = np.arange(edge, len(motion.qpos) - edge, max(1, round(_EVERY / dt)))
        v, a = motion.qvel[rows], motion.qacc[rows]
        empty, loaded = (_required(plant, motion, rows, kg) for kg in (0.0, 1.0 if payload else 0.0))
        effort = motion.command if drive.params is None else law_efforts(drive, plant, motion)
        if drive.through and (held := plant.compensation(motion.qpos, motion.qvel)) is not None:
            effort = effort + held
        if drive.params is None:  # the law's efforts are of filtered positions already
            effort = sosfiltfilt(sections, effort, axis=0)
        time = np.arange(len(effort)) * dt
        late.append(
            np.array([np.stack([np.interp(time[rows] - d, time, u) for u in effort.T], axis=1) for d in delays])
        )
        still = 0.01 * np.abs(v).max(0) + 1e-9
        sign = sosfiltfilt(sections, np.clip(motion.qvel / still, -1, 1), axis=0)[rows]
        blocks.append((empty, loaded - empty, a, v, sign))
    empty, per_kg, a, v, sign = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    efforts = np.concatenate(late, axis=1)

    def solve(index: int, kg: float) -> tuple[float, Float64]:
        both = [
            _solve_joint(empty[:, j] + kg * per_kg[:, j], a[:, j], v[:, j], sign[:, j], efforts[index, :, j], prior)
            for j in range(len(plant.joints))
        ]
        return float(sum(np.log(mean + 1e-30) for mean, _ in both)), np.array([found for _, found in both]).T

    best, kg = min(range(len(delays)), key=lambda index: solve(index, 0.0)[0]), 0.0
    if payload:
        for _ in range(2):
            near = best
            kg = min(PAYLOADS, key=lambda each: solve(near, each)[0])
            best = min(range(len(delays)), key=lambda index: solve(index, kg)[0])
    cost, columns = solve(best, kg)
    armature, damping, friction, strength, bias = columns[:, None]
    common = (np.array([[value]]) for value in (delays[best], STOPPING, kg))
    return Start(Motors(armature, damping, friction, strength, bias, *common), cost)


def _required(plant: Plant, motion: Motion, rows: Any, payload: float) -> Float64:
    """Return the efforts that a motion takes beyond what the robot compensates apart from its motors."""
    q, v, a = (table[rows] for table in motion[:3])
    kg = np.full((len(q), 1), payload)
    effort = (plant.mass_matrix(q, kg) @ a[..., None])[..., 0] + plant.passive(q, v, kg)
    held = None if plant.drive.through else plant.compensation(q, v, kg)
    return effort if held is None else effort - held


def _solve_joint(
    required: Float64, a: Float64, v: Float64, sign: Float64, effort: Float64, weight: float
) -> tuple[float, Float64]:
    """Return the mean square of the residual, and armature, damping, friction, strength and bias of a joint."""
    from scipy.optimize import lsq_linear

    columns = np.stack([a, v, sign, -effort, -np.ones_like(a)], axis=1)
    size = np.abs(columns).max(0) + 1e-12
    matrix = columns / size
    prior = (
        (_PRIOR * (np.sqrt((effort**2).mean()) + 1e-9)) ** 2 * len(a) * np.array([*_WEAK, 1 / size[3] ** 2, _WEAK[0]])
    )
    information = matrix.T @ matrix + np.diag(prior)
    target = -matrix.T @ required + prior * np.array([0, 0, 0, size[3], 0])
    root = np.linalg.cholesky(information + 1e-12 * np.eye(5))
    low = np.array([0, 0, 0, 0.2, -np.inf]) * size
    high = np.array([np.inf, np.inf, np.inf, 3.0, np.inf]) * size
    found = lsq_linear(root.T, np.linalg.solve(root, target), (low, high)).x
    return float(((matrix @ found + required) ** 2).mean()), found / size


def hypotheses(drive: Drive, payload: bool) -> list[Drive]:
    """Return the ways in which the robot may compensate: outside its motors, knowing its payload or not, or through.

    The logged efforts may also hold the compensation.
    """
    if drive.compensate == "none":
        return [drive]
    ways = [drive, replace(drive, through=True)]
    if payload:
        ways.append(replace(drive, knows_payload=True))
    return ways if drive.params is not None else [*ways, replace(drive, compensate="none")]


def best_start(
    robot: Any, joints: tuple[int, ...], drive: Drive, logs: list[Log], payload: bool
) -> tuple[Drive, Start, list[Motion]]:
    """Return the drive that explains the logs best, with its start and the smoothed motions."""
    motions = [smooth(log, drive.timestep) for log in logs]
    ways = hypotheses(drive, payload)
    starts = [(regress(Plant(robot, joints, each), logs, motions, payload), each) for each in ways]
    start, chosen = min(starts, key=lambda pair: pair[0].cost)
    return chosen, start, motions
