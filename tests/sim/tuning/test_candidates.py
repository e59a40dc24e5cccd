"""Candidates of searches: first ones, by their poles, phase margin and delay."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from batchpid import make_actuators
from batchpid.sim import Randomization, Uniform
from batchpid.sim.tuning import Weights, random_moves
from batchpid.sim.tuning.candidates import (
    FASTEST,
    PHASE_MARGIN,
    Candidates,
    first_gains,
    gains_of_poles,
    loop_delay,
    phase_margin,
)

SPEED = st.floats(0.5, 50.0)
DELAY = st.floats(0.0, 0.2)


@given(SPEED, SPEED)
def test_gains_have_the_poles(p, w):
    ki, kp, kd = gains_of_poles(p, w)
    s = np.array([-p, -w])
    np.testing.assert_allclose(s**3 + kd * s**2 + kp * s + ki, 0, atol=1e-9 * max(p, w) ** 3)


@settings(max_examples=20)
@given(SPEED, SPEED, DELAY)
def test_phase_margin_is_that_of_the_frequency_response(p, w, delay):
    ki, kp, kd = gains = gains_of_poles(p, w)
    frequency = np.geomspace(1e-2, 1e4, 20_001)
    s = 1j * frequency
    loop = (kd * s**2 + kp * s + ki) / s**3
    crossover = np.argmin(np.abs(np.log(np.abs(loop))))
    expected = np.pi + np.unwrap(np.angle(loop))[crossover] - frequency[crossover] * delay
    assert abs((phase_margin(gains, delay) - expected + np.pi) % (2 * np.pi) - np.pi) < 1e-3 * (
        1 + frequency[crossover] * delay
    )


@settings(max_examples=8)
@given(DELAY)
def test_first_candidates_have_the_phase_margin_and_real_poles(delay):
    for gains in first_gains(delay):
        ki, kp, kd = gains
        assert phase_margin(gains, delay) >= PHASE_MARGIN - 1e-6
        poles = np.roots([1, kd, kp, ki])
        assert (poles.real < 0).all()
        assert np.abs(poles).max() <= (FASTEST + 1e-3) * np.abs(poles).min()


def test_candidates_are_slower_the_later_the_motors(panda):
    fastest = [max(gains[0] for gains in first_gains(delay)) for delay in (0.0, 0.01, 0.03, 0.1)]
    assert sorted(fastest, reverse=True) == fastest
    assert fastest[-1] < 0.01 * fastest[0]


def test_points_stand_for_their_gains_per_mass_matrix(panda):
    options = {"headroom": 1.0, "varied": False}
    search = Candidates(
        panda, "mass_matrix", False, random_moves(panda, 1, 0), 0.2, Weights(), **options
    )
    gains = first_gains(0.005)
    params = search.params(search.points(gains))
    for leaf, expected in zip((params.ki, params.kp, params.kd), np.array(gains).T, strict=True):
        np.testing.assert_allclose(leaf, np.repeat(expected[:, None], panda.dof, 1), rtol=1e-9)


def test_delay_of_the_loop_is_that_of_the_latest_joint_and_draw(panda):
    delays = np.linspace(0.001, 0.004, panda.dof)
    late = dataclasses.replace(
        panda, actuators=make_actuators(panda.dof, command_delay=delays, lag=0.01)
    )
    drawn = Randomization(actuators={"sensor_delay": Uniform(0.02, 0.02 + 1e-9)})
    assert loop_delay(panda, None, 0.002) == 0.002
    assert loop_delay(late, None, 0.002) == pytest.approx(0.016)
    assert loop_delay(late, drawn, 0.002) == pytest.approx(0.036)
    assert loop_delay(panda, drawn, 0.0) == pytest.approx(0.02)
