r"""Moves to judge gains by: seeded, free of contact, with the fastest that the effort limits allow.

A move is a step of the setpoint from rest at ``start`` to ``target``. The straight line between them, which good gains
follow, is tested for contact, and so is what lies beyond it by as much as a good move may overshoot. On that line
q(z) = start + z (target - start) all joints move in step, so that the effort of a motion z(t) in time T is
gravity(q) + h / T^2, with h from the inverse dynamics of the same motion in unit time. The shortest bang-bang motion,
accelerating up to half the way and braking from there, has in closed form::

    T^2 = max over joints and line of |h_j| / (limit_j -+ gravity_j)

It is a motion that exists, hence no faster than the fastest of all.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import InvalidArgumentError
from batchpid.validate import integer, number
from sim.robot.robot import Robot

Float64 = NDArray[np.float64]
KINDS = ("large", "small", "one joint", "all alike")
"""Kinds of random moves, in turn: up to ``size``; up to a tenth of it; of one joint; of all joints by one fraction."""
OVERSHOOT = 0.05
"""Overshoot of a good move at most, as a fraction of it."""
_LINE = 24
_EDGE = 0.02
_NEARBY = 0.3


class Moves(NamedTuple):
    """Steps from rest: start and target (moves, dof) [rad or m], and what each is."""

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
        """Those of ``rows``."""
        rows = list(rows)
        return Moves(self.start[rows], self.target[rows], tuple(self.names[row] for row in rows))


def tutorial_move(robot: Robot, nearby: int = 0, seed: int = 0) -> Moves:
    """The move of a bundled robot's settings; none for other robots.

    And ``nearby`` more, the hardest for its effort limits of 64 seeded ones that start within 0.3 rad [or m].
    """
    if robot.settings is None:
        return Moves(np.empty((0, robot.dof)), np.empty((0, robot.dof)), ())
    start, target = robot.settings.start, robot.settings.target
    spread = np.minimum(_NEARBY, (robot.upper - robot.lower) / 4)
    move = Moves(start[None], target[None], ("tutorial",))
    if nearby == 0:
        return move
    shift = np.random.default_rng(seed).uniform(-spread, spread, (64, robot.dof))
    starts = np.clip(start + shift, robot.lower, robot.upper)
    others = Moves(starts, np.tile(target, (64, 1)), ("near the tutorial's",) * 64)
    return move + others.take(np.argsort(fastest(robot, others))[::-1][:nearby])


def search_moves(robot: Robot, seed: int = 0) -> Moves:
    """The moves that gains are searched on.

    The tutorial's, where there is one, with one that starts near it, a random move of each kind, and the one of 28 more
    that needs most time under the effort limits: the fastest gains are those that just do not saturate on the hardest.
    """
    drawn = random_moves(robot, 32, seed)
    easy, others = drawn.take(range(len(KINDS))), drawn.take(range(len(KINDS), 32))
    duration = fastest(robot, others)
    hardest = int(np.argmax(np.where(np.isfinite(duration), duration, -1.0)))
    return tutorial_move(robot, 1, seed) + easy + others.take([hardest])


def random_moves(robot: Robot, count: int, seed: int = 0, size: float = 2.0, ground: bool = True) -> Moves:
    """``count`` seeded moves within the joint limits, free of contact on the straight line and 5 % beyond it.

    Starts are uniform over :meth:`Robot.sample`, 2 % off the limits; targets within ``size`` [rad, or m but at most the
    whole range] of them, by the :data:`KINDS` in turn. ``ground`` says whether there is one at height 0.

    Raises
    ------
    InvalidArgumentError
        ``count`` or ``size`` out of range, or the robot touches itself in nearly every pose.
    """
    count, size = integer("count", count, 0, 100_000), number("size", size, 1e-3, 10.0, "rad or m")
    probe, rng = robot.dynamics(ground), np.random.default_rng(seed)
    reach = np.ptp(robot.sample(1000, seed=0), axis=0)
    low = np.maximum(robot.lower + _EDGE * reach, -np.inf)
    high = np.minimum(robot.upper - _EDGE * reach, np.inf)
    starts: list[Float64] = []
    targets: list[Float64] = []
    names: list[str] = []
    line = np.linspace(0, 1 + OVERSHOOT, _LINE)[:, None]
    for _ in range(200 * count + 200):
        if len(starts) == count:
            break
        kind = KINDS[len(starts) % len(KINDS)]
        start = np.clip(robot.sample(1, seed=int(rng.integers(2**31)))[0], low, high)
        joint, fraction = rng.integers(robot.dof), rng.uniform(-1, 1, robot.dof)
        if kind == "all alike":
            fraction[:] = fraction[0]
        if kind == "one joint":
            fraction[np.arange(robot.dof) != joint] = 0.0
        step = fraction * np.minimum(size, reach) * (0.1 if kind == "small" else 1.0)
        target = np.clip(start + step, low, high)
        start, target = _with_mimics(robot, start), _with_mimics(robot, target)
        if not probe.touches(start + line * (target - start)).any():
            starts.append(start)
            targets.append(target)
            names.append(kind if kind != "one joint" else f"{robot.joint_names[joint]} alone")
    if len(starts) < count:
        raise InvalidArgumentError(
            "robot",
            f"{robot.name!r} touches itself or the ground on nearly every move: {len(starts)} of {count} were free",
            remedy="give the moves yourself, or correct the collision shapes (batchpid inspect shows them)",
        )
    return Moves(np.array(starts).reshape(-1, robot.dof), np.array(targets).reshape(-1, robot.dof), tuple(names))


def fastest(robot: Robot, moves: Moves) -> Float64:
    """Duration of the shortest bang-bang motion on each move's straight line (moves,) [s]; inf if none can be held."""
    t = (np.arange(2 * _LINE) + 0.5) / (2 * _LINE)
    early = t < 0.5
    z = np.where(early, 2 * t**2, 1 - 2 * (1 - t) ** 2)
    rate, acceleration = np.where(early, 4 * t, 4 * (1 - t)), np.where(early, 4.0, -4.0)
    return np.array(
        [_duration(robot, *move, z, rate, acceleration) for move in zip(moves.start, moves.target, strict=True)]
    )


