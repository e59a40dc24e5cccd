"""Every executor of the law agrees with a scalar controller (scalar_pid.py), for params of any
combination of options: NumPy, JAX, BatchPID on both and by its native extension, and exported C.
Native code and C are bit-identical to NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple
from unittest import mock

import jax
import numpy as np
import pytest
from c_programs import COMPILERS, RESET
from law_cases import (
    DRIVE_LACKS,
    DT,
    JOINTS,
    UNITS,
    advanced,
    by_c,
    by_steps,
    generated_options,
    made_up_inputs,
)
from quick_jit import quick_jit
from scalar_pid import scalar_pids, step_of_robot

import batchpid as bp
from batchpid.arrays.trees import mapped
from batchpid.law.pid import advance_drive

GIVEN = [
    (),
    ("measurement_rate", "setpoint_rate", "feedforward"),
    ("measurement_rate",),
    ("setpoint_rate",),
    ("measurement_rate", "setpoint_rate"),
    ("feedforward",),
]


def by_jax(params, inputs):
    return by_steps(params, inputs, quick_jit(advanced), jax.numpy.asarray)


def by_controller(params, inputs, backend="numpy"):
    """Return the efforts of a BatchPID; arrays of the caller are overwritten after each call, and
    what it has been given does not change.
    """
    own = mapped(np.copy, params)
    pid = bp.BatchPID(own, inputs.setpoint.shape[1], DT, backend)
    overwrite(own)
    efforts, held = [], []
    for at in range(len(inputs.setpoint)):
        row = inputs.at(at, lambda rows: rows.astype(params.dtype))
        if at == RESET:
            pid.reset(row["measurement"])
        efforts.append(pid(**row))
        overwrite(row.values())
        assert efforts[-1].dtype == params.dtype
        if at % 3 == 0 and backend == "numpy":
            held += [(leaf, leaf.copy()) for leaf in (*pid.state, efforts[-1]) if leaf is not None]
    for leaf, before in held:
        np.testing.assert_array_equal(leaf, before)
    return np.array(efforts, float)


def overwrite(arrays):
    for rows in arrays:
        if isinstance(rows, np.ndarray):
            rows[...] = 77


def by_numpys_controller(params, inputs):
    with mock.patch.dict("os.environ", {"BATCHPID_NATIVE": "0"}):
        return by_controller(params, inputs)


def by_jaxs_controller(params, inputs):
    """Return the efforts of BatchPID with backend "jax", which has all of JAX's optimisations."""
    return by_controller(params, inputs, "jax")


def by_drive(params, inputs):
    """Return the efforts of PD drives whose targets the integral moves."""
    k = bp.discretise(params, DT)

    def step(params, state, row):
        state, target = advance_drive(k, state, **row)
        effort = params.kp * (target - row["measurement"]) + row.get("feedforward", 0.0)
        if params.kd is not None:
            effort = effort + params.kd * (row.get("setpoint_rate", 0.0) - row["measurement_rate"])
        low, high = params.effort_min, params.effort_max
        return state, np.clip(effort, -np.inf if low is None else low, high)

    return by_steps(params, inputs, step)


class Executor(NamedTuple):
    """Function that returns the efforts (steps, envs, joints) of params under inputs, and its
    properties.
    """

    run: Callable[..., np.ndarray]
    dtype: Any = np.float64
    units: tuple[str, ...] = UNITS
    seeds: int = 6
    """Number of generated params to test, for each of the units."""
    bits: bool = True
    """Whether results are bit-identical to NumPy's."""
    keeps: bool = True
    """Whether its reset in between keeps the integral."""


ALONE = UNITS[:1]
EXECUTORS = {
    "numpy": Executor(by_steps, seeds=12),
    "numpy float32": Executor(by_steps, np.float32),
    "controller": Executor(by_numpys_controller, units=ALONE, seeds=12, keeps=False),
    "native controller": Executor(by_controller, units=ALONE, seeds=12, keeps=False),
    "native controller float32": Executor(by_controller, np.float32, ALONE, keeps=False),
    "drive": Executor(by_drive, units=ALONE, seeds=12, bits=False),
    "c": Executor(by_c, seeds=2),
    "c float32": Executor(by_c, np.float32, seeds=2),
    "jax": Executor(by_jax, seeds=2, bits=False),
    "jax float32": Executor(by_jax, np.float32, seeds=1, bits=False),
    "jax controller": Executor(by_jaxs_controller, np.float32, ALONE, 2, bits=False, keeps=False),
}
CASES = [
    (name, units, seed)
    for name, executor in EXECUTORS.items()
    for units in executor.units
    for seed in range(executor.seeds)
]


