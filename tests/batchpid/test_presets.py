"""The peers' numerics, step for step: the real simple-pid, and the others from their documented equations."""

import math

import numpy as np
import pytest
import simple_pid
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import batchpid as bp
from batchpid.gains import presets

DT = 0.01
series = st.lists(st.tuples(st.floats(-10, 10), st.floats(-10, 10)), min_size=2, max_size=25)
gain = st.floats(0, 50)


def run(params, path, start=None, **inputs):
    """Return the efforts of one joint along [(setpoint, measurement), ...]."""
    r, y = np.array(path).T[:, :, None, None]
    state, efforts = bp.init(params, y[0] if start is None else np.full((1, 1), start)), []
    for t in range(len(path)):
        now = {name: np.full((1, 1), values[t]) for name, values in inputs.items()}
        state, effort = bp.step(params, state, r[t], y[t], DT, **now)
        efforts.append(effort.item())
    return efforts


def close(a, b):
    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-8)


@given(series, gain, gain, gain)
@settings(max_examples=25)
def test_tutorial(path, kp, ki, kd):
    """SimplePID of SAPIEN's tutorial "Drive Robot with PID Controller": its last error is 0 at the start."""
    integral, last, expected = 0.0, 0.0, []
    for r, y in path:
        integral += (r - y) * DT
        expected.append(kp * (r - y) + ki * integral + kd * (r - y - last) / DT)
        last = r - y
    close(run(presets.tutorial(1, kp, ki, kd), path), expected)


@given(
    series,
    gain,
    gain,
    gain,
    st.sampled_from([(None, None), (-5.0, 5.0), (1.0, 20.0), (None, 3.0)]),
    st.booleans(),
    st.booleans(),
)
@settings(max_examples=40)
def test_simple_pid(path, kp, ki, kd, limits, on_measurement, differential_on_measurement):
    options = {
        "output_limits": limits,
        "proportional_on_measurement": on_measurement,
        "differential_on_measurement": differential_on_measurement,
    }
    peer = simple_pid.PID(kp, ki, kd, sample_time=None, **options)
    expected = []
    for r, y in path:
        peer.setpoint = r
        expected.append(peer(y, dt=DT))
    close(run(presets.simple_pid(1, kp, ki, kd, **options), path), expected)


@pytest.mark.slow
@given(
    series,
    st.lists(st.tuples(gain, gain, gain), min_size=25, max_size=25),
    st.lists(st.floats(1e-3, 0.1), min_size=25, max_size=25),
    st.floats(-9, 9),
    st.integers(1, 24),
    st.booleans(),
)
@settings(max_examples=40)
def test_simple_pid_in_flight(path, tunings, steps, starting_output, restart, differential_on_measurement):
    """Starting output, gains and time steps that change at every step, a reset, and the terms on the way."""
    options = {"output_limits": (-5, 7), "differential_on_measurement": differential_on_measurement}
    peer = simple_pid.PID(sample_time=None, starting_output=starting_output, **options)
    y = np.array([[path[0][1]]])
    state = bp.init(presets.simple_pid(1, **options), y)
    state = state._replace(integral=np.clip([[starting_output]], -5, 7))
    for t, (r, y) in enumerate(path):
        params = presets.simple_pid(1, *tunings[t], **options)
        peer.tunings, peer.setpoint = tunings[t], r
        if t == restart:
            peer.reset()
            state = bp.reset(params, state, np.full((1, 1), y), np.array([True]))
        expected = peer(y, dt=steps[t])
        state, terms = bp.step_terms(params, state, np.full((1, 1), r), np.full((1, 1), y), steps[t])
        close(terms.effort.item(), expected)
        close([terms.p.item(), terms.i.item(), terms.d.item()], peer.components)


@given(series, gain, gain)
@settings(max_examples=20)
def test_simple_pid_with_an_error_map_equals_a_continuous_joint_without_d(path, kp, ki):
    """P and I alone: its D spikes, see below."""
    assume(all(abs(math.remainder(r - y, 2 * math.pi)) < math.pi - 1e-6 for r, y in path))
    peer = simple_pid.PID(kp, ki, sample_time=None, error_map=lambda e: math.remainder(e, 2 * math.pi))
    expected = []
    for r, y in path:
        peer.setpoint = r
        expected.append(peer(y, dt=DT))
    close(run(presets.simple_pid(1, kp, ki, continuous=True), path), expected)


def test_simple_pid_from_manual_to_automatic_is_a_state_with_that_integral():
    """It sets the integral to the last output; track makes the change bumpless."""
    peer = simple_pid.PID(2.0, 1.0, 0.0, setpoint=1.0, sample_time=None, output_limits=(-3, 3), auto_mode=False)
    peer.set_auto_mode(True, last_output=2.5)
    params = presets.simple_pid(1, 2.0, 1.0, 0.0, output_limits=(-3, 3))
    y = np.full((1, 1), 0.2)
    state = bp.init(params, y)._replace(integral=np.full((1, 1), 2.5))
    assert bp.step(params, state, y * 0 + 1, y, DT)[1].item() == pytest.approx(peer(0.2, dt=DT))
    tracked = bp.track(params, state, y * 0 + 1, y, np.full((1, 1), 2.5), dt=DT)
    assert bp.step(params, tracked, y * 0 + 1, y, DT)[1].item() == pytest.approx(2.5, abs=1e-9)


