r"""Motion that shows a robot's actuators: a chirp of every joint within its limits, free of contact.

Joint j sweeps its frequency exponentially from f0 to f1, on a wave of slowly changing amplitude about a center::

    q_j(t) = c_j + w(t) A_j(f) sin(phi_j(t)),     phi_j' = 2 pi f,     f = f0 (f1 / f0)^s_j(t)

    A_j(f)^-4 = A_max^-4 + (v_max / (2 pi f))^-4 + (a_max / (2 pi f)^2)^-4

so that it is limited by the joint's range at low frequencies, by velocity and by effort at higher ones. s_j runs from 0
to 1 and back as a cosine, shifted by the joint's share of the time, so that all joints move differently. The window w
rises from 0 and falls back within a tenth of the time: the motion begins and ends at rest at c. Low frequencies show
friction, gravity and strength, high ones inertia and delay.
"""

from __future__ import annotations

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import integer, number
from batchpid.errors import InvalidArgumentError
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tuning.moves import motion_effort
from batchpid.trajectories import Trajectory

REACH = {"rad": 0.8, "m": 0.1}
"""Largest amplitude, by the joint's unit."""
VELOCITY_SHARE, EFFORT_SHARE = 0.6, 0.7
"""Shares of the limits of velocity and effort that the motion takes."""
FREE_VELOCITY = {"rad": 2.0, "m": 0.3}
"""Velocity limit of joints without one, per second."""
CLEARANCE = 0.01
"""Least distance from contact [m]."""
_EDGE = 0.1
_DRAWS = 60
_SHARES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1)
_CHECKS = 400  # poses of a motion that are tested for contact
_WINDOW = 0.1
_SHARPNESS = 4


def excite(
    robot: Robot,
    duration: float = 10.0,
    *,
    rate: float = 500.0,
    lowest: float = 0.15,
    highest: float = 3.0,
    seed: int = 0,
) -> Trajectory:
    """Return setpoints (ticks, dof) that move every joint, from rest to rest at their first row.

    Parameters
    ----------
    duration
        Duration of the motion [s].
    rate
        Rows per second [Hz].
    lowest, highest
        Frequencies of the sweep [Hz].
    seed
        Seed of the phases, and of the center if the robot's start pose is too near to contact.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range, or the robot touches itself, or is too weak, near every pose.
    """
    duration, rate = number("duration", duration, 1.0, 3600.0, "s"), number("rate", rate, 20.0, 10_000.0, "Hz")
    lowest = number("lowest", lowest, 0.01, 50.0, "Hz")
    highest = number("highest", highest, lowest, rate / 10, "Hz, at most a tenth of the rate")
    rng = np.random.default_rng(integer("seed", seed, 0, 2**31 - 1))
    time = np.arange(1, round(duration * rate) + 1) / rate
    phase = rng.uniform(0, 2 * np.pi, robot.dof)
    best: tuple[float, Trajectory] | None = None
    for center in _centers(robot, rng):
        for share in _SHARES:
            if best is not None and share <= best[0]:
                break
            motion = _chirp(robot, center, share, time, lowest, highest, phase)
            if is_feasible(robot, motion):
                best = share, motion
                break
        if best is not None and best[0] >= 0.5:
            break
    if best is None:
        problem = f"{robot.name!r} touches itself or the ground, or is too weak, near every pose that was tried"
        remedy = "correct what batchpid inspect lists as touching or weak"
        raise InvalidArgumentError("robot", problem, remedy=remedy)
    return best[1]


def is_feasible(robot: Robot, motion: Trajectory) -> bool:
    """Return whether a motion keeps within the limits of position, velocity and effort, and free of contact."""
    inside = (motion.position >= robot.lower - 1e-9) & (motion.position <= robot.upper + 1e-9)
    slow = np.abs(motion.velocity) <= robot.velocity_limit
    if not (inside.all() and slow.all()):
        return False
    rows = np.unique(np.linspace(0, motion.ticks - 1, _CHECKS).astype(int))
    position, velocity = motion.position[rows], motion.velocity[rows]
    effort = motion_effort(robot, position, velocity, motion.acceleration[rows])
    effort += robot.damping * velocity + robot.friction * np.sign(velocity)
    if (np.abs(effort) > robot.design_effort_limit).any():
        return False
    return not robot.dynamics().in_contact(position, CLEARANCE).any()


def _centers(robot: Robot, rng: np.random.Generator) -> list[Float64]:
    """Return candidates for the center: the start pose, moved away from joint limits, and random poses."""
    low, high = np.maximum(robot.lower, robot.start - np.pi), np.minimum(robot.upper, robot.start + np.pi)
    edge = np.minimum(0.4 * (high - low), [REACH[unit] for unit in robot.units])
    poses = [robot.start, *robot.sample(_DRAWS, seed=int(rng.integers(2**31)))]
    return [robot.coupled(np.clip(pose, low + edge, high - edge)) for pose in poses]


def _chirp(
    robot: Robot, center: Float64, share: float, time: Float64, lowest: float, highest: float, phase: Float64
) -> Trajectory:
    """Return the chirp about ``center`` with amplitudes of ``share`` of the possible ones."""
    dt, total, dof = float(time[0]), float(time[-1]), robot.dof
    room = np.minimum(robot.upper - center, center - robot.lower) * (1 - _EDGE)
    reach = np.minimum(room, [REACH[unit] for unit in robot.units])
    velocity = np.minimum(robot.velocity_limit, [FREE_VELOCITY[unit] for unit in robot.units]) * VELOCITY_SHARE
    still = np.zeros((1, dof))
    left = robot.design_effort_limit - np.abs(motion_effort(robot, center[None], still, still)[0]) - robot.friction
    inertia = np.abs(robot.mass_matrix(center)[0]).sum(1)
    acceleration = EFFORT_SHARE * np.maximum(left, 0.05 * robot.design_effort_limit) / inertia
    shift = np.argsort(np.argsort(phase)) / dof  # each joint begins at another point of the sweep
    sweep = (1 - np.cos(2 * np.pi * (time[:, None] / total + shift))) / 2
    omega = 2 * np.pi * lowest * (highest / lowest) ** sweep
    limits = np.stack(np.broadcast_arrays(reach, velocity / omega, acceleration / omega**2))
    amplitude = share * (np.maximum(limits, 1e-12) ** -_SHARPNESS).sum(0) ** (-1 / _SHARPNESS)
    angle = phase + np.cumsum(omega, axis=0) * dt
    edge = np.clip(np.minimum(time, total - time) / (_WINDOW * total), 0.0, 1.0)[:, None]
    window = edge**3 * (10 - 15 * edge + 6 * edge**2)
    position = robot.coupled(center + window * amplitude * np.sin(angle))
    return Trajectory(time, position, np.gradient(position, dt, axis=0), _second(position, dt))


def _second(position: Float64, dt: float) -> Float64:
    return np.gradient(np.gradient(position, dt, axis=0), dt, axis=0)
