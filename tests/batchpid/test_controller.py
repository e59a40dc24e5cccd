"""BatchPID: checks of arguments, the state between calls, and agreement with the law on either backend."""

import subprocess
import sys

import jax
import numpy as np
import pytest
from law_cases import DT, ENVS, JOINTS, LIMITED, OPTIONS

import batchpid as bp
from batchpid.errors import InvalidArgumentError

PARAMS = bp.make_params(JOINTS, **LIMITED, derivative_filter_time=0.02, anti_windup="back_calculation")


@pytest.fixture(params=["numpy", "jax"])
def kind(request):
    if request.param == "jax":
        request.getfixturevalue("x64")
    return request.param


# Each case is compiled; test_law_oracle.py compares the compiled law over every option.
COMPILED = [
    *(("jax", case) for case in ("p", "rate and limits", "hold effort")),
    *(
        pytest.param("jax", case, marks=pytest.mark.slow)
        for case in ("per env", "derivative weight", "mixed per env", "everything")
    ),
]


@pytest.mark.quick_rows(14)
@pytest.mark.parametrize(("kind", "options"), [*(("numpy", case) for case in OPTIONS), *COMPILED], indirect=True)
def test_calls_equal_steps_of_the_law(kind, options, inputs):
    params = bp.make_params(JOINTS, **options)
    pid = bp.BatchPID(params, ENVS, DT, kind, terms=True)
    state = bp.init(params, inputs.measurement[0])
    for t in range(10):
        r, y, v, ff = (x[t] for x in (inputs.setpoint, inputs.measurement, inputs.measurement_rate, inputs.feedforward))
        state, expected = bp.step(params, state, r, y, DT, measurement_rate=v, feedforward=ff)
        effort = pid(r, y, v, feedforward=ff)
        np.testing.assert_allclose(effort, expected, rtol=1e-9, atol=1e-9)
        assert np.array_equal(pid.terms.effort, effort)
    assert [leaf is None for leaf in pid.state] == [leaf is None for leaf in state]


def test_jax_compiles_once_and_donates_the_state_but_no_input(inputs, x64, caplog):
    pid = bp.BatchPID(PARAMS, ENVS, DT, "jax")
    y = jax.numpy.asarray(inputs.measurement[0])
    pid(inputs.setpoint[0], y)
    with jax.log_compiles():
        for t in range(5):
            before = pid.state
            pid.params = PARAMS.replace(kp=float(t))
            pid(inputs.setpoint[t], y)
        first = [record.getMessage() for record in caplog.records if "Compiling" in record.getMessage()]
        pid.params = PARAMS.replace(deadband=0.1)
        pid(inputs.setpoint[0], y)
    assert first == []
    assert any("Compiling" in record.getMessage() for record in caplog.records), "what compiles is logged"
    assert before.integral.is_deleted(), "the old state's buffers went into the new one"
    assert y.shape == np.asarray(y).shape, "the caller's array is alive"


def test_efforts_have_the_dtype_of_the_params(kind):
    pid = bp.BatchPID(PARAMS.replace(dtype=np.float32), ENVS, DT, kind)
    assert pid(1.0, np.zeros((ENVS, JOINTS))).dtype == np.float32


def test_reset_and_track(kind, inputs):
    pid = bp.BatchPID(PARAMS, ENVS, DT, kind)
    for t in range(6):
        pid(inputs.setpoint[t], inputs.measurement[t])
    integral, mask = np.array(pid.state.integral), np.array([True, False, True, False])
    pid.reset(inputs.measurement[9], mask, keep_integral=True)
    assert np.array_equal(pid.state.integral, integral)
    assert np.array_equal(np.asarray(pid.state.measurement)[mask], inputs.measurement[9][mask])
    pid.reset(inputs.measurement[9], mask)
    assert np.array_equal(pid.state.integral, np.where(mask[:, None], 0, integral))
    pid.track(1.0, inputs.measurement[9], 0.5, feedforward=0.2)
    np.testing.assert_allclose(pid(1.0, inputs.measurement[9], feedforward=0.2), 0.5, atol=1e-6)
    pid.reset(inputs.measurement[9])
    assert not np.asarray(pid.state.integral).any()


def test_track_makes_a_change_of_gains_bumpless(kind, inputs):
    """A larger kp alone would make the effort jump."""
    pid = bp.BatchPID(bp.make_params(JOINTS, 4.0, 1.0, 0.1), ENVS, DT, kind)
    r, y = inputs.setpoint[0], inputs.measurement[0]
    before = np.array(pid(r, y))
    pid.params = pid.params.replace(kp=9.0)
    pid.track(r, y, before)
    np.testing.assert_allclose(pid(r, y), before, atol=1e-6)


