r"""Moves to evaluate gains on: seeded, free of contact, with the shortest duration that the effort
limits allow.

A move is a step of the setpoint from rest at ``start`` to ``target``. The straight line between
them, which good gains follow, is tested for contact, and so is its continuation by as much as a
good move may overshoot. On that line q(z) = start + z (target - start) all joints move in
proportion, so that the effort of a motion z(t) in time T is gravity(q) + h / T^2 + B q' / T + F
sgn(q'), with h and q' of the same motion in unit time, joint damping B and friction F. The shortest
bang-bang motion, accelerating up to half the way and braking from there, has in closed form::

    T = max over joints and line of the positive root of room_j T^2 - B_j |q_j'| T - |h_j|

    room_j = limit_j -+ gravity_j - F_j         B and F without effect where they help to brake

Such a motion exists, so the shortest of all motions takes no longer. The duration of a smooth
(minimum-jerk) motion is the longer of two: the one that a share of room_j allows, in the same form,
and the one at a share of the velocity limits.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import integer, number
from batchpid.errors import InvalidArgumentError
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_model import RobotModel

KINDS = ("large", "small", "one joint", "all alike")
"""Kinds of random moves, in turn: up to ``size``; up to a tenth of it; of one joint; of all joints
by one fraction.
"""
MAX_OVERSHOOT = 0.05
"""Overshoot that a good move may have, as a fraction of it."""
LONGEST = 1.0
"""Shortest duration [s] above which a random move is too hard for the effort limits to be drawn."""
SMOOTH_VELOCITY, SMOOTH_EFFORT = 0.5, 0.7
"""Shares of the velocity limits, and of the effort limits beside gravity, that a smooth motion may
take.
"""
FREE_VELOCITY = {"rad": 2.0, "m": 0.3}
"""Velocity limit of joints without one, in a smooth motion, per second."""
_PEAK_VELOCITY = 15 / 8  # of the minimum-jerk motion in unit time
_LINE = 24
"""Points of a move's line."""
_EASY = 0.6
_ROUNDS = 80
_TRIED = 8
_CHANGED = 0.3
_STUCK = 0.9
"""Share of poses in which a joint cannot move by its effort limit, above which no move moves it."""
_CLEARANCE, _ROOMY = 1e-3, 1e-2  # m
_EDGE = 0.02
_PATIENCE = 50
"""Draws in vain after which moves get smaller."""
_NEARBY = 0.3


class Moves(NamedTuple):
    """Steps from rest: start and target (moves, dof) [rad or m], and a name for each."""

    start: Float64
    target: Float64
    names: tuple[str, ...]

    def __add__(self, other: object) -> Moves:
        if not isinstance(other, Moves):
            return NotImplemented
        return Moves(
            np.concatenate([self.start, other.start]),
            np.concatenate([self.target, other.target]),
            self.names + other.names,
        )

    def take(self, rows: Iterable[int]) -> Moves:
        """Return the moves ``rows``."""
        rows = list(rows)
        return Moves(self.start[rows], self.target[rows], tuple(self.names[row] for row in rows))


def tutorial_move(robot: Robot) -> Moves:
    """Return the move of a bundled robot's settings; none for other robots."""
    if robot.settings is None:
        return Moves(np.empty((0, robot.dof)), np.empty((0, robot.dof)), ())
    return Moves(robot.settings.start[None], robot.settings.target[None], ("tutorial",))


def search_moves(robot: Robot, seed: int = 0) -> Moves:
    """Return the moves that gains are searched on.

    The tutorial's, where there is one, with the hardest of 64 that start within 0.3 rad [or m] of
    it; a random move of each kind; and the hardest of 28 more. The hardest needs most time under
    the effort limits, so it limits how fast the gains may be.
    """
    moves = tutorial_move(robot)
    drawn = random_moves(robot, 32, seed)
    if robot.settings is not None:
        spread = np.minimum(_NEARBY, (robot.upper - robot.lower) / 4)
        shift = np.random.default_rng(seed).uniform(-spread, spread, (64, robot.dof))
        starts = np.clip(robot.settings.start + shift, robot.lower, robot.upper)
        near = Moves(starts, np.tile(robot.settings.target, (64, 1)), ("near the tutorial's",) * 64)
        moves += _hardest(robot, near)
    return (
        moves + drawn.take(range(len(KINDS))) + _hardest(robot, drawn.take(range(len(KINDS), 32)))
    )


def _hardest(robot: Robot, moves: Moves) -> Moves:
    duration = shortest_durations(robot, moves)
    return moves.take([int(np.argmax(np.where(np.isfinite(duration), duration, -1.0)))])


