"""The array law against the scalar one, over every option, array library and float type."""

import numpy as np
import pytest
from law_cases import DT, ENVS, JOINTS, Backend, read_only
from scalar_pid import ScalarPID, scalar_pids

import batchpid as bp
from batchpid.law.reference import SimplePID

ALL = ("measurement_rate", "setpoint_rate", "feedforward")
SOME = [("measurement_rate",), ("setpoint_rate",), ("measurement_rate", "setpoint_rate"), ("feedforward",)]


@pytest.mark.quick_rows(50)
def test_step_equals_the_scalar_law(backend, options, inputs):
    """With all inputs in one float type of JAX, without in the other: each is another program to compile."""
    for given in {"jax64": [()], "jax32": [ALL]}.get(backend.name, [(), ALL]):
        compare(backend, options, inputs, given)


@pytest.mark.parametrize("given", SOME, ids=" ".join)
def test_step_equals_the_scalar_law_on_some_inputs(options, inputs, given):
    compare(Backend("numpy64", np.float64, read_only, bp.step_terms), options, inputs, given)


def compare(backend, options, inputs, given):
    """Assert that the efforts of a run equal one scalar controller per env and joint."""
    params = bp.make_params(JOINTS, **options, dtype=backend.dtype)
    params = bp.PIDParams(*(backend.array(x) if isinstance(x, np.ndarray) else x for x in params))
    pids = scalar_pids(params, ENVS)
    state = bp.init(params, backend.array(inputs.measurement[0]))
    for env, joint in np.ndindex(ENVS, JOINTS):
        pids[env][joint].start(inputs.measurement[0, env, joint])
    saturated = []
    for t in range(len(inputs.setpoint)):
        keywords = {name: backend.array(getattr(inputs, name)[t]) for name in given}
        state, terms = backend.step(
            params,
            state,
            backend.array(inputs.setpoint[t]),
            backend.array(inputs.measurement[t]),
            dt=DT,
            **keywords,
        )
        expected = np.array(
            [
                [
                    pids[env][joint].step(
                        inputs.setpoint[t, env, joint],
                        inputs.measurement[t, env, joint],
                        DT,
                        **{name: getattr(inputs, name)[t, env, joint] for name in given},
                    )
                    for joint in range(JOINTS)
                ]
                for env in range(ENVS)
            ]
        )
        effort, scale = terms.effort, sum(np.abs(np.asarray(term, float)) for term in terms[:4]) + 1
        error = np.abs(np.asarray(effort, float) - expected) / scale
        assert effort.dtype == backend.dtype
        assert error.max() < backend.tolerance, f"step {t}"
        saturated.append(np.asarray(terms.saturated))
        for env, joint in np.ndindex(ENVS, JOINTS):
            gap = abs(pids[env][joint].unsaturated - pids[env][joint].effort)
            if gap == 0 or gap > 1e-3:
                assert saturated[-1][env, joint] == (gap > 0)
    if "effort_limit" in options:
        assert 0 < np.mean(saturated) < 1, "the case saturates, and not always"


def test_terms_add_up(options, inputs):
    params = bp.make_params(JOINTS, **options)
    state = bp.init(params, inputs.measurement[0])
    for t in range(5):
        now, given = (params, state, inputs.setpoint[t], inputs.measurement[t], DT), inputs.feedforward[t]
        (_, alone), (state, terms) = (function(*now, feedforward=given) for function in (bp.step, bp.step_terms))
        assert np.array_equal(alone, terms.effort)
        assert np.array_equal(terms.feedforward, inputs.feedforward[t])
        np.testing.assert_allclose(terms.p + terms.i + terms.d + terms.feedforward, terms.unsaturated, rtol=1e-12)
        assert np.array_equal(terms.saturated, terms.effort != terms.unsaturated)
        assert terms.finite.all()


def test_an_option_with_a_neutral_value_is_off(inputs):
    """Neutral values are off: same structure and same bits as leaving the option out."""
    plain = bp.make_params(JOINTS, kp=3.0, ki=1.0, kd=0.2)
    neutral = bp.make_params(
        JOINTS,
        kp=3.0,
        ki=1.0,
        kd=0.2,
        effort_limit=np.inf,
        effort_rate_limit=np.inf,
        integral_limit=np.inf,
        derivative_filter_time=0.0,
        setpoint_weight=1.0,
        setpoint_weight_derivative=0.0,
        deadband=0.0,
        continuous=False,
    )
    assert [leaf is None for leaf in plain] == [leaf is None for leaf in neutral]
    assert sum(isinstance(leaf, np.ndarray) for leaf in plain) == 3


def test_every_option_that_is_on_changes_the_efforts(options, inputs):
    """Every case of the table changes the efforts of a plain PID, so that no test of it is empty."""
    if set(options) <= {"kp", "ki", "kd"}:
        pytest.skip("a plain PID")
    plain = bp.make_params(JOINTS, options["kp"], options["ki"], options["kd"])
    efforts = []
    for params in (plain, bp.make_params(JOINTS, **options)):
        state = bp.init(params, inputs.measurement[0])
        efforts.append([])
        for t in range(20):
            state, effort = bp.step(params, state, inputs.setpoint[t], inputs.measurement[t], DT)
            efforts[-1].append(effort)
    assert not np.array_equal(*efforts)


def test_simple_pid_by_hand():
    pid = SimplePID(2.0, 3.0, 0.5)
    assert pid.compute(1.0, 0.1) == pytest.approx(2.0 + 0.3 + 5.0)
    assert pid.compute(0.5, 0.1) == pytest.approx(1.0 + 0.45 - 2.5)


def test_scalar_pid_by_hand():
    pid = ScalarPID(2.0, 3.0, 0.5, effort_max=2.1, anti_windup="back_calculation", tracking_time=0.2)
    pid.start(0.0)
    assert pid.step(1.0, 0.0, 0.1) == 2.0, "output first, and no derivative at the first measurement"
    assert pid.integral == pytest.approx(0.3)
    assert pid.step(1.0, -0.1, 0.1) == 2.1
    assert pid.unsaturated == pytest.approx(2.2 + 0.3 + 0.5)
    assert pid.integral == pytest.approx(0.3 + 0.33 + 0.5 * (2.1 - 3.0))
