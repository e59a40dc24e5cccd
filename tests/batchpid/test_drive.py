"""drive_target: a PD drive with a target moved by the integral is a PID."""

import numpy as np
import pytest
from law_cases import DT, ENVS, JOINTS

import batchpid as bp


def test_a_drive_with_a_moving_target_gives_the_effort_of_the_law(inputs):
    params = bp.make_params(JOINTS, 40.0, 5.0, 2.0, effort_limit=9.0, anti_windup="conditional")
    state = other = bp.init(params, inputs.measurement[0])
    for t in range(20):
        r, y, v = inputs.setpoint[t], inputs.measurement[t], inputs.measurement_rate[t]
        state, target = bp.drive_target(params, state, r, y, DT, measurement_rate=v)
        other, effort = bp.step(params, other, r, y, DT, measurement_rate=v)
        np.testing.assert_allclose(
            np.clip(40.0 * (target - y) - 2.0 * v, -9, 9), effort, rtol=1e-12, atol=1e-12
        )


def test_without_stiffness_the_target_is_the_setpoint():
    params = bp.make_params(JOINTS, [0.0, 1.0, 2.0], 5.0)
    y = np.zeros((ENVS, JOINTS))
    state = bp.init(params, y)
    for _ in range(3):
        state, target = bp.drive_target(params, state, y + 1, y, DT)
    assert (target[:, 0] == 1).all()
    assert (target[:, 1:] > 1).all()
    assert np.isfinite(target).all()


@pytest.mark.parametrize("ki", [0.0, 20.0])
def test_integral_action_removes_the_sag_under_load(ki):
    """A mass on an implicit spring-damper under a constant load: PD leaves load/stiffness, PID
    nothing.
    """
    params = bp.make_params(1, 30.0, ki, 8.0, effort_limit=50.0, anti_windup="conditional")
    x, v = np.zeros((1, 1)), np.zeros((1, 1))
    state, setpoint = bp.init(params, x), np.ones((1, 1))
    for _ in range(1200):
        state, target = bp.drive_target(params, state, setpoint, x, DT, measurement_rate=v)
        v = (v + DT * (30.0 * (target - x) - 9.81)) / (1 + 8.0 * DT + 30.0 * DT**2)
        x = x + v * DT
    assert x.item() == pytest.approx(1.0 if ki else 1 - 9.81 / 30, abs=1e-4)
