r"""Motion that shows a robot's actuators: a chirp of every joint within its limits, free of
contact.

Joint j sweeps its frequency exponentially from f0 to f1, on a wave of slowly changing amplitude
about a center::

    q_j(t) = c_j + w(t) A_j(f) sin(phi_j(t)),     phi_j' = 2 pi f,     f = f0 (f1 / f0)^s_j(t)

    A_j(f)^-4 = A_max^-4 + (v_max / (2 pi f))^-4 + (a_max / (2 pi f)^2)^-4

so that it is limited by the joint's range at low frequencies, by velocity and by effort at higher
ones. s_j runs from 0 to 1 and back as a cosine, shifted by the joint's share of the time, so that
all joints move differently. The window w rises in the first tenth of the time and falls in the last:
the motion begins and ends at rest at c. Low frequencies show friction, gravity and strength, high
ones inertia and delay.

A joint beyond its limits gets smaller amplitudes, and so do all joints where two links would come
too near each other, until the motion is free: about the start pose, or about another one with more
room.
"""

from __future__ import annotations

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.checks import integer, number
from batchpid.errors import InvalidArgumentError
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tuning.moves import FREE_VELOCITY, easy_pose, motion_effort
from batchpid.trajectories import Trajectory

REACH = {"rad": 0.8, "m": 0.1}
"""Largest amplitude, by the joint's unit."""
VELOCITY_SHARE, EFFORT_SHARE = 0.6, 0.7
"""Shares of the limits of velocity and effort that the motion takes."""
MOTION_CLEARANCE = 0.01
"""Least distance of all links from contact [m]; half of the smallest one at the center, if that is
less.
"""
_EDGE = 0.1
_DRAWS = 20
_SHRINK = 0.7
_LEAST = 0.04
"""Factor of an amplitude from one motion to the next, and its least share."""
_ENOUGH = 0.5  # mean share of the amplitudes with which no other center is tried
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

    A joint whose effort limit does not overcome its friction and gravity in nearly any pose stays
    still.

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
        An argument is out of range, or near every pose the robot touches itself or is too weak: the
        message names the links or the joint.
    """
    duration = number("duration", duration, 1.0, 3600.0, "s")
    rate = number("rate", rate, 20.0, 10_000.0, "Hz")
    lowest = number("lowest", lowest, 0.01, 50.0, "Hz")
    highest = number("highest", highest, lowest, rate / 10, "Hz, at most a tenth of the rate")
    rng = np.random.default_rng(integer("seed", seed, 0, 2**31 - 1))
    time = np.arange(1, round(duration * rate) + 1) / rate
    phase = rng.uniform(0, 2 * np.pi, robot.dof)
    easy, movable = easy_pose(robot)
    movable = movable if movable.any() else ~movable
    best = None
    most = 0.0
    obstacle = ""
    for center in _centers(robot, easy, rng):
        # The motion shrinks about a center until nothing is in its way.
        share = movable.astype(np.float64)
        while most < _ENOUGH and share[movable].min() >= _LEAST:
            motion = _chirp(
                robot,
                center,
                share,
                time,
                lowest,
                highest,
                phase,
            )
            problem, joints = _obstacle(robot, motion)
            obstacle = obstacle or problem
            # Followers move with their leaders.
            leaders = robot.coupling.leader[joints]
            if not share[leaders].any():
                if not problem and share.mean() > most:
                    most = float(share.mean())
                    best = motion
                break
            share[leaders] *= _SHRINK
    if best is not None:
        return best
    problem = f"{robot.name!r} has no free motion about any pose that was tried: {obstacle}"
    remedy = "disable pairs that only seem to touch in an .srdf, or correct masses and limits"
    raise InvalidArgumentError("robot", problem, remedy=remedy)


def _centers(robot: Robot, easy: Float64, rng: np.random.Generator) -> Float64:
    """Return candidates for the center (n, dof), away from joint limits: the start pose, the
    ``easy`` one, and random ones.
    """
    poses = np.vstack([robot.start, easy, robot.sample(_DRAWS, seed=int(rng.integers(2**31)))])
    low = np.maximum(robot.lower, robot.start - np.pi)
    high = np.minimum(robot.upper, robot.start + np.pi)
    edge = np.minimum(0.4 * (high - low), [REACH[unit] for unit in robot.units])
    coupled: Float64 = robot.coupling.positions(np.clip(poses, low + edge, high - edge))
    return coupled


def _obstacle(robot: Robot, motion: Trajectory) -> tuple[str, list[int]]:
    """Return what is in the way of a motion, "" for nothing, and the joints that have to move
    less.
    """
    rows = np.unique(np.linspace(0, motion.ticks - 1, _CHECKS).astype(int))
    position = motion.position[rows]
    velocity = motion.velocity[rows]
    effort = motion_effort(robot, position, velocity, motion.acceleration[rows])
    effort += robot.damping * velocity + robot.friction * np.sign(velocity)
    outside = (motion.position < robot.lower - 1e-9) | (motion.position > robot.upper + 1e-9)
    outside |= np.abs(motion.velocity) > robot.velocity_limit
    # A joint that stays still may be too weak to hold itself.
    weak = (np.abs(effort) > robot.design_effort_limit) & (np.ptp(position, axis=0) > 0)
    for exceeds, words in ((outside, "exceeds its limits"), (weak, "is too weak to move")):
        joints = np.flatnonzero(exceeds.any(0)).tolist()
        if joints:
            return f"joint {robot.joint_names[joints[0]]!r} {words}", joints
    # Links keep the distances of the center, or half of them where they are near there.
    contacts = robot.dynamics().contacts
    clearance = MOTION_CLEARANCE
    for row, pose in enumerate(position):
        for first, second, distance in contacts.near(pose, clearance):
            if row == 0 and distance > 0:
                clearance = min(clearance, 0.5 * distance)
            elif distance < clearance:
                names = " and ".join(repr(name) for name in (first, second or "ground"))
                return f"{names} touch", list(range(robot.dof))
    return "", []


def _chirp(
    robot: Robot,
    center: Float64,
    share: Float64,
    time: Float64,
    lowest: float,
    highest: float,
    phase: Float64,
) -> Trajectory:
    """Return the chirp about ``center`` with amplitudes of ``share`` (dof,) of the possible
    ones.
    """
    dt = float(time[0])
    total = float(time[-1])
    room = np.minimum(robot.upper - center, center - robot.lower) * (1 - _EDGE)
    reach = np.minimum(room, [REACH[unit] for unit in robot.units])
    fastest = np.minimum(robot.velocity_limit, [FREE_VELOCITY[unit] for unit in robot.units])
    still = np.zeros((1, robot.dof))
    load = np.abs(motion_effort(robot, center[None], still, still)[0]) + robot.friction
    left = np.maximum(robot.design_effort_limit - load, 0.05 * robot.design_effort_limit)
    acceleration = EFFORT_SHARE * left / np.abs(robot.mass_matrix(center)[0]).sum(1)
    # Each joint begins at another point of the sweep.
    shift = np.argsort(np.argsort(phase)) / robot.dof
    sweep = (1 - np.cos(2 * np.pi * (time[:, None] / total + shift))) / 2
    omega = 2 * np.pi * lowest * (highest / lowest) ** sweep
    limits = [reach + 0 * omega, VELOCITY_SHARE * fastest / omega, acceleration / omega**2]
    powers = np.maximum(limits, 1e-12) ** -_SHARPNESS
    amplitude = share * powers.sum(0) ** (-1 / _SHARPNESS)
    angle = phase + np.cumsum(omega, axis=0) * dt
    edge = np.clip(
        np.minimum(time, total - time) / (_WINDOW * total),
        0.0,
        1.0,
    )[:, None]
    window = edge**3 * (10 - 15 * edge + 6 * edge**2)
    position = robot.coupling.positions(center + window * amplitude * np.sin(angle))
    velocity = np.gradient(position, dt, axis=0)
    return Trajectory(time, position, velocity, np.gradient(velocity, dt, axis=0))
