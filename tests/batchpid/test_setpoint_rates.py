"""Setpoints whose rate is given: followed with full weight, without a bump."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import batchpid as bp

DT = 1 / 2000
IMPLICIT = {"gain_units": "mass_matrix", "discretization": "implicit"}
GAINS = {"kp": 170.0, "ki": 500.0, "kd": 26.0}
WEIGHTS = st.floats(0.0, 1.0)


def follow(b, rates=True, steps=2000, **options):
    """Return the errors (steps, envs) of joints of inertia 1 on the way of a sine, with setpoint
    weights b (envs,).
    """
    params = bp.make_params(1, **GAINS, setpoint_weight=np.array(b)[:, None], **options)
    late = params.discretization is not None
    k = bp.discretise(params, DT)._replace(gain_units=None)
    y, v, errors = np.zeros((len(b), 1)), np.zeros((len(b), 1)), []
    state = bp.init(params, y)
    for step in range(steps):
        t = DT * (step + late)
        r, rate = np.full_like(y, 0.3 * (1 - np.cos(3 * t))), np.full_like(y, 0.9 * np.sin(3 * t))
        state, terms = bp.advance(k, state, r, y, v, rate if rates else None)
        v = v + DT * terms.effort
        y = y + DT * v
        errors.append(0.3 * (1 - np.cos(3 * DT * (step + 1))) - y[:, 0])
    return np.array(errors)


@pytest.mark.parametrize("options", [{}, IMPLICIT])
def test_the_following_error_does_not_depend_on_the_setpoint_weight(options):
    errors = follow([1.0, 0.0, 0.1, 0.3, 0.7, 0.95], **options)
    most = np.abs(errors[:, 0]).max()
    assert most > 5e-3  # the acceleration is not given
    assert np.abs(errors - errors[:, :1]).max() < 0.02 * most
    assert np.abs(follow([0.1], rates=False, **options)).max() > 10 * most


@settings(max_examples=25)
@given(b=WEIGHTS, seed=st.integers(0, 999), implicit=st.booleans(), turns=st.booleans())
def test_to_begin_and_to_end_with_rates_makes_no_bump(b, seed, implicit, turns):
    """P and I go on from step to step; a rate of 0 is no rate."""
    options = IMPLICIT if implicit else {}
    params = bp.make_params(3, **GAINS, setpoint_weight=b, continuous=turns, **options)
    k, rng = bp.discretise(params, DT)._replace(gain_units=None), np.random.default_rng(seed)
    y, r, rate = rng.normal(size=(3, 2, 3))
    state, _ = bp.advance(k, bp.init(params, y), r, y, setpoint_rate=rate)
    (with_rate, given), (without, none) = (
        bp.advance(k, state, r, y, setpoint_rate=x) for x in (0 * rate, None)
    )
    for one, other in zip((*with_rate, *given), (*without, *none), strict=True):
        np.testing.assert_array_equal(one, other)
    _, rated = bp.advance(k, state, r, y, setpoint_rate=rate)
    moved = (1 - b) * np.asarray(k.kp) * DT * np.abs(rate) if implicit else 0.0
    assert (np.abs(rated.p - none.p) <= 1.001 * moved + 1e-12 * np.abs(none.p)).all()
    np.testing.assert_array_equal(rated.i, none.i)