def random_moves(
    robot: Robot, count: int, seed: int = 0, size: float = 2.0, ground: bool | None = None
) -> Moves:
    """Return ``count`` seeded moves within the joint limits, free of contact on the straight line
    and 5 % beyond it.

    Starts are uniform over :meth:`Robot.sample`, 2 % off the limits; targets within ``size`` [rad,
    or m but at most the whole range] of them, by the :data:`KINDS` in turn. The effort limits allow
    each move within LONGEST, and hold its ends. If few poses are free of contact, as with many
    fingers or legs, or if the robot is weak, moves lie nearer to its start pose, or to the pose
    that it holds most easily: after every 50 rejected draws, the range of starts and steps is
    halved. ``ground`` says whether there is one at height 0, by default as
    :attr:`Robot.has_ground`.

    Raises
    ------
    InvalidArgumentError
        ``count``, ``seed`` or ``size`` is out of range, or there are no such moves: the robot
        touches itself, or is too weak, in nearly every pose.
    """
    count = integer("count", count, 0, 100_000)
    size = number("size", size, 1e-3, 10.0, "rad or m")
    dynamics = robot.dynamics(ground)
    rng = np.random.default_rng(integer("seed", seed, 0, 2**63 - 1))
    poses = robot.sample(1000, seed=0)
    reach = np.ptp(poses, axis=0)
    low = robot.lower + _EDGE * reach
    high = robot.upper - _EDGE * reach
    line = np.linspace(0, 1 + MAX_OVERSHOOT, _LINE)[:, None]
    center, movable = easy_pose(robot, dynamics, poses[:200])
    if dynamics.in_contact(center[None], _CLEARANCE)[0]:
        clearance = 0.0
    else:
        clearance = _CLEARANCE
    share, in_vain = 1.0, 0
    moves = list[tuple[Float64, Float64, str]]()
    for _ in range(200 * count + 200):
        if len(moves) == count:
            break
        # Where few poses are free of contact, moves get smaller.
        if in_vain == _PATIENCE:
            share = share / 2
            in_vain = 0
        kind = KINDS[len(moves) % len(KINDS)]
        pose = robot.sample(1, seed=int(rng.integers(2**31)))[0]
        start = np.clip(pose if share == 1 else center + share * (pose - center), low, high)
        joint = rng.integers(robot.dof)
        fraction = rng.uniform(-1, 1, robot.dof)
        if kind == "all alike":
            fraction[:] = fraction[0]
        if kind == "one joint":
            joint = robot.coupling.leader[joint]
            fraction[np.arange(robot.dof) != joint] = 0.0
            kind = f"{robot.joint_names[joint]} alone"
        span = np.minimum(size, reach) * (0.1 if kind == "small" else 1.0)
        start, target = (
            robot.coupled(ends)
            for ends in (start, np.clip(start + movable * share * fraction * span, low, high))
        )
        # The ends are tested first: most moves in contact are so at an end.
        path = start + line * (target - start)
        touches = any(dynamics.in_contact(q, clearance).any() for q in (path[[0, -1]], path))
        move = Moves(start[None], target[None], (kind,))
        if touches or shortest_durations(robot, move)[0] > LONGEST:
            in_vain += 1
            continue
        in_vain = 0
        moves.append((start, target, kind))
    if len(moves) < count:
        problem = (
            f"{robot.name!r} touches itself or the ground where it should not, or is too weak, in"
            f" nearly every draw of a move: {len(moves)} of {count} were found"
        )
        remedy = (
            "give the moves or gains yourself, or correct what batchpid inspect lists as touching"
            " or weak"
        )
        raise InvalidArgumentError("robot", problem, remedy=remedy)
    starts, targets = (
        np.array([move[end] for move in moves]).reshape(-1, robot.dof) for end in (0, 1)
    )
    return Moves(starts, targets, tuple(name for _, _, name in moves))


def easy_pose(
    robot: Robot, dynamics: RobotModel, poses: Float64
) -> tuple[Float64, NDArray[np.bool_]]:
    """Return the pose about which moves lie if they are hard to find, and the joints that can move
    (dof,).

    It is the start pose if its links are well apart and the effort limits hold it easily. Otherwise
    a better pose is found by descent: some joints of the best pose so far move towards random
    poses, by smaller and smaller steps.
    """
    rng = np.random.default_rng(0)

    def shares(qpos: Float64) -> Float64:
        still = np.zeros_like(qpos)
        return np.abs(motion_effort(robot, qpos, still, still)) / robot.design_effort_limit

    def cost(qpos: Float64, share: float) -> tuple[float, ...]:
        levels = (0.0, _CLEARANCE, _ROOMY)  # contact at one of them is contact at the next
        apart = next(
            (n for n, level in enumerate(levels) if dynamics.in_contact(qpos[None], level)[0]),
            len(levels),
        )
        return float(apart == 0), float(share >= 1), float(len(levels) - apart), max(share, _EASY)

    # A joint that cannot hold itself nearly anywhere does not move.
    movable = (shares(poses) + robot.friction / robot.design_effort_limit >= 1).mean(0) <= _STUCK
    center = robot.start
    least = cost(center, float(shares(center[None]).max()))
    for spread in np.geomspace(1.0, 0.05, _ROUNDS):
        if least == (0, 0, 0, _EASY):
            break
        changed = rng.random(poses.shape) < _CHANGED
        tried = robot.coupled(np.where(changed, center + spread * (poses - center), center))
        # The contact of a pose takes long to compute: the easiest poses are tried first.
        share = shares(tried).max(1)
        for index in np.argsort(share, kind="stable")[:_TRIED]:
            if (move_cost := cost(tried[index], float(share[index]))) < least:
                center = tried[index]
                least = move_cost
                break
    return center, movable


