"""The pure functions name what does not fit, and keep the dtype of the params."""

from __future__ import annotations

import numpy as np
import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError

Y, DT = np.zeros((4, 3)), 1e-3
PARAMS = bp.make_params(3, 40.0, 5.0, 2.0, effort_limit=10.0)
STATE = bp.init(PARAMS, Y)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bp.init(PARAMS, np.zeros((4, 2))), r"measurement: has shape \(4, 2\)"),
        (lambda: bp.init(PARAMS, np.zeros((4, 1))), r"measurement: has shape \(4, 1\)"),
        (lambda: bp.init(PARAMS, "here"), "measurement: cannot be read as an array of numbers"),
        (lambda: bp.init({"kp": 1}, Y), "params: must be a PIDParams"),
        (lambda: bp.step(PARAMS, None, Y, Y, DT), "state: must be a PIDState"),
        (lambda: bp.step(PARAMS, STATE, np.ones((5, 3)), Y, DT), r"setpoint: has shape \(5, 3\)"),
        (lambda: bp.step(PARAMS, STATE, Y, np.ones((5, 3)), DT), r"measurement: has shape \(5, 3\)"),
        (lambda: bp.step(PARAMS, STATE, Y, Y, DT, feedforward=np.ones(4)), r"feedforward: has shape \(4,\)"),
        (lambda: bp.step_terms(PARAMS, STATE, Y, Y, DT, setpoint_rate=np.ones(4)), r"setpoint_rate: has shape \(4,\)"),
        (lambda: bp.step(bp.make_params(2, 1.0), STATE, Y, Y, DT), r"state: has shape \(4, 3\)"),
        (lambda: bp.step(bp.make_params(3, np.ones((5, 3)), 1.0), STATE, Y, Y, DT), r"state: has shape \(4, 3\)"),
        (lambda: bp.step(PARAMS, bp.init(bp.make_params(3, 1.0, 1.0), Y), Y, Y, DT), "state: has no measurement"),
        (lambda: bp.track(PARAMS, bp.init(bp.make_params(3, 1.0, 1.0), Y), Y, Y, Y), "state: has no measurement"),
        (lambda: bp.track(PARAMS, STATE, Y, Y, np.ones((4, 2))), r"effort: has shape \(4, 2\)"),
        (lambda: bp.reset(PARAMS, STATE, Y, np.array([0, 2])), "mask: cannot be read as an array of bools"),
        (lambda: bp.reset(PARAMS, STATE, Y, np.ones(3, bool)), r"mask: has shape \(3,\), needs \(4,\)"),
        (lambda: bp.step(PARAMS, STATE, Y, Y, np.float32(-1)), "dt: must be positive and finite"),
        (lambda: bp.step(PARAMS, STATE, Y, Y, np.array(0.0)), "dt: must be positive and finite"),
        (lambda: bp.step(PARAMS, STATE, Y, Y, np.array([[DT], [DT], [DT], [np.nan]])), "dt: must be positive"),
    ],
)
def test_what_does_not_fit_is_named(call, message):
    with pytest.raises(InvalidArgumentError, match=f"^{message}"):
        call()


def test_lists_are_arrays():
    state = bp.init(PARAMS, [[0, 0, 0]] * 4)
    given = bp.step(PARAMS, state, [1, 1, 1], [[0, 0, 0]] * 4, DT, feedforward=1)
    same = bp.step(PARAMS, STATE, np.ones((4, 3)), Y, DT, feedforward=np.ones(3))
    np.testing.assert_array_equal(given[1], same[1])
    np.testing.assert_array_equal(given[0].integral, same[0].integral)
    fresh = bp.reset(PARAMS, given[0], Y + 2, [True, False, False, False])
    np.testing.assert_array_equal(fresh.measurement[:, 0], [2, 0, 0, 0])


@pytest.mark.parametrize("dt", [DT, np.float64(DT), np.float32(DT), np.array(DT), np.full((4, 1), DT)])
def test_the_time_step_does_not_change_the_dtype(dt):
    params = bp.make_params(3, 40.0, 5.0, 2.0, dtype="float32")
    y = Y.astype(np.float32)
    state, effort = bp.step(params, bp.init(params, y), y + 1, y, dt)
    assert {effort.dtype, *(leaf.dtype for leaf in state.leaves().values())} == {np.dtype(np.float32)}


def test_jax_names_them_while_it_traces():
    jax = pytest.importorskip("jax")

    @jax.jit
    def step(setpoint, mask):
        return bp.step(PARAMS, bp.reset(PARAMS, STATE, Y, mask), setpoint, Y, DT)[1]

    assert step(np.ones((4, 3)), np.ones(4, bool)).shape == (4, 3)
    with pytest.raises(InvalidArgumentError, match=r"^setpoint: has shape"):
        step(np.ones((4, 2)), np.ones(4, bool))
    with pytest.raises(InvalidArgumentError, match=r"^mask: must be bools"):
        step(np.ones((4, 3)), np.ones(4, int))