def test_a_continuous_joint_has_no_derivative_spike_where_simple_pid_has_one():
    def shortest(error):
        return math.remainder(error, 2 * math.pi)

    path = [(3.0, 3.1), (3.0, -3.1)]
    peer = simple_pid.PID(0, 0, 1.0, sample_time=None, error_map=shortest)
    peer.setpoint = 3.0
    peer(3.1, dt=DT)
    assert peer(-3.1, dt=DT) > 600
    params = bp.make_params(1, 0.0, 0.0, 1.0, continuous=True)
    assert run(params, path)[1] == pytest.approx(-(2 * math.pi - 6.2) / DT)


class ControlToolbox:
    """control_toolbox's pid.cpp as documented: output, clamp, then integrate; the last error starts at 0."""

    def __init__(self, p, i, d, u_max, u_min, i_max, i_min, antiwindup, tracking_time):
        self.p, self.i, self.d = p, i, d
        self.u_max, self.u_min, self.i_max, self.i_min = u_max, u_min, i_max, i_min
        self.antiwindup, self.last_error, self.integral = antiwindup, 0.0, min(max(0.0, i_min), i_max)
        if tracking_time == 0:
            tracking_time = math.sqrt(d / i) if d != 0 else p / i
        self.tracking_time = tracking_time

    def compute(self, error, dt):
        unsaturated = self.p * error + self.integral + self.d * (error - self.last_error) / dt
        command = min(max(unsaturated, self.u_min), self.u_max)
        if self.antiwindup == "back_calculation":
            self.integral += dt * (self.i * error + (command - unsaturated) / self.tracking_time)
        elif not (self.antiwindup == "conditional_integration" and command != unsaturated and error * unsaturated > 0):
            self.integral += dt * self.i * error
        self.integral = min(max(self.integral, self.i_min), self.i_max)
        self.last_error = error
        return command


@given(
    series,
    gain,
    st.floats(0.01, 50),
    gain,
    st.sampled_from(["none", "back_calculation", "conditional_integration"]),
    st.sampled_from([0, 0.05, 1.0]),
    st.sampled_from([math.inf, 1.0]),
)
@settings(max_examples=25)
def test_control_toolbox(path, p, i, d, antiwindup, tracking_time, i_max):
    if antiwindup == "back_calculation" and tracking_time == 0 and (math.sqrt(d / i) if d else p / i) < DT:
        return  # there the peer oscillates, or divides by 0: not reproduced
    peer = ControlToolbox(p, i, d, 8.0, -5.0, i_max, -i_max, antiwindup, tracking_time)
    back = {"tracking_time": tracking_time or None} if antiwindup == "back_calculation" else {}
    params = presets.control_toolbox(
        1, p, i, d, u_max=8.0, u_min=-5.0, i_max=i_max, i_min=-i_max, antiwindup=antiwindup, **back
    )
    close(run(params, path), [peer.compute(r - y, DT) for r, y in path])


@given(series, gain, gain, gain, st.sampled_from([math.inf, 0.05]), st.sampled_from([None, 6.0]))
@settings(max_examples=25)
def test_newton(path, kp, ki, kd, integral_max, limit):
    rng = np.random.default_rng(1)
    v, v_d, ff = rng.normal(size=(3, len(path)))
    integral, expected = 0.0, []
    for t, (r, y) in enumerate(path):
        integral = min(max(integral + (r - y) * DT, -integral_max), integral_max)
        effort = ff[t] + kp * (r - y) + ki * integral + kd * (v_d[t] - v[t])
        expected.append(effort if limit is None else min(max(effort, -limit), limit))
    params = presets.newton(1, kp, ki, kd, integral_max=integral_max, effort_limit=limit)
    close(run(params, path, measurement_rate=v, setpoint_rate=v_d, feedforward=ff), expected)


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
    """A time step of 0 raises, a NaN is skipped, and neither has a later effect (control_toolbox #326)."""
    params = bp.make_params(1, 1.0, 2.0, 0.5, effort_limit=9.0, non_finite="hold")
    y = np.zeros((1, 1))
    state, _ = bp.step(params, bp.init(params, y), y + 1, y, DT)
    with pytest.raises(bp.InvalidArgumentError):
        bp.step(params, state, y + 1, y, 0.0)
    after, _ = bp.step(params, state, y * math.nan, y, DT)
    assert all(a is b is None or np.array_equal(a, b) for a, b in zip(state, after, strict=True))