def shortest_durations(robot: Robot, moves: Moves) -> Float64:
    """Return the time of the shortest bang-bang motion along each move (moves,) [s]; inf if gravity
    forbids it.
    """
    t = (np.arange(2 * _LINE)[:, None] + 0.5) / (2 * _LINE)
    early = t < 0.5
    z = np.where(early, 2 * t**2, 1 - 2 * (1 - t) ** 2)
    return _durations(
        robot, moves, z, np.where(early, 4 * t, 4 * (1 - t)), np.where(early, 4.0, -4.0)
    )


def smooth_durations(robot: Robot, moves: Moves) -> Float64:
    """Return the time of a minimum-jerk motion along each move that a robot follows with ease
    (moves,) [s].

    No joint is faster than half its velocity limit (FREE_VELOCITY where it has none), and motion
    and friction take at most 0.7 of the effort that gravity leaves. Where gravity leaves none, the
    velocity limits alone count.
    """
    velocity = np.where(
        np.isfinite(robot.velocity_limit),
        robot.velocity_limit,
        [FREE_VELOCITY[u] for u in robot.units],
    )
    by_velocity = (
        _PEAK_VELOCITY * np.abs(moves.target - moves.start) / (SMOOTH_VELOCITY * velocity)
    ).max(1)
    t = (np.arange(2 * _LINE)[:, None] + 0.5) / (2 * _LINE)
    profile = (
        t**3 * (10 - 15 * t + 6 * t**2),
        30 * t**2 * (1 - t) ** 2,
        60 * t * (1 - t) * (1 - 2 * t),
    )
    by_effort = _durations(robot, moves, *profile, SMOOTH_EFFORT)
    return np.maximum(by_velocity, np.where(np.isfinite(by_effort), by_effort, 0.0))


def _durations(
    robot: Robot, moves: Moves, z: Float64, rate: Float64, acceleration: Float64, share: float = 1.0
) -> Float64:
    """Return the shortest time (moves,) [s] of a motion z in unit time that takes ``share`` of the
    room; inf: none.
    """
    limit = robot.design_effort_limit
    durations = np.full(len(moves.start), np.inf)
    for row, (start, target) in enumerate(zip(moves.start, moves.target, strict=True)):
        step = target - start
        qpos = start + z * step
        still = np.zeros_like(qpos)
        # The effort is linear in 1 / T^2: gravity, and the motion in unit time.
        gravity = motion_effort(robot, qpos, still, still)
        moving = motion_effort(robot, qpos, rate * step, acceleration * step) - gravity
        along = moving * step > 0  # there friction and damping take their share of the effort
        room = (
            share * np.where(moving > 0, limit - gravity, limit + gravity) - along * robot.friction
        )
        # Without room somewhere on the line there is no motion, however slow.
        if (room > 0).all() and (np.abs(gravity) < limit).all():
            drag = along * robot.damping * np.abs(rate * step)  # room T^2 - drag T - |moving| >= 0
            durations[row] = (
                (drag + np.sqrt(drag**2 + 4 * room * np.abs(moving))) / (2 * room)
            ).max()
    return durations


def motion_effort(robot: Robot, qpos: Float64, qvel: Float64, qacc: Float64) -> Float64:
    """Return the efforts (n, dof) [N m or N] of a motion, gravity included; followers have none,
    their leaders more.
    """
    return robot.coupling.efforts(robot.dynamics().inverse_dynamics(qpos, qvel, qacc))


def smooth_effort(
    robot: Robot, start: Float64, target: Float64, duration: float, samples: int = 200
) -> Float64:
    """Return the efforts (samples, dof) of the minimum-jerk motion from ``start`` to ``target`` in
    ``duration`` [s].

    They overcome the joints' friction and damping.
    T. Flash and N. Hogan, "The coordination of arm movements", J. Neuroscience 5 (1985).
    """
    t = np.linspace(0, 1, samples)[:, None]
    step = target - start
    qpos = start + step * (10 * t**3 - 15 * t**4 + 6 * t**5)
    qvel = step * (30 * t**2 - 60 * t**3 + 30 * t**4) / duration
    qacc = step * (60 * t - 180 * t**2 + 120 * t**3) / duration**2
    dissipation = robot.damping * qvel + robot.friction * np.sign(qvel)
    return motion_effort(robot, qpos, qvel, qacc) + dissipation


def smooth_variation(robot: Robot, moves: Moves, durations: Float64 | float) -> Float64:
    """Return the total variation of :func:`smooth_effort` on each move (moves, dof) [N m or N].

    ``durations`` [s] are (moves,) or one for all. Less than a thousandth of the joint's effort
    limit counts as that. Followers have the variation of their leaders.
    """
    rows = zip(moves.start, moves.target, np.broadcast_to(durations, len(moves.start)), strict=True)
    variation = [np.abs(np.diff(smooth_effort(robot, *row), axis=0)).sum(0) for row in rows]
    return robot.coupling.of_leaders(np.maximum(variation, 1e-3 * robot.design_effort_limit))