def test_an_option_may_be_switched_on_in_flight(kind, inputs):
    pid = bp.BatchPID(bp.make_params(JOINTS, 1.0), ENVS, DT, kind)
    pid(1.0, inputs.measurement[0])
    pid.params = PARAMS
    pid(1.0, inputs.measurement[1])
    kept = np.array(pid.state.integral)
    pid.params = PARAMS.replace(effort_rate_limit=1e9, derivative_filter_time=None)
    pid(0.0, inputs.measurement[2])
    assert pid.state.effort is not None
    assert pid.state.derivative is None
    assert kept.any()
    assert np.abs(np.asarray(pid.state.integral) - kept).max() < np.abs(kept).max()


def test_wrong_calls_are_refused_and_change_nothing(kind):
    pid = bp.BatchPID(PARAMS, ENVS, DT, kind, joint_names=["a", "b", "c"])
    y = np.zeros((ENVS, JOINTS))
    pid(1.0, y)
    before = [None if leaf is None else np.array(leaf) for leaf in pid.state]
    for arguments, said in (
        ((1.0, y[0]), r"measurement: has shape \(3,\), not \(4, 3\)"),
        ((y.T, y), r"setpoint: has shape \(3, 4\), which does not broadcast to \(4, 3\)"),
        ((1.0, y, y[None]), "measurement_rate: has shape"),
        ((1.0, y, None, y[:2]), "setpoint_rate: has shape"),
        ((1.0, y, None, None, np.zeros(4)), "feedforward: has shape"),
    ):
        with pytest.raises(bp.InvalidArgumentError, match=said):
            pid(*arguments)
    with pytest.raises(bp.InvalidArgumentError, match="mask: cannot be read as an array of bools: its dtype is int64"):
        pid.reset(y, np.arange(ENVS))
    with pytest.raises(bp.InvalidArgumentError, match=r"mask: .*shape"):
        pid.reset(y, np.ones(2, bool))
    with pytest.raises(bp.InvalidArgumentError, match="effort: has shape"):
        pid.track(1.0, y, np.ones(2))
    for params, said in (
        (bp.make_params(2, 1.0), "params: hold 2 joints, not 3"),
        (bp.make_params(3, np.ones((2, 3))), r"params\.kp: has shape \(2, 3\)"),
        (PARAMS.replace(dtype=np.float32), "params: are float32"),
        (PARAMS._replace(kd=np.array([[1.0, -1.0, 1.0]])), r"params\.kd, joint 'b': must be >= 0"),
        ({"kp": 1}, "params: must be a PIDParams"),
    ):
        with pytest.raises(bp.InvalidArgumentError, match=said):
            pid.params = params
    with pytest.raises(bp.InvalidArgumentError, match="terms: are not kept"):
        _ = pid.terms
    assert pid.params is PARAMS
    assert all(a is b is None or np.array_equal(a, b) for a, b in zip(before, pid.state, strict=True))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((PARAMS, 0, DT), "num_envs: .*0"),
        ((PARAMS, 2.0, DT), "num_envs"),
        ((PARAMS, True, DT), "num_envs"),
        ((PARAMS, ENVS, 0.0), "dt: .*positive"),
        ((PARAMS, ENVS, "fast"), "dt: .*fast"),
        ((PARAMS, ENVS, DT, "torch"), "backend: .*torch.*'numpy', 'jax'"),
        (({"kp": 1}, ENVS, DT), "params: must be a PIDParams"),
    ],
)
def test_wrong_controllers_are_refused(arguments, said):
    with pytest.raises(bp.InvalidArgumentError, match=said):
        bp.BatchPID(*arguments)


def test_a_missing_jax_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(bp.MissingDependencyError, match=r"batchpid\[jax\]"):
        bp.BatchPID(PARAMS, ENVS, DT, "jax")


def test_import_loads_no_optional_package():
    code = "import sys, batchpid; print(sorted({'jax', 'sapien', 'matplotlib', 'tyro'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize(
    "measurement",
    [
        np.array([[1 + 2j, 0.0]]),
        np.array([["1", "2"]]),
        [["1", "2"]],
        np.array([["2020-01-01", "2020-01-02"]], "datetime64"),
        np.ma.masked_array([[1.0, 2.0]], mask=[[True, False]]),
    ],
    ids=["complex", "strings", "list of strings", "dates", "masked"],
)
def test_arrays_that_are_not_of_real_numbers_are_refused(measurement):
    pid = bp.BatchPID(bp.make_params(2, kp=1.0), num_envs=1, dt=0.01)
    with pytest.raises(InvalidArgumentError, match="measurement: cannot be read as an array of numbers"):
        pid(np.zeros((1, 2)), measurement)
