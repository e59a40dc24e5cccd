"""Moves to evaluate gains on, their shortest durations and their smooth efforts."""

import numpy as np
import pytest

from batchpid.sim.tuning.moves import (
    Moves,
    random_moves,
    shortest_durations,
    smooth_durations,
    smooth_effort,
    smooth_variation,
)
from batchpid.trajectories import minimum_jerk


def test_random_moves_are_seeded_within_limits_and_free_of_contact(panda):
    moves, again, other = (
        random_moves(panda, 8, 3),
        random_moves(panda, 8, 3),
        random_moves(panda, 8, 4),
    )
    np.testing.assert_array_equal(moves.start, again.start)
    np.testing.assert_array_equal(moves.target, again.target)
    assert (moves.start != other.start).any()
    for poses in (moves.start, moves.target):
        assert ((poses >= panda.lower) & (poses <= panda.upper)).all()
    for start, target in zip(moves.start, moves.target, strict=True):
        line = start + np.linspace(0, 1.05, 50)[:, None] * (target - start)
        assert not panda.dynamics().in_contact(line).any()
    assert sum("alone" in name for name in moves.names) == 2
    np.testing.assert_array_equal(random_moves(panda, 3, 3).start, moves.start[:3])


def test_shortest_duration_is_the_double_integrators_bang_bang_for_a_lone_joint(panda):
    """T = 2 sqrt(A I / limit) where gravity and coupling play no part: the last joint of the arm,
    alone.
    """
    start = panda.start
    target = start.copy()
    target[6] += 1.0
    inertia = panda.mass_matrix(start)[0, 6, 6]
    gravity = panda.dynamics().inverse_dynamics(start[None], 0 * start[None], 0 * start[None])[0]
    limit = 12.0 - abs(gravity[6])
    expected = 2 * np.sqrt(inertia / limit)
    # the others must hold against it, with room to spare
    assert shortest_durations(panda, Moves(start[None], target[None], ("",)))[0] == pytest.approx(
        expected, rel=0.05
    )


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_smooth_motions_take_half_of_the_velocity_limits_and_leave_a_reserve_of_effort(
    name, request
):
    robot = request.getfixturevalue(name)
    moves = random_moves(robot, 4, 3)
    durations = smooth_durations(robot, moves)
    assert (durations > shortest_durations(robot, moves)).all()
    for start, target, duration in zip(moves.start, moves.target, durations, strict=True):
        peak = np.abs(minimum_jerk(start, target, duration / 500, duration=duration).velocity).max(
            0
        )
        velocity = (peak / robot.velocity_limit).max()
        effort, still = (
            smooth_effort(robot, start, target, each) for each in (duration, 1e3 * duration)
        )
        shares = (np.abs(effort) - np.abs(still)) / (robot.design_effort_limit - np.abs(still))
        assert velocity <= 0.5 + 1e-6
        assert shares.max() <= 0.71
        assert velocity > 0.499 or shares.max() > 0.6


def test_smooth_effort_is_gravity_at_the_end(panda):
    target = panda.target[None]
    efforts = smooth_effort(panda, panda.start, target[0], 1.0)
    still = np.zeros_like(target)
    gravity = panda.dynamics().inverse_dynamics(target, still, still)[0]
    np.testing.assert_allclose(efforts[-1], gravity, atol=1e-9)


def test_smooth_variation_of_a_joint_at_rest_is_a_thousandth_of_its_limit(panda):
    rest = np.array([panda.start])
    variation = smooth_variation(panda, Moves(rest, rest, ("rest",)), 1.0)
    np.testing.assert_array_equal(variation, 1e-3 * panda.effort_limit[None])