def oracle(params, inputs, keep=True):
    """Return the efforts of scalar controllers, one per env and joint, and the sum of the
    magnitudes of their terms.
    """
    efforts, sizes = np.zeros((2, *inputs.setpoint.shape))
    for env, pids in enumerate(scalar_pids(params, inputs.setpoint.shape[1])):
        for at in range(len(efforts)):
            now = {name: rows[env] for name, rows in inputs.at(at).items()}
            matrix = now.pop("mass_matrix", None)
            rows = [
                {name: row[joint].item() for name, row in now.items()} for joint in range(len(pids))
            ]
            if at in (0, RESET):
                for pid, row in zip(pids, rows, strict=True):
                    pid.start(row["measurement"], pid.integral if at and keep else 0.0)
            if matrix is None:
                efforts[at, env] = [
                    pid.step(dt=DT, **row) for pid, row in zip(pids, rows, strict=True)
                ]
                sizes[at, env] = [pid.size for pid in pids]
            else:
                efforts[at, env] = step_of_robot(pids, DT, matrix, rows)
                demand = [pid.size for pid in pids]
                sizes[at, env] = np.abs(matrix) @ demand + sum(np.abs(now.get("feedforward", [0])))
    return efforts, sizes


def check(executor, params, inputs):
    keep = executor.keeps
    found, expected = executor.run(params, inputs), by_steps(params, inputs, keep=keep)
    envs = found.shape[1]
    if executor.bits:
        np.testing.assert_array_equal(found, expected[:, :envs])
    expected, sizes = oracle(params, inputs, keep)
    error = np.abs(found - expected[:, :envs])
    size = 1 + np.maximum.accumulate(sizes, axis=0)[:, :envs]
    assert (error / size).max() < (1e-12 if executor.dtype == np.float64 else 1e-5)


def check_generated(executor, units, seed):
    options, given = generated_options(seed, units=units), {*GIVEN[seed % len(GIVEN)]}
    if executor.run is by_drive:
        options = {name: each for name, each in options.items() if name not in DRIVE_LACKS}
        given |= {"measurement_rate"}
    params = bp.make_params(JOINTS, **options, dtype=executor.dtype)
    inputs = made_up_inputs()
    more = () if units == "effort" else ("mass_matrix",)
    if more and executor.run is not by_c:  # it has no input for an acceleration
        more += ("setpoint_acceleration",)
    check(executor, params, inputs.given(*given, *more))


@pytest.mark.parametrize(("name", "units", "seed"), CASES)
def test_efforts_are_those_of_the_law_on_plain_numbers(name, units, seed, request):
    executor = EXECUTORS[name]
    if executor.run is by_jax and executor.dtype == np.float64:
        request.getfixturevalue("x64")
    if executor.run is by_c and not COMPILERS:
        pytest.skip("no C compiler")
    check_generated(executor, units, seed)


def test_every_field_of_params_is_tried():
    """A measured rate that is asked for is an input, and not an effect."""
    tried = set()
    for units in UNITS:
        for seed in range(6):
            params = bp.make_params(JOINTS, **generated_options(seed, units=units))
            tried |= {name for name, leaf in params._asdict().items() if leaf is not None}
    assert tried == {*bp.PIDParams._fields} - {"measurement_rate"}


@pytest.mark.parametrize("given", GIVEN, ids=" ".join)
def test_efforts_with_each_option_alone_on_any_inputs(options, given, inputs):
    check(EXECUTORS["numpy"], bp.make_params(JOINTS, **options), inputs.given(*given))


def test_terms_add_up_and_say_what_saturates(options, inputs):
    params = bp.make_params(JOINTS, **options)
    state, saturated = bp.init(params, inputs.measurement[0]), []
    for t in range(20):
        now = params, state, inputs.setpoint[t], inputs.measurement[t], DT
        given = inputs.feedforward[t] if t % 2 else None
        _, alone = bp.step(*now, feedforward=given)
        k = bp.discretise(params, DT)
        state, terms = bp.advance(k, *now[1:4], feedforward=given)
        assert np.array_equal(alone, terms.effort)
        assert np.array_equal(terms.feedforward, 0.0 if given is None else given)
        np.testing.assert_allclose(
            terms.p + terms.i + terms.d + terms.feedforward, terms.unsaturated, rtol=1e-12
        )
        saturated.append(terms.effort != terms.unsaturated)
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
