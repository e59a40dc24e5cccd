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
from batchpid.checks import integer
from batchpid.errors import InvalidArgumentError
from batchpid.sim.robot.robot import Robot
from batchpid.trajectories import minimum_jerk

MOVE_KINDS = ("large", "small", "one joint", "all alike")
"""Kinds of random moves, in turn: up to :data:`LARGEST_STEP`; up to a tenth of it; of one joint; of all joints
by one fraction.
"""
LARGEST_STEP = 2.0
"""Largest step of a joint in a random move [rad or m]."""
MAX_OVERSHOOT = 0.05
"""Overshoot that a good move may have, as a fraction of it."""
LONGEST_MOVE = 1.0
"""Shortest duration [s] above which a random move is too hard for the effort limits to be drawn."""
SMOOTH_VELOCITY = 0.5
SMOOTH_EFFORT = 0.7
"""Shares of the velocity limits, and of the effort limits beside gravity, that a smooth motion may
take.
"""
FREE_VELOCITY = {"rad": 2.0, "m": 0.3}
"""Velocity limit of joints without one, in a smooth motion, per second."""
LINE = 24
"""Points of a move's line."""
SAMPLES = 200
"""Samples of the effort in a smooth motion."""
EDGE_SHARE = 0.02
"""Distance of a move from the joint limits, as a share of the range."""
PATIENCE = 50
"""Draws in vain after which moves get smaller."""
EASY = 0.6
"""Share of the effort limits up to which a pose is held easily."""
STUCK = 0.9
"""Share of poses in which a joint cannot move by its effort limit, above which no move moves it."""
TRIED_POSES = 200
"""Poses that are tested for contact."""
TOUCH_DISTANCE = 1e-3
"""Distance of links below which they touch [m]."""
ROOMY = 1e-2
"""Distance of links that are well apart [m]."""


class Moves(NamedTuple):
    """Steps from rest: start and target (moves, dof) [rad or m], and a name for each."""

    start: Float64
    target: Float64
    names: tuple[str, ...]

    def take(self, rows: Iterable[int]) -> Moves:
        """Return the moves ``rows``."""
        rows = list(rows)
        return Moves(
            self.start[rows],
            self.target[rows],
            tuple(self.names[row] for row in rows),
        )


def seeded_moves(robot: Robot, count: int, seed: int) -> Moves:
    """Return ``count`` :func:`random_moves`, of a bundled robot after the move of its settings."""
    start, target, names = moves = random_moves(robot, count, seed)
    settings = robot.settings
    if settings is None:
        return moves
    ends = np.vstack([settings.start, start]), np.vstack([settings.target, target])
    return Moves(*ends, ("tutorial", *names))


