"""BatchPID: checks of arguments, the state between calls, and agreement with the law on either
backend.
"""

import sys
from unittest import mock

import jax
import numpy as np
import pytest
from law_cases import DT, ENVS, JOINTS, LIMITED

import batchpid as bp

PARAMS = bp.make_params(
    JOINTS, **LIMITED, derivative_filter_time=0.02, anti_windup="back_calculation"
)


def test_jax_compiles_once_and_donates_the_state_but_no_input(inputs, x64, caplog):
    pid = bp.BatchPID(PARAMS, ENVS, DT, "jax")
    y = jax.numpy.asarray(inputs.measurement[0])
    pid(inputs.setpoint[0], y)
    with jax.log_compiles():
        for t in range(5):
            before = pid._state
            pid.params = PARAMS.replace(kp=float(t))
            pid(inputs.setpoint[t], y)
        first = [
            record.getMessage() for record in caplog.records if "Compiling" in record.getMessage()
        ]
        pid.params = PARAMS.replace(deadband=0.1)
        pid(inputs.setpoint[0], y)
    assert first == []
    assert any("Compiling" in record.getMessage() for record in caplog.records), (
        "what compiles is logged"
    )
    assert before.integral.is_deleted(), "the old state's buffers went into the new one"
    assert y.shape == np.asarray(y).shape, "the caller's array is alive"


ACTS = [
    lambda pid, y: None,
    lambda pid, y: setattr(pid, "params", PARAMS),  # options may be switched on in flight
    lambda pid, y: pid.reset(y[3], np.arange(ENVS) < 2),
    lambda pid, y: pid.reset(y[4], np.arange(ENVS) > 1),
    lambda pid, y: setattr(pid, "params", PARAMS.replace(effort_rate_limit=300.0)),
    lambda pid, y: setattr(pid, "params", PARAMS.replace(anti_windup="conditional")),
    lambda pid, y: pid.reset(y[7]),
]


@pytest.mark.parametrize("backend", ["native", "jax"])
def test_resets_and_other_params_give_the_efforts_of_numpy(backend, inputs, x64):
    with mock.patch.dict("os.environ", {"BATCHPID_NATIVE": "0"}):
        theirs = bp.BatchPID(bp.make_params(JOINTS, 1.0), ENVS, DT)
    kind = "jax" if backend == "jax" else "numpy"
    ours = bp.BatchPID(bp.make_params(JOINTS, 1.0), ENVS, DT, kind)
    tolerance = 1e-12 if backend == "jax" else 0.0
    for act in ACTS:
        for pid in (ours, theirs):
            act(pid, inputs.measurement)
        for t in range(3):
            rest = {} if t else {"feedforward": inputs.feedforward[t]}
            now = inputs.setpoint[t], inputs.measurement[t]
            efforts = [pid(*now, **rest) for pid in (ours, theirs)]
            np.testing.assert_allclose(*efforts, rtol=tolerance, atol=10 * tolerance)
            for ours_leaf, leaf in zip(ours.state, theirs.state, strict=True):
                assert (ours_leaf is None) == (leaf is None)


def test_reset_is_that_of_the_law(inputs):
    pid, y = bp.BatchPID(PARAMS, ENVS, DT), inputs.measurement
    for t in range(6):
        pid(inputs.setpoint[t], y[t])
    mask = np.array([True, False, True, False])
    expected = bp.reset(PARAMS, pid.state, y[9], mask)
    pid.reset(y[9], mask)
    jax.tree.map(np.testing.assert_array_equal, pid.state, expected)
    kept = pid.state.integral
    pid.params = PARAMS.replace(effort_rate_limit=1e9, derivative_filter_time=None)
    pid(0.0, y[9])
    assert 0 < np.abs(pid.state.integral - kept).max() < np.abs(kept).max()


def test_params_of_another_size_or_type_are_refused_and_change_nothing():
    pid = bp.BatchPID(PARAMS, ENVS, DT, joint_names=["a", "b", "c"])
    y = np.zeros((ENVS, JOINTS))
    pid(1.0, y)
    params_before = pid.params
    before = [None if leaf is None else np.array(leaf) for leaf in pid.state]
    for params, argument in (
        (bp.make_params(2, 1.0), "params"),
        (bp.make_params(3, np.ones((2, 3))), "params.kp"),
        (PARAMS.replace(dtype=np.float32), "params"),
        (PARAMS._replace(kd=np.array([[1.0, -1.0, 1.0]])), "params.kd, joint 'b'"),
        ({"kp": 1}, "params"),
    ):
        with pytest.raises(bp.InvalidArgumentError, match=f"^{argument}: "):
            pid.params = params
    assert pid.params is params_before
    assert all(
        a is b is None or np.array_equal(a, b) for a, b in zip(before, pid.state, strict=True)
    )


def test_a_missing_jax_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(bp.MissingDependencyError, match=r"\.\[jax\]"):
        bp.BatchPID(PARAMS, ENVS, DT, "jax")
