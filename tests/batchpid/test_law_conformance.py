"""Every executor of the law agrees with a scalar controller (scalar_pid.py), for params of any
combination of options.

Native programs and exported C: test_compiled_law.py and test_c_header.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple
from unittest import mock

import jax
import numpy as np
import pytest
from law_cases import DT, JOINTS, Inputs, generated_options, made_up_inputs, read_only
from quick_jit import quick_jit
from scalar_pid import scalar_pids

import batchpid as bp

RATES = ("measurement_rate", "setpoint_rate", "feedforward")
GIVEN = [
    (),
    RATES,
    ("measurement_rate",),
    ("setpoint_rate",),
    ("measurement_rate", "setpoint_rate"),
    ("feedforward",),
]


def by_steps(params, inputs, step=bp.step, array=read_only):
    """Return the efforts (steps, envs, joints) of ``step``; ``array`` makes its arrays, by default
    read-only ones.
    """
    params = bp.PIDParams(
        *(array(x, params.dtype) if isinstance(x, np.ndarray) else x for x in params)
    )
    rows = [
        [None if x is None else array(x[t], params.dtype) for x in inputs]
        for t in range(len(inputs.setpoint))
    ]
    state, efforts = bp.init(params, rows[0][1]), []
    for setpoint, measurement, *rates in rows:
        state, effort = step(
            params, state, setpoint, measurement, DT, **dict(zip(RATES, rates, strict=True))
        )
        assert effort.dtype == params.dtype
        efforts.append(np.asarray(effort, float))
    return np.array(efforts)


def by_jax(params, inputs):
    return by_steps(params, inputs, quick_jit(bp.step, static_argnames="dt"), jax.numpy.asarray)


def by_controller(params, inputs, backend="numpy"):
    pid = bp.BatchPID(params, inputs.setpoint.shape[1], DT, backend)
    rows = zip(
        *(x if x is not None else [None] * len(inputs.setpoint) for x in inputs), strict=True
    )
    efforts = np.array(
        [pid(*(None if x is None else x.astype(params.dtype) for x in row)) for row in rows]
    )
    assert efforts.dtype == params.dtype
    return efforts.astype(float)


def by_numpys_controller(params, inputs):
    with mock.patch.dict("os.environ", {"BATCHPID_NATIVE": "0"}):
        return by_controller(params, inputs)


def by_jaxs_controller(params, inputs):
    """Return the efforts of BatchPID with backend "jax", which has all of JAX's optimisations."""
    return by_controller(params, inputs, "jax")


class Executor(NamedTuple):
    """Function that returns the efforts (steps, envs, joints) of params under inputs, and its
    properties.
    """

    run: Any
    dtype: Any = np.float64
    seeds: int = 12
    """Number of generated params to test."""
    bits: bool = False
    """Whether results are bit-identical to NumPy's."""


EXECUTORS = {
    "numpy": Executor(by_steps, seeds=24),
    "numpy float32": Executor(by_steps, np.float32),
    "controller": Executor(by_numpys_controller, bits=True),
    "jax": Executor(by_jax, seeds=3),
    "jax float32": Executor(by_jax, np.float32, seeds=3),
    "jax controller": Executor(by_jaxs_controller, np.float32, seeds=2),
}
CASES = [(name, seed) for name, executor in EXECUTORS.items() for seed in range(executor.seeds)]


def oracle(params, inputs):
    """Return the efforts of scalar controllers, one per env and joint, and the sum of the
    magnitudes of their terms.
    """
    efforts, sizes = np.zeros((2, *inputs.setpoint.shape))
    for (env, joint), pid in np.ndenumerate(
        np.array(scalar_pids(params, inputs.setpoint.shape[1]), object)
    ):
        pid.start(inputs.measurement[0, env, joint])
        for t in range(len(efforts)):
            now = {
                name: None if (x := getattr(inputs, name)) is None else x[t, env, joint]
                for name in RATES
            }
            setpoint, measurement = (
                inputs.setpoint[t, env, joint],
                inputs.measurement[t, env, joint],
            )
            efforts[t, env, joint] = pid.step(setpoint, measurement, DT, **now)
            sizes[t, env, joint] = pid.size
    return efforts, sizes


def check(executor, params, inputs):
    efforts, sizes = oracle(params, inputs)
    found = executor.run(params, inputs)
    error = np.abs(found - efforts) / (1 + np.maximum.accumulate(sizes, axis=0))
    assert error.max() < (1e-12 if executor.dtype == np.float64 else 1e-5)
    if executor.bits:
        np.testing.assert_array_equal(found, by_steps(params, inputs))
    return found


@pytest.mark.parametrize(("name", "seed"), CASES)
def test_efforts_are_those_of_the_law_on_plain_numbers(name, seed, request):
    executor = EXECUTORS[name]
    if executor.run is by_jax and executor.dtype == np.float64:
        request.getfixturevalue("x64")
    params = bp.make_params(JOINTS, **generated_options(seed), dtype=executor.dtype)
    inputs = made_up_inputs()
    if params.non_finite is not None:
        inputs.measurement[5, 1, 0], inputs.setpoint[9, 0] = np.nan, np.inf
    given = GIVEN[seed % len(GIVEN)]
    inputs = Inputs(*inputs[:2], **{each: getattr(inputs, each) for each in given})
    check(executor, params, inputs)


@pytest.mark.parametrize("given", GIVEN, ids=" ".join)
def test_efforts_with_each_option_alone_on_any_inputs(options, given, inputs):
    params = bp.make_params(JOINTS, **options)
    check(
        EXECUTORS["numpy"],
        params,
        Inputs(*inputs[:2], **{each: getattr(inputs, each) for each in given}),
    )


def test_terms_add_up_and_say_what_saturates(options, inputs):
    params = bp.make_params(JOINTS, **options)
    state, saturated = bp.init(params, inputs.measurement[0]), []
    for t in range(20):
        now = params, state, inputs.setpoint[t], inputs.measurement[t], DT
        given = inputs.feedforward[t] if t % 2 else None
        (_, alone), (state, terms) = (
            function(*now, feedforward=given) for function in (bp.step, bp.step_terms)
        )
        assert np.array_equal(alone, terms.effort)
        assert np.array_equal(
            terms.feedforward, np.zeros_like(terms.effort) if given is None else given
        )
        np.testing.assert_allclose(
            terms.p + terms.i + terms.d + terms.feedforward, terms.unsaturated, rtol=1e-12
        )
        assert np.array_equal(terms.saturated, terms.effort != terms.unsaturated)
        assert terms.finite.all()
        saturated.append(terms.saturated)
    if "effort_limit" in options:
        assert 0 < np.mean(saturated) < 1, "the case saturates, and not always"


def test_an_option_with_a_neutral_value_is_off():
    """Params with neutral values have the same structure as params without these options."""
    gains = {"kp": 3.0, "ki": 1.0, "kd": 0.2}
    limits = dict.fromkeys(("effort_limit", "effort_rate_limit", "integral_limit"), np.inf)
    zeros = dict.fromkeys(("derivative_filter_time", "setpoint_weight_derivative", "deadband"), 0.0)
    neutral = bp.make_params(
        JOINTS, **gains, **limits, **zeros, setpoint_weight=1.0, continuous=False
    )
    assert {name for name, leaf in neutral._asdict().items() if leaf is not None} == gains.keys()
