"""The tutorial's controller, step for step, and regressions of other controllers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import batchpid as bp

DT = 0.01


def run(params, path, kicks=False):
    """Return the efforts of one joint along [(setpoint, measurement), ...]."""
    r, y = np.array(path).T[:, :, None, None]
    state, efforts = bp.init(params, y[0]), []
    if kicks:  # the error before the first sample is 0
        state = state._replace(setpoint_seen=np.ones((1, 1)))
    for t in range(len(path)):
        state, effort = bp.step(params, state, r[t], y[t], DT)
        efforts.append(effort.item())
    return efforts


gain = st.floats(0, 50)


@given(
    st.lists(st.tuples(st.floats(-10, 10), st.floats(-10, 10)), min_size=2, max_size=25),
    gain,
    gain,
    gain,
)
@settings(max_examples=25)
def test_tutorial(path, kp, ki, kd):
    """SimplePID of SAPIEN's tutorial: it integrates first, and its last error is 0 at the start."""
    integral, last, expected = 0.0, 0.0, []
    for r, y in path:
        integral += (r - y) * DT
        expected.append(kp * (r - y) + ki * integral + kd * (r - y - last) / DT)
        last = r - y
    found = run(bp.presets.tutorial(1, kp + ki * DT, ki, kd), path, kicks=True)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-8)


def test_a_continuous_joint_has_no_derivative_spike():
    params = bp.make_params(1, 0.0, 0.0, 1.0, continuous=True)
    assert run(params, [(3.0, 3.1), (3.0, -3.1)])[1] == pytest.approx(-(2 * math.pi - 6.2) / DT)


# Regressions that control_toolbox's changelog lists.


def test_the_integral_does_not_wind_up_behind_its_clamp():
    """The state is clamped, so that it leaves its limit at once (control_toolbox #34)."""
    params = bp.make_params(1, 0.0, 10.0, integral_limit=1.0)
    efforts = run(params, [(1.0, 0.0)] * 500 + [(-1.0, 0.0)] * 21)
    assert efforts[499] == 1.0
    assert efforts[-1] == pytest.approx(-1.0)


def test_integral_gain_alone_with_back_calculation_is_finite():
    params = bp.make_params(1, 0.0, 5.0, effort_limit=1.0, anti_windup="back_calculation")
    efforts = run(params, [(1.0, 0.0)] * 100 + [(-1.0, 0.0)] * 2)
    assert efforts[99] == 1.0
    assert efforts[-1] == pytest.approx(1.0 - 5.0 * DT), "it leaves saturation in the step after"


def test_a_refused_time_step_and_a_nan_leave_the_state_unchanged():
    """A time step of 0 raises, a NaN is skipped, and neither has a later effect (control_toolbox
    #326).
    """
    params = bp.make_params(1, 1.0, 2.0, 0.5, effort_limit=9.0, non_finite="hold")
    y = np.zeros((1, 1))
    state, _ = bp.step(params, bp.init(params, y), y + 1, y, DT)
    with pytest.raises(bp.InvalidArgumentError):
        bp.step(params, state, y + 1, y, 0.0)
    after, _ = bp.step(params, state, y * math.nan, y, DT)
    assert all(a is b is None or np.array_equal(a, b) for a, b in zip(state, after, strict=True))
