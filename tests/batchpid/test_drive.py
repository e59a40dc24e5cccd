"""advance_drive: a PD drive with a target moved by the integral is a PID."""

import numpy as np
from law_cases import DT, ENVS, JOINTS

import batchpid as bp
from batchpid.law.pid import advance_drive


def test_a_drive_with_a_moving_target_gives_the_effort_of_the_law(inputs):
    params = bp.make_params(JOINTS, 40.0, 5.0, 2.0, effort_limit=9.0, anti_windup="conditional")
    k = bp.discretise(params, DT)
    state = other = bp.init(params, inputs.measurement[0])
    for t in range(20):
        r, y, v = inputs.setpoint[t], inputs.measurement[t], inputs.measurement_rate[t]
        state, target = advance_drive(k, state, r, y, measurement_rate=v)
        other, effort = bp.step(params, other, r, y, DT, measurement_rate=v)
        np.testing.assert_allclose(
            np.clip(40.0 * (target - y) - 2.0 * v, -9, 9), effort, rtol=1e-12, atol=1e-12
        )


def test_without_stiffness_the_target_is_the_setpoint():
    params = bp.make_params(JOINTS, [0.0, 1.0, 2.0], 5.0)
    y = np.zeros((ENVS, JOINTS))
    k, state = bp.discretise(params, DT), bp.init(params, y)
    for _ in range(3):
        state, target = advance_drive(k, state, y + 1, y)
    assert (target[:, 0] == 1).all()
    assert (target[:, 1:] > 1).all()
    assert np.isfinite(target).all()
