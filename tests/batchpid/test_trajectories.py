"""Point-to-point moves begin and end at rest at the given positions, and keep their limits."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from batchpid.trajectories import minimum_jerk

DT = 0.004
LIMITS = {"max_velocity": [1.0, 2.0, np.inf], "max_acceleration": [3.0, 8.0, 5.0]}
poses = st.lists(st.lists(st.floats(-3, 3), min_size=3, max_size=3), min_size=1, max_size=4).map(
    np.array
)
MOVES = {
    "limited": lambda a, b: minimum_jerk(a, b, DT, **LIMITS),
    "timed": lambda a, b: minimum_jerk(a, b, DT, duration=0.77),
}


each_move = pytest.mark.parametrize("move", MOVES.values(), ids=MOVES)


def with_start(trajectory, start):
    return np.concatenate(
        [np.broadcast_to(start, trajectory.position.shape[1:])[None], trajectory.position]
    )


@each_move
@settings(deadline=None, max_examples=15)
@given(start=poses, target=st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array))
@example(start=np.array([[0.0, 0.7, 0.0]]), target=np.array([0.0, -3.0, 0.0]))  # ends by rounding
def test_a_move_ends_at_its_target_at_rest_and_stays_between(move, start, target):
    t = move(start, target)
    assert t.position.shape == (t.ticks, *start.shape)
    np.testing.assert_allclose(
        t.position[-1], np.broadcast_to(target, start.shape), rtol=0, atol=1e-12
    )
    assert not t.velocity[-1].any()
    assert not t.acceleration[-1].any()
    low, high = np.minimum(start, target) - 1e-12, np.maximum(start, target) + 1e-12
    assert ((t.position >= low) & (t.position <= high)).all()
    np.testing.assert_allclose(t.time, DT * np.arange(1, t.ticks + 1))


@each_move
@settings(deadline=None, max_examples=15)
@given(start=poses, target=st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array))
def test_positions_are_the_integral_of_velocities(move, start, target):
    t = move(start, target)
    position = with_start(t, start)
    velocity = np.concatenate([np.zeros_like(t.velocity[:1]), t.velocity])
    trapezium = DT * (velocity[1:] + velocity[:-1]) / 2
    np.testing.assert_allclose(np.diff(position, axis=0), trapezium, rtol=0, atol=DT**2 * 20)


@settings(deadline=None, max_examples=15)
@given(start=poses, target=poses)
def test_limits_are_kept_at_every_tick(start, target):
    t = MOVES["limited"](start, target[0])
    assert (np.abs(t.velocity) <= np.array(LIMITS["max_velocity"]) * (1 + 1e-9)).all()
    assert (np.abs(t.acceleration) <= np.array(LIMITS["max_acceleration"]) * (1 + 1e-9)).all()


@settings(deadline=None, max_examples=15)
@given(start=poses, target=poses)
def test_synchronised_joints_move_on_a_straight_line(start, target):
    t = MOVES["limited"](start, target[0])
    way = target[0] - start
    done = np.divide(
        t.position - start, way, out=np.full_like(t.position, np.nan), where=np.abs(way) > 1e-3
    )
    spread = np.nanmax(np.nan_to_num(done, nan=-1), -1) - np.nanmin(
        np.where(np.isnan(done), 2, done), -1
    )
    assert (spread < 1e-9).all()


def test_minimum_jerk_is_symmetric_and_peaks_at_fifteen_eighths():
    t = minimum_jerk([0.0], [1.0], 0.001, duration=1.0)
    np.testing.assert_allclose(t.position[498, 0] + t.position[500, 0], 1.0, atol=1e-12)
    np.testing.assert_allclose(t.velocity.max(), 15 / 8)
    np.testing.assert_allclose(t.acceleration.max(), 10 / np.sqrt(3), rtol=1e-5)


def test_an_env_moves_alone_as_it_does_among_others():
    rng = np.random.default_rng(0)
    start, target = rng.normal(size=(2, 5, 3))
    both = MOVES["limited"](start, target)
    alone = MOVES["limited"](start[3], target[3])
    np.testing.assert_array_equal(both.position[: alone.ticks, 3], alone.position)
    np.testing.assert_array_equal(
        both.position[alone.ticks :, 3], np.broadcast_to(target[3], (both.ticks - alone.ticks, 3))
    )


@each_move
def test_a_move_of_no_distance_rests(move):
    t = move(np.ones((2, 3)), np.ones(3))
    if t.ticks > 1:  # a duration was asked for
        assert np.isclose(t.time[-1], 0.77, atol=DT)
    assert (t.position == 1).all()
    assert not t.velocity.any()


def test_the_end_of_a_trajectory_can_be_held():
    t = minimum_jerk([0.0, 0.0], [1.0, 2.0], DT, duration=0.1, hold=0.02)
    assert t.ticks == 25 + 5
    np.testing.assert_allclose(t.time, DT * np.arange(1, 31))
    assert (t.position[25:] == [1.0, 2.0]).all()
    assert not t.velocity[25:].any()