def random_moves(
    robot: Robot,
    count: int,
    seed: int = 0,
) -> Moves:
    """Return ``count`` seeded moves within the joint limits, free of contact on the straight line
    and 5 % beyond it.

    Starts are uniform over :meth:`Robot.sample`, 2 % off the limits; targets within 2 rad or m, but
    at most the whole range, of them, by the :data:`MOVE_KINDS` in turn. The effort limits allow
    each move within LONGEST_MOVE, and hold its ends. If few poses are free of contact, as with many
    fingers or legs, or if the robot is weak, moves lie nearer to its start pose, or to the pose
    that it holds most easily: after every 50 rejected draws, the range of starts and steps is
    halved.

    Raises
    ------
    InvalidArgumentError
        ``count`` or ``seed`` is out of range, or there are no such moves: the robot touches itself,
        or is too weak, in nearly every pose.
    """
    count = integer("count", count, 0, 100_000)
    rng = np.random.default_rng(integer("seed", seed, 0, 2**63 - 1))
    dynamics = robot.dynamics()
    reach = np.ptp(robot.sample(1000, seed=0), axis=0)
    low = robot.lower + EDGE_SHARE * reach
    high = robot.upper - EDGE_SHARE * reach
    line = np.linspace(0, 1 + MAX_OVERSHOOT, LINE)[:, None]
    center, movable = easy_pose(robot)
    clearance = TOUCH_DISTANCE
    # Around a pose in contact, only deeper contact can be avoided.
    if dynamics.in_contact(center[None], TOUCH_DISTANCE)[0]:
        clearance = 0.0
    moves = list[Moves]()
    share = 1.0
    in_vain = 0
    for _ in range(200 * count + 200):
        if len(moves) == count:
            ends = np.reshape([move[:2] for move in moves], (count, 2, robot.dof))
            return Moves(
                ends[:, 0],
                ends[:, 1],
                tuple(move.names[0] for move in moves),
            )
        if in_vain == PATIENCE:
            share /= 2
            in_vain = 0
        # Start, then a step of the next kind.
        pose = robot.sample(1, seed=int(rng.integers(2**31)))[0]
        start = np.clip(center + share * (pose - center), low, high)
        kind = MOVE_KINDS[len(moves) % len(MOVE_KINDS)]
        step = rng.uniform(-1, 1, robot.dof)
        joint = robot.coupling.leader[rng.integers(robot.dof)]
        if kind == "small":
            step /= 10
        elif kind == "all alike":
            step[:] = step[0]
        elif kind == "one joint":
            step[np.arange(robot.dof) != joint] = 0.0
            kind = f"{robot.joint_names[joint]} alone"
        step *= movable * share * np.minimum(LARGEST_STEP, reach)
        target = np.clip(start + step, low, high)
        move = Moves(
            robot.coupling.positions(start[None]), robot.coupling.positions(target[None]), (kind,)
        )
        # The ends are tested first: most moves in contact are so at an end.
        path = move.start + line * (move.target - move.start)
        touches = any(dynamics.in_contact(q, clearance).any() for q in (path[[0, -1]], path))
        if touches or shortest_durations(robot, move)[0] > LONGEST_MOVE:
            in_vain += 1
        else:
            moves.append(move)
            in_vain = 0
    problem = (
        f"{robot.name!r} touches itself or the ground, or is too weak, in nearly every draw of a"
        f" move: {len(moves)} of {count} moves were found"
    )
    remedy = "correct the contacts and limits that batchpid inspect lists"
    raise InvalidArgumentError("robot", problem, remedy=remedy)


def easy_pose(robot: Robot) -> tuple[Float64, NDArray[np.bool_]]:
    """Return the pose about which moves lie if they are hard to find, and the joints that can move
    (dof,).

    It is the start pose if its links are well apart and the effort limits hold it easily. Otherwise
    it is the pose of the least effort whose links are well apart, among seeded poses and others
    between these and the start pose; if none of the first :data:`TRIED_POSES` is, the start pose.
    """

    def shares(qpos: Float64) -> Float64:
        still = np.zeros_like(qpos)
        return np.abs(motion_effort(robot, qpos, still, still)) / robot.design_effort_limit

    dynamics = robot.dynamics()
    poses = robot.sample(200, seed=0)
    # A joint that cannot hold itself nearly anywhere does not move.
    weak = shares(poses) + robot.friction / robot.design_effort_limit >= 1
    movable = weak.mean(0) <= STUCK
    spreads = np.geomspace(1.0, 0.05, 8)[:, None, None]
    near = robot.start + spreads * (poses - robot.start)
    candidates = robot.coupling.positions(np.vstack([robot.start[None], *near]))
    # Contact takes long to compute. A stable order has the start first among the easy poses.
    order = np.argsort(np.maximum(shares(candidates).max(1), EASY), kind="stable")
    for pose in candidates[order[:TRIED_POSES]]:
        if not dynamics.in_contact(pose[None], ROOMY)[0]:
            return pose, movable
    return robot.start, movable


def shortest_durations(robot: Robot, moves: Moves) -> Float64:
    """Return the time of the shortest bang-bang motion along each move (moves,) [s]; inf if gravity
    forbids it.
    """
    time = (np.arange(2 * LINE)[:, None] + 0.5) / (2 * LINE)
    # The second half is the first one backwards in time, with the opposite acceleration.
    left = np.minimum(time, 1 - time)
    is_early = time < 0.5
    position = np.where(
        is_early,
        2 * left**2,
        1 - 2 * left**2,
    )
    acceleration = np.where(is_early, 4.0, -4.0)
    return _durations(robot, moves, position, 4 * left, acceleration)


