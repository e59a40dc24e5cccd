"""The tutorial's controller, step for step."""

import numpy as np
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
    params = bp.make_params(1, kp + ki * DT, ki, kd, setpoint_weight_derivative=1.0)
    found = run(params, path, kicks=True)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-8)
