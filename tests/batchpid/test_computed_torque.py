"""Gains per unit of inertia, against the equation, and against a robot made of arrays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from quick_jit import quick_jit

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.law import (
    advance_with_mass_matrix,
    check_gain_units,
    convert_integral,
)

DT = 1e-3


def mass(rng, envs, joints):
    a = rng.normal(size=(envs, joints, joints))
    return a @ a.transpose(0, 2, 1) + 0.1 * np.eye(joints)


def params(joints, **options):
    return bp.make_params(
        joints, 100.0, 50.0, 20.0, anti_windup="conditional", gain_units="mass_matrix", **options
    )


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**31), envs=st.integers(1, 4), joints=st.integers(1, 5), hard=st.booleans()
)
def test_the_effort_is_within_limits_and_keeps_the_direction_of_the_acceleration(
    seed, envs, joints, hard
):
    rng = np.random.default_rng(seed)
    matrix, passive = mass(rng, envs, joints), rng.uniform(-1, 1, (envs, joints))
    limit = rng.uniform(1.1, 5 if hard else 1e5, joints)
    p = params(joints, effort_limit=limit)
    y, r = rng.normal(size=(2, envs, joints))
    k = bp.discretise(p, DT)
    state = bp.init(p, y)
    new, terms = advance_with_mass_matrix(k, state, r, y, matrix, feedforward=passive)
    effort = terms.effort
    free = k._replace(effort_min=None, effort_max=None, gain_units=None)
    acceleration = bp.advance(free, state, r, y)[1].effort
    np.testing.assert_allclose(
        terms.unsaturated, np.einsum("eij,ej->ei", matrix, acceleration) + passive
    )
    np.testing.assert_allclose(terms.p + terms.i + terms.d + terms.feedforward, terms.unsaturated)
    assert (np.abs(effort) <= limit * (1 + 1e-12)).all()
    applied = np.linalg.solve(matrix, (effort - passive)[..., None])[..., 0]
    share = (applied * acceleration).sum(1) / (acceleration**2).sum(1)
    np.testing.assert_allclose(applied, share[:, None] * acceleration, rtol=1e-6, atol=1e-6)
    assert ((share > 0) & (share <= 1 + 1e-9)).all()
    # limited: some joint is at its limit; not limited: the equation itself
    limited = share < 1 - 1e-9
    assert (np.isclose(np.abs(effort), limit).any(1) == limited).all()
    # conditional integration: frozen into the direction of a exactly where limited (here a and e
    # agree from rest)
    frozen = (new.integral == state.integral).all(1)
    assert (frozen == limited).all()


def test_a_joint_overloaded_by_its_passive_force_does_not_stop_the_others():
    p = params(2, effort_limit=[1.0, 10.0])
    state = bp.init(p, np.zeros((1, 2)))
    _, terms = advance_with_mass_matrix(
        bp.discretise(p, DT),
        state,
        np.full((1, 2), 0.01),
        np.zeros((1, 2)),
        np.eye(2)[None],
        feedforward=np.array([[3.0, 0.0]]),
    )
    assert terms.effort[0, 0] == 1.0
    assert terms.effort[0, 1] == pytest.approx(1.0)


def test_every_joint_of_a_coupled_robot_responds_alike_and_on_a_straight_line():
    """M q'' = u on arrays: with tight limits too, q(t) = q0 + z(t) (r - q0) for one z."""
    rng = np.random.default_rng(3)
    joints, envs = 4, 3
    matrix = mass(rng, envs, joints)
    inverse = np.linalg.inv(matrix)
    for limit in (None, 5.0):
        p = params(joints, effort_limit=limit, setpoint_weight=0.2)
        k = bp.discretise(p, DT)
        start, goal = rng.normal(size=(2, envs, joints))
        q, v = start.copy(), np.zeros_like(start)
        state = bp.init(p, q)
        saturated = False
        for _ in range(400):
            state, terms = advance_with_mass_matrix(k, state, goal, q, matrix)
            saturated |= bool(terms.filled().saturated.any())
            v = v + DT * np.einsum("eij,ej->ei", inverse, terms.effort)
            q = q + DT * v
            progress = (q - start) / (goal - start)
            np.testing.assert_allclose(
                progress, np.broadcast_to(progress[:, :1], progress.shape), atol=1e-7
            )
        assert saturated == (limit is not None)
        assert (progress > 0.02).all()


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**31),
    envs=st.integers(1, 4),
    joints=st.integers(1, 5),
    limited=st.booleans(),
)
def test_a_rate_limit_keeps_the_direction_of_the_change_of_the_effort(seed, envs, joints, limited):
    rng = np.random.default_rng(seed)
    matrix, rate = mass(rng, envs, joints), rng.uniform(100, 1e5, joints)
    own = {"effort_limit": rng.uniform(1, 50, joints)} if limited else {}
    p = params(joints, effort_rate_limit=rate, **own)
    y, r, passive = rng.normal(size=(3, envs, joints))
    k, state = bp.discretise(p, DT), bp.init(p, y)
    for _ in range(3):
        free = advance_with_mass_matrix(
            k._replace(effort_step=None), state, r, y, matrix, feedforward=passive
        )[1]
        new, terms = advance_with_mass_matrix(k, state, r, y, matrix, feedforward=passive)
        wanted, change = free.effort - state.effort, terms.effort - state.effort
        assert (np.abs(change) <= rate * DT * (1 + 1e-12) + 1e-12).all()
        assert not limited or (np.abs(terms.effort) <= own["effort_limit"]).all()
        part = np.where(
            (wanted == 0).all(1),
            1.0,
            (change * wanted).sum(1) / np.maximum((wanted**2).sum(1), 1e-300),
        )
        np.testing.assert_allclose(change, part[:, None] * wanted, rtol=1e-9, atol=1e-9)
        late = part < 1 - 1e-9
        assert (np.isclose(np.abs(change), rate * DT).any(1) == late).all()
        np.testing.assert_array_equal(new.effort, terms.effort)
        assert (terms.filled().saturated.any(1) >= late).all()
        # The integral stops where it would move the effort further from what the rate allows, and
        # nowhere else.
        if not limited:
            stopped = (terms.unsaturated - terms.effort) * k.ki_dt * (r - y) > 0
            np.testing.assert_array_equal(new.integral == state.integral, stopped)
        state = new


def test_with_a_unit_mass_matrix_a_joint_alone_has_the_law_in_efforts():
    options = {"effort_limit": 40.0, "effort_rate_limit": 900.0, "anti_windup": "conditional"}
    p = bp.make_params(1, 400.0, 300.0, 40.0, **options)
    k, q, v = bp.discretise(p, DT), np.zeros((1, 1)), np.zeros((1, 1))
    here = there = bp.init(p, q)
    for _ in range(500):
        here, terms = bp.advance(k, here, np.ones((1, 1)), q)
        there, whole = advance_with_mass_matrix(k, there, np.ones((1, 1)), q, np.ones((1, 1, 1)))
        np.testing.assert_allclose(whole.effort, terms.effort, rtol=1e-9, atol=1e-9)
        v = v + DT * terms.effort
        q = q + DT * v
    assert abs(q[0, 0] - 1) < 0.2


def test_jax_and_numpy_agree():
    rng = np.random.default_rng(0)
    p = params(3, effort_limit=4.0, effort_rate_limit=900.0)
    p = p._replace(
        **{n: v.astype(np.float32) for n, v in p._asdict().items() if isinstance(v, np.ndarray)}
    )
    y, r = rng.normal(size=(2, 2, 3)).astype(np.float32)
    matrix = mass(rng, 2, 3).astype(np.float32)
    on_numpy = advance_with_mass_matrix(bp.discretise(p, DT), bp.init(p, y), r, y, matrix)
    arrays = bp.init(p, y), r, y, matrix
    on_jax = quick_jit(lambda *given: advance_with_mass_matrix(bp.discretise(p, DT), *given))(
        *arrays
    )
    np.testing.assert_allclose(on_numpy[1].effort, on_jax[1].effort, rtol=1e-5, atol=1e-5)


def test_options_without_meaning_for_accelerations_are_refused():
    for options in (
        {"anti_windup": "back_calculation", "effort_limit": 1.0},
        {"non_finite": "hold"},
    ):
        with pytest.raises(InvalidArgumentError, match="mass_matrix"):
            check_gain_units(bp.make_params(1, 1.0, 1.0, 1.0, gain_units="mass_matrix", **options))
        check_gain_units(bp.make_params(1, 1.0, 1.0, 1.0, **options))


def test_a_change_of_gain_units_keeps_the_effort_of_the_integral():
    """Both ways, in the middle of a run; a change that keeps the integral's unit keeps the
    state.
    """
    rng = np.random.default_rng(5)
    matrix, y = mass(rng, 3, 4), rng.normal(size=(3, 4))
    whole, other = params(4), params(4).replace(gain_units="effort")
    state = bp.init(other, y)._replace(integral=rng.normal(size=(3, 4)))
    there = convert_integral(state, other, whole, matrix)
    _, terms = advance_with_mass_matrix(bp.discretise(whole, DT), there, y, y, matrix)
    np.testing.assert_allclose(terms.i, state.integral)
    back = convert_integral(there, whole, other, matrix)
    np.testing.assert_allclose(back.integral, state.integral)
    assert convert_integral(state, other, params(4).replace(gain_units="effort"), matrix) is state
    assert convert_integral(bp.PIDState(), other, whole, matrix) == bp.PIDState()


def test_a_converted_integral_is_within_its_limits():
    limited = params(1, integral_limit=2.0)
    state = convert_integral(
        bp.PIDState(np.full((1, 1), 6.0)),
        params(1).replace(gain_units="effort"),
        limited,
        2.0 * np.ones((1, 1, 1)),
    )
    assert state.integral.tolist() == [[2.0]]