def smooth_durations(robot: Robot, moves: Moves) -> Float64:
    """Return the time of a minimum-jerk motion along each move that a robot follows with ease
    (moves,) [s].

    No joint is faster than half its velocity limit (FREE_VELOCITY where it has none), and motion
    and friction take at most 0.7 of the effort that gravity leaves. Where gravity leaves none, the
    velocity limits alone count.
    """
    free = np.array([FREE_VELOCITY[unit] for unit in robot.units])
    fastest = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, free)
    unit_time = minimum_jerk([0.0], [1.0], 0.5 / LINE, duration=1.0)
    peak = unit_time.velocity.max()
    by_velocity = peak * np.abs(moves.target - moves.start) / (SMOOTH_VELOCITY * fastest)
    by_effort = _durations(
        robot,
        moves,
        unit_time.position,
        unit_time.velocity,
        unit_time.acceleration,
        SMOOTH_EFFORT,
    )
    slowest: Float64 = np.maximum(
        by_velocity.max(1), np.where(np.isfinite(by_effort), by_effort, 0.0)
    )
    return slowest


def _durations(
    robot: Robot,
    moves: Moves,
    z: Float64,
    rate: Float64,
    acceleration: Float64,
    share: float = 1.0,
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
        # Friction and damping take a share of the effort where it has the direction of the motion.
        along = moving * step > 0
        free = np.where(moving > 0, limit - gravity, limit + gravity)
        room = share * free - along * robot.friction
        # Without room somewhere on the line there is no motion, however slow.
        if (room > 0).all() and (np.abs(gravity) < limit).all():
            # The positive root of room T^2 - drag T - |moving|.
            drag = along * robot.damping * np.abs(rate * step)
            root = np.sqrt(drag**2 + 4 * room * np.abs(moving))
            durations[row] = ((drag + root) / (2 * room)).max()
    return durations


def motion_effort(
    robot: Robot,
    qpos: Float64,
    qvel: Float64,
    qacc: Float64,
) -> Float64:
    """Return the efforts (n, dof) [N m or N] of a motion, gravity included; followers have none,
    their leaders more.
    """
    efforts: Float64 = robot.coupling.efforts(robot.dynamics().inverse_dynamics(qpos, qvel, qacc))
    return efforts


def smooth_effort(
    robot: Robot,
    start: Float64,
    target: Float64,
    duration: float,
) -> Float64:
    """Return the efforts (:data:`SAMPLES`, dof) of the minimum-jerk motion from ``start`` to
    ``target`` in ``duration`` [s]: they overcome the joints' friction and damping.
    """
    unit_time = minimum_jerk(start, target, 1 / SAMPLES, duration=1.0)
    velocity = unit_time.velocity / duration
    acceleration = unit_time.acceleration / duration**2
    dissipation = robot.damping * velocity + robot.friction * np.sign(velocity)
    return motion_effort(robot, unit_time.position, velocity, acceleration) + dissipation


def smooth_variation(robot: Robot, moves: Moves, durations: Float64 | float) -> Float64:
    """Return the total variation of :func:`smooth_effort` on each move (moves, dof) [N m or N].

    ``durations`` [s] are (moves,) or one for all. Less than a thousandth of the joint's effort
    limit counts as that. Followers have the variation of their leaders.
    """
    variation = []
    times = np.broadcast_to(durations, len(moves.start))
    for start, target, duration in zip(moves.start, moves.target, times, strict=True):
        efforts = smooth_effort(robot, start, target, float(duration))
        variation.append(np.abs(np.diff(efforts, axis=0)).sum(0))
    variations: Float64 = robot.coupling.of_leaders(
        np.maximum(variation, 1e-3 * robot.design_effort_limit)
    )
    return variations
