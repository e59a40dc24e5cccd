"""The implicit law: against its equation solved numerically, its poles, and its stability at any
time step.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import batchpid as bp
from batchpid import spectral_radius
from batchpid.errors import InvalidArgumentError
from batchpid.export import to_ros2_control
from batchpid.law import advance_with_mass_matrix, as_explicit

IMPLICIT = {"gain_units": "mass_matrix", "discretization": "implicit"}
gain = st.floats(0.01, 1e4)


def solved(f):
    """Return the root of a linear function."""
    return -f(0.0) / (f(1.0) - f(0.0))


@settings(max_examples=25)
@given(
    gains=st.tuples(gain, st.none() | gain, st.none() | gain),
    dt=st.floats(1e-4, 0.1),
    b=st.none() | st.floats(0, 1),
    c=st.none() | st.floats(0.01, 1),
    measures=st.booleans(),
    rated=st.booleans(),
    accelerated=st.booleans(),
    seed=st.integers(0, 999),
)
def test_it_solves_the_law_at_the_end_of_the_step(
    gains, dt, b, c, measures, rated, accelerated, seed
):
    p = bp.make_params(1, *gains, setpoint_weight=b, setpoint_weight_derivative=c, **IMPLICIT)
    p_, i_, d_ = (0.0 if x is None else x for x in gains)
    b_, on_rate = 1.0 if b is None else b, (1.0 if rated else 0.0) if c is None else c
    rng = np.random.default_rng(seed)
    setpoints, rates, accelerations = rng.normal(size=(3, 8))
    y, v, integral, last, origin = 0.3, 0.0, 0.0, None, 0.3
    state = bp.init(p, np.array([[y]]))
    for r, slope, more in zip(setpoints, rates, accelerations * accelerated, strict=True):
        origin += dt * slope if rated else 0.0
        rate = slope if rated else 0.0 if last is None else (r - last) / dt
        last = r
        integral += i_ * dt * (r - (dt * slope if rated else 0.0) - y)

        def excess(a, r=r, rate=rate, y=y, v=v, integral=integral, origin=origin, more=more):
            v_end = v + dt * a
            y_end = y + dt * v_end
            i_end = integral + i_ * dt * (r - y_end)
            weighted = b_ * (r - y_end) - (1 - b_) * (y_end - origin)
            return p_ * weighted + d_ * (on_rate * rate - v_end) + i_end + more - a

        expected = solved(excess)
        known = {"measurement_rate": np.array([[v]])} if measures else {}
        known |= {"setpoint_rate": np.array([[slope]])} if rated else {}
        known |= {"setpoint_acceleration": np.array([[more]])} if accelerated else {}
        k = bp.discretise(p, dt)
        state, terms = advance_with_mass_matrix(
            k, state, np.array([[r]]), np.array([[y]]), np.ones((1, 1, 1)), **known
        )
        a = terms.effort
        scale = (
            abs(expected)
            + (abs(r) + abs(y) + dt * abs(v)) * (p_ + i_ * dt)
            + (abs(rate) + abs(v)) * d_
        )
        assert abs(a.item() - expected) <= 1e-7 * (scale + abs(integral) + 1)
        v += dt * a.item()
        y += dt * v


@settings(max_examples=25)
@given(kp=gain, ki=gain, kd=gain, dt=st.floats(1e-4, 1.0))
def test_each_continuous_pole_s_becomes_1_over_1_minus_s_dt(kp, ki, kd, dt):
    p = bp.make_params(1, kp, ki, kd, measurement_rate="measured", **IMPLICIT)
    columns = []
    for y, v, i in np.eye(3):
        state = bp.init(p, np.zeros((1, 1)))._replace(integral=np.array([[i]]))
        new, terms = bp.advance(
            bp.discretise(p, dt)._replace(gain_units=None),
            state,
            np.zeros((1, 1)),
            np.array([[y]]),
            measurement_rate=np.array([[v]]),
        )
        speed = v + dt * terms.effort.item()
        columns.append([y + dt * speed, speed, new.integral.item()])
    found = np.poly(np.linalg.eigvals(np.array(columns).T))
    expected = np.poly(1 / (1 - dt * np.roots([1, kd, kp, ki])))
    np.testing.assert_allclose(found, expected.real, rtol=1e-6, atol=1e-6)


def rollout(p, matrix, dt, steps=400, passive=0.0):
    """Return the positions of robots with a constant mass matrix, pushed from 0 to 1."""
    k, y = bp.discretise(p, dt), np.zeros((len(matrix), matrix.shape[-1]))
    v, state = np.zeros_like(y), bp.init(p, y)
    r = np.ones_like(y)
    with np.errstate(all="ignore"):
        for _ in range(steps):
            state, terms = advance_with_mass_matrix(k, state, r, y, matrix, v)
            v = v + dt * np.linalg.solve(matrix, (terms.effort + passive)[..., None])[..., 0]
            y = y + dt * v
    return y


@pytest.mark.parametrize("dt", [1 / 2000, 1 / 100, 1.0])
@pytest.mark.parametrize("w", [30.0, 316.0, 1e4])
def test_coupled_joints_arrive_at_any_time_step(w, dt):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 5, 5))
    matrix = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(5)
    gains = {"kp": w**2, "ki": w**3 / 5.2, "kd": 2 * w, **IMPLICIT}
    steps = 100 + int(60 / (w * dt))
    np.testing.assert_allclose(
        rollout(bp.make_params(5, **gains), matrix, dt, steps), 1.0, atol=1e-6
    )
    if w * dt < 5:
        explicit = bp.make_params(5, **{**gains, "ki": 0.0, "discretization": "explicit"})
        assert (np.abs(rollout(explicit, matrix, dt, steps) - 1).max() < 1e-3) == (w * dt < 0.828)


def test_a_load_is_learnt_by_the_integral():
    p = bp.make_params(2, 400.0, 2000.0, 40.0, integral_limit=30.0, **IMPLICIT)
    matrix = np.diag([2.0, 0.5])[None]
    np.testing.assert_allclose(
        rollout(p, matrix, 0.05, passive=np.array([[-10.0, 3.0]])), 1.0, atol=1e-6
    )
    soft = bp.make_params(2, 400.0, None, 40.0, **IMPLICIT)
    k = bp.discretise(soft, 0.05)
    offset = 1 - rollout(soft, matrix, 0.05, passive=np.array([[-10.0, 3.0]]))
    np.testing.assert_allclose(offset * k.kp, [[5.0, -6.0]], rtol=1e-6)


@pytest.mark.parametrize(("wdt", "largest"), [(0.3, 4.6), (1.0, 2.3), (3.0, 1.64), (10.0, 1.42)])
def test_an_inertia_that_the_model_overestimates_has_a_bound(wdt, largest):
    dt = 0.01
    w = wdt / dt
    p = as_explicit(bp.make_params(1, w**2, None, 2 * w, **IMPLICIT), dt)
    at = 1 / bp.stability_bound([[1.0]], p.kp[0], p.kd[0], dt).ratio
    assert at == pytest.approx(largest, rel=0.01)
    assert at == pytest.approx(2 * (1 + wdt) ** 2 / (2 * wdt + 1.5 * wdt**2))
    for factor, stable in ((0.05, True), (0.99 * at, True), (1.01 * at, False)):
        radius = spectral_radius([[1 / factor]], p.kp[0], 0.0, p.kd[0], dt)
        assert (radius < 1) == stable


def test_options_that_it_does_not_have_are_refused():
    p = bp.make_params(2, 1.0, derivative_filter_time=0.0, **IMPLICIT)
    assert (p.kd == 0).all()
    with pytest.raises(InvalidArgumentError, match="discretization"):
        p.replace(gain_units="effort")
    assert p.replace(gain_units="effort", discretization="explicit").discretization is None
    assert "ImplicitLaw" in repr(p)


def test_a_params_file_keeps_it():
    p = bp.make_params(2, 400.0, None, 40.0, **IMPLICIT)
    text = bp.dumps_params(p, ["a", "b"])
    assert "discretization: implicit" in text
    assert bp.loads_params(text)[0].discretization == p.discretization
    old = bp.dumps_params(p.replace(discretization="explicit"), ["a", "b"]).replace(
        "discretization: explicit\n", ""
    )
    assert bp.loads_params(old)[0].discretization is None


def test_other_controllers_get_the_gains_of_their_time_step():
    p = bp.make_params(1, 400.0, None, 40.0, measurement_rate="measured", **IMPLICIT)
    per_step = 1 / (1 + 0.05 * 40 + 0.05**2 * 400)
    inertia, share = [2.0], pytest.approx(2 * 400 * per_step)
    text, differences = to_ros2_control(p, ["a"], 0.05, inertia=inertia)
    assert any(
        each.startswith("discretization: gains of the explicit law at dt = 0.05 s")
        for each in differences
    )
    assert float(re.search(r"\bp: ([\d.]+)", text)[1]) == share
    integral = to_ros2_control(p.replace(ki=10.0), ["a"], 0.05, inertia=inertia).differences
    assert any("leads by dt" in each for each in integral)
