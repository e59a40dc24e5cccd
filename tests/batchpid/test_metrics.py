"""Metrics against closed-form second-order responses, and their behaviour at the edges."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from batchpid.metrics import step_metrics


def second_order(t, zeta, omega):
    """Unit step response of omega^2 / (s^2 + 2 zeta omega s + omega^2) for 0 < zeta < 1."""
    damped = omega * np.sqrt(1 - zeta**2)
    decay = np.exp(-zeta * omega * t)
    return 1 - decay * (np.cos(damped * t) + zeta / np.sqrt(1 - zeta**2) * np.sin(damped * t))


def respond(zeta, omega, move=1.0, start=0.0, seconds=None, samples=40_001):
    t = np.linspace(0, seconds if seconds is not None else 40 / (zeta * omega), samples)
    y = start + move * second_order(t, zeta, omega)
    return t, y[:, None, None], start + move


@settings(deadline=None, max_examples=30)
@given(
    zeta=st.floats(0.1, 0.9),
    omega=st.floats(0.5, 50),
    move=st.floats(0.1, 3).flatmap(lambda size: st.sampled_from([size, -size])),
    start=st.floats(-2, 2),
)
def test_second_order_overshoot_and_settling_match_the_closed_form(zeta, omega, move, start):
    t, y, r = respond(zeta, omega, move, start)
    m = step_metrics(t[1], [r], y, absolute_band=1e-9)
    damped = omega * np.sqrt(1 - zeta**2)
    assert m.overshoot[0, 0] == pytest.approx(np.exp(-np.pi * zeta * omega / damped), rel=1e-3)
    # The envelope bounds the settling time from above, one half period before it from below.
    envelope = -np.log(0.02 * np.sqrt(1 - zeta**2)) / (zeta * omega)
    assert envelope - np.pi / damped <= m.settling_time[0, 0] <= envelope + t[1]
    # and after it the error stays within the band, which it was outside of just before
    settled = t > m.settling_time[0, 0] + t[1]
    assert (np.abs(y[settled] - r) <= 0.02 * abs(move) * (1 + 1e-6)).all()
    assert m.peak_deviation[0, 0] == pytest.approx(m.overshoot[0, 0] * abs(move))


def test_critically_damped_settling_and_integral():
    # y = 1 - (1 + w t) e^{-w t}; e = (1 + w t) e^{-w t}: ITAE = 3 / w^2.
    omega = 7.0
    t = np.linspace(0, 10, 100_001)
    y = (1 - (1 + omega * t) * np.exp(-omega * t))[:, None, None]
    m = step_metrics(t[1], [1.0], y)
    assert m.itae[0, 0] == pytest.approx(3 / omega**2, rel=1e-6)
    assert m.settling_time[0, 0] == pytest.approx(5.83392 / omega, rel=1e-4)  # (1 + x) e^-x = 0.02
    assert m.overshoot[0, 0] == 0
    assert m.steady_state_error[0, 0] < 1e-12


def test_start_is_prepended_at_time_zero():
    t = np.linspace(0, 2, 201)
    y = (1 - np.exp(-5 * t))[:, None, None]
    with_row = step_metrics(t[1], [1.0], y)
    prepended = step_metrics(t[1], [1.0], y[1:], start=[0.0])
    for a, b in zip(with_row, prepended, strict=True):
        np.testing.assert_array_equal(a, b)


def test_effort_figures():
    u = np.array([1.0, -2.0, 0.0, 0.0])[:, None, None]
    m = step_metrics(1.0, [0.0], np.zeros((4, 1, 1)), effort=u, saturated=u < 0)
    assert m.effort_variation[0, 0] == 5
    assert m.saturation_share[0, 0] == 0.25
    for effort, figure in ((u * np.nan, np.inf), (None, np.nan)):
        m = step_metrics(1.0, [0.0], np.zeros((4, 1, 1)), effort=effort)
        np.testing.assert_array_equal(m.effort_variation, figure)


def test_joint_that_should_not_move_uses_the_absolute_band():
    t = np.linspace(0, 1, 101)
    y = np.where(t < 0.5, 0.01, 0.0005)[:, None, None]
    m = step_metrics(t[1], [0.0], y, start=None, absolute_band=1e-3)
    assert np.isnan(m.overshoot[0, 0])
    assert m.peak_deviation[0, 0] == 0.01
    assert 0.48 < m.settling_time[0, 0] <= 0.5


def test_never_settling_is_inf_and_nan_spoils_only_its_own_joint():
    t = np.linspace(0, 1, 101)
    y = np.zeros((101, 2, 2))
    y[:, :, 0] = np.linspace(0, 1, 101)[:, None]
    y[60:, 1, 1] = np.nan
    effort = np.nan_to_num(y)
    m = step_metrics(
        t[1], [1.0, 1.0], y, start=None, effort=effort, saturated=np.zeros_like(y, bool)
    )
    assert np.isinf(m.settling_time[0, 1])
    for figure in (
        m.overshoot,
        m.settling_time,
        m.steady_state_error,
        m.peak_deviation,
        m.itae,
    ):
        assert figure[1, 1] == np.inf
    alone = step_metrics(t[1], [1.0], y[:, :1, :1])
    assert alone.settling_time[0, 0] == m.settling_time[1, 0]


def test_continuous_joint_moves_the_short_way():
    t = np.linspace(0, 4, 401)
    course = 3.0 + 0.5 * (1 - np.exp(-6 * t))
    wrapped = (course + np.pi) % (2 * np.pi) - np.pi
    plain = step_metrics(t[1], [3.5], course[:, None, None])
    turned = step_metrics(t[1], [3.5 - 2 * np.pi], wrapped[:, None, None], continuous=[True])
    for a, b in zip(plain, turned, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