def smooth_effort(robot: Robot, start: Float64, target: Float64, duration: float, samples: int = 200) -> Float64:
    """Efforts (samples, dof) of the minimum-jerk motion from ``start`` to ``target`` (dof,) in ``duration`` [s].

    T. Flash and N. Hogan, "The coordination of arm movements", J. Neuroscience 5 (1985).
    """
    t = np.linspace(0, 1, samples)[:, None]
    step = target - start
    qpos = start + step * (10 * t**3 - 15 * t**4 + 6 * t**5)
    qvel = step * (30 * t**2 - 60 * t**3 + 30 * t**4) / duration
    qacc = step * (60 * t - 180 * t**2 + 120 * t**3) / duration**2
    return robot.dynamics().inverse_dynamics(qpos, qvel, qacc)


def _with_mimics(robot: Robot, qpos: Float64) -> Float64:
    """Return ``qpos`` (dof,) with the joints that mimic others where those put them."""
    coupled = qpos.copy()
    for index, joint in enumerate(robot.joints):
        if joint.mimic is not None and joint.mimic.joint in robot.joint_names:
            source = qpos[robot.joint_names.index(joint.mimic.joint)]
            coupled[index] = joint.mimic.multiplier * source + joint.mimic.offset
    return coupled


def _duration(robot: Robot, start: Float64, target: Float64, z: Float64, rate: Float64, acceleration: Float64) -> float:
    probe, step = robot.dynamics(), target - start
    qpos = start + z[:, None] * step
    still = np.zeros_like(qpos)
    gravity = probe.inverse_dynamics(qpos, still, still)
    moving = probe.inverse_dynamics(qpos, rate[:, None] * step, acceleration[:, None] * step) - gravity
    room = np.where(moving > 0, robot.effort_limit - gravity, robot.effort_limit + gravity)
    if (room <= 0).any():
        return float("inf")
    return float(np.sqrt((np.abs(moving) / room).max()))
