"""The implicit law: its poles, and its stability at any time step; test_law_conformance.py compares
it with its equation, solved numerically.
"""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampled_loop import spectral_radius

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.export import to_ros2_control
from batchpid.law import as_explicit

IMPLICIT = {"gain_units": "mass_matrix", "discretization": "implicit"}
gain = st.floats(0.01, 1e4)


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
