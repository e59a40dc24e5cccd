"""The guard of setpoints: within its limits, without overshoot, in the shortest time; allowed
setpoints pass unchanged.
"""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from law_cases import read_only

import batchpid as bp
from batchpid.motors import guard

DT = 0.01


def run(limits, setpoints, start=0.0):
    """Return guarded setpoints, their rates and the mask of changed ones (steps, 1, joints)."""
    rows = np.asarray(setpoints, float).reshape(len(setpoints), 1, -1)
    state, seen = guard.init(limits, np.zeros_like(rows[0]) + start), []
    for row in rows:
        state, changed = guard.advance(limits, state, read_only(row, float), DT)
        seen.append((state.setpoint, state.rate, changed))
    return tuple(map(np.array, zip(*seen, strict=True)))


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_limits_hold_whatever_is_asked(seed):
    rng = np.random.default_rng(seed)
    lower, upper, rate, acceleration = (
        -rng.uniform(0.1, 3, 4),
        rng.uniform(0.1, 3, 4),
        *rng.uniform(0.1, 20, (2, 4)),
    )
    limits = bp.make_guard(4, lower=lower, upper=upper, rate=rate, acceleration=acceleration)
    asked = np.repeat(rng.normal(0, 3, (30, 4)), rng.integers(1, 30, 30), axis=0)
    setpoint, speed, changed = run(limits, asked)
    assert (setpoint >= lower - 1e-9).all()
    assert (setpoint <= upper + 1e-9).all()
    assert (np.abs(speed) <= rate * (1 + 1e-9)).all()
    assert (np.abs(np.diff(speed, axis=0, prepend=0.0)) <= DT * acceleration * (1 + 1e-9)).all()
    np.testing.assert_allclose(np.diff(setpoint, axis=0, prepend=0.0), DT * speed, atol=1e-12)
    np.testing.assert_array_equal(changed, setpoint != asked[:, None])


@given(target=st.floats(-5, 5), rate=st.floats(0.5, 5), acceleration=st.floats(1, 50))
@settings(max_examples=25)
def test_a_constant_setpoint_is_reached_without_overshoot_in_the_shortest_time(
    target, rate, acceleration
):
    """Within three steps of the trapezoid of rates, or of the triangle that does not reach the
    largest rate.
    """
    way, ramp = abs(target), rate**2 / acceleration
    shortest = way / rate + rate / acceleration if way > ramp else 2 * np.sqrt(way / acceleration)
    steps = int(shortest / DT) + 10
    setpoint, _, changed = run(
        bp.make_guard(1, rate=rate, acceleration=acceleration), np.full(steps, target)
    )
    assert not changed[-1]
    arrival = DT * (np.flatnonzero(changed).max(initial=-1) + 2)
    assert arrival <= shortest + 3 * DT + 1e-9
    assert (np.abs(setpoint) <= way + 1e-12).all()
    assert setpoint[-1] == target


@given(
    seed=st.integers(0, 2**32 - 1),
    share=st.floats(0.05, 0.95),
    late=st.booleans(),
)
@settings(max_examples=25)
def test_a_setpoint_within_the_limits_passes_unchanged_once_it_has_been_reached(seed, share, late):
    """From the first step, or after a jump ``late`` in half of the acceleration's limit."""
    rng = np.random.default_rng(seed)
    joints, steps = 4, 600
    speed, acceleration = rng.uniform(0.2, 2, joints), rng.uniform(1, 30, joints)
    if late:
        share = share / 2
    # The rate of a sine is a sine within speed, its acceleration within its share of the limit.
    frequency = share * acceleration / speed
    time = DT * np.arange(steps)[:, None]
    path = speed / frequency * (1 - np.cos(frequency * time))
    highest = 2 * speed / frequency
    jump = np.where(time >= 1.0, late * rng.uniform(-0.2, 0.2, joints), 0.0)
    limits = bp.make_guard(
        joints, lower=-0.3, upper=highest + 0.3, rate=1.5 * speed + 0.2, acceleration=acceleration
    )
    asked = path + jump
    setpoint, _, changed = run(limits, asked)
    error = np.abs(setpoint[:, 0] - asked)
    np.testing.assert_array_equal(changed[:, 0], error > 0)
    assert error[:100].max() <= 1e-9
    for joint in range(joints):
        missed = np.flatnonzero(error[:, joint] > 1e-9)
        assert missed.max(initial=0) < steps - 1
        # Two steps have the setpoint's position and rate: it is not missed again behind them.
        assert (np.diff(missed) <= 2).all()
