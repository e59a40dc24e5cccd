"""States and results have the params' dtype, whatever the dtype of the inputs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from law_cases import DT, ENVS, JOINTS, generated_options
from trees import tree_of

import batchpid as bp
import batchpid.task_space as ts
from batchpid.law import advance_with_mass_matrix, convert_integral
from batchpid.motors import guard as guards

OTHERS = (np.longdouble, np.float32, np.float16, np.int32)


def dtypes(*trees):
    """Return the dtypes of the float arrays in named tuples and arrays."""
    flat = [leaf for tree in trees for leaf in (tree if isinstance(tree, tuple) else (tree,))]
    return {str(leaf.dtype) for leaf in flat if leaf is not None and leaf.dtype.kind == "f"}


def run_of(xp, dtype, options, own):
    """Return all states and results of the law, a guard and motors, on inputs of ``dtype`` under
    params of ``own``.
    """
    rows = np.random.default_rng(0).normal(size=(4, ENVS, JOINTS)) * 3
    r, y, v, u = (xp.asarray(row.astype(dtype)) for row in rows)
    params = bp.make_params(JOINTS, **options, dtype=own)
    state = bp.init(params, y)
    yield state
    yield from bp.step(params, state, r, y, DT)
    stepped, terms = bp.step_terms(
        params, state, r, y, DT, measurement_rate=v, setpoint_rate=v, feedforward=u
    )
    yield from (stepped, terms)
    yield bp.reset(params, stepped, y, xp.asarray(np.arange(ENVS) > 1))
    advanced, terms = bp.advance(bp.discretise(params, DT), state, r, y, v, v, u)
    yield from (advanced, terms.effort)
    if params.ki is not None:
        yield bp.track(params, state, r, y, u)
    matrix = xp.asarray(np.tile(np.eye(JOINTS), (ENVS, 1, 1)).astype(dtype))
    accelerations = bp.make_params(
        JOINTS, 4.0, 2.0, 1.0, gain_units="mass_matrix", effort_limit=1.0, dtype=own
    )
    law = bp.discretise(accelerations.replace(effort_rate_limit=9.0), DT)
    started = bp.init(accelerations.replace(effort_rate_limit=9.0), y)
    yield from (x for x in advance_with_mass_matrix(law, started, r, y, matrix, v, v, v, u)[:1])
    yield convert_integral(
        started, accelerations, accelerations.replace(gain_units="effort"), matrix
    )
    drive = bp.make_params(JOINTS, 4.0, 2.0, 1.0, dtype=own)
    yield from bp.drive_target(drive, bp.init(drive, y), r, y, DT)
    limits = bp.make_guard(JOINTS, rate=1.0, acceleration=5.0, dtype=own)
    yield (guarded := guards.init(limits, y))
    yield guards.advance(limits, guarded, r, DT)[0]
    motors = bp.make_actuators(
        JOINTS, command_delay=0.02, sensor_delay=0.01, lag=0.1, backlash=0.1, dtype=own
    )
    yield (moved := bp.motors.init(motors, y, DT, qvel=v, effort=u))
    yield from bp.motors.deliver(motors, moved, u, y, v, DT)
    yield from bp.motors.measure(motors, moved, y, v, DT)


@given(st.integers(0, 2**31), st.sampled_from(OTHERS), st.sampled_from([np.float64, np.float32]))
@settings(max_examples=20)
def test_numpy(seed, dtype, own):
    for result in run_of(np, dtype, generated_options(seed), own):
        assert dtypes(result) <= {np.dtype(own).name}


@pytest.mark.parametrize(("seed", "dtype"), [(0, np.float32), (1, np.int32)])
def test_jax(seed, dtype, x64):
    jax = pytest.importorskip("jax")
    options = generated_options(seed)
    # traced, which compiles nothing
    results = jax.eval_shape(lambda: [*run_of(jax.numpy, dtype, options, np.float64)])
    for result in results:
        assert dtypes(result) <= {"float64"}


def test_a_controller_keeps_the_precision_that_it_was_built_with(x64):
    jax = pytest.importorskip("jax")
    params = bp.make_params(2, 3.0, ki=1.0)
    pid = bp.BatchPID(params, 1, DT, backend="jax")
    oracle = bp.BatchPID(params, 1, DT)
    for wide in (True, False):
        jax.config.update("jax_enable_x64", wide)
        effort = np.asarray(pid(1.0, np.full((1, 2), 0.1)))
        assert effort.dtype == np.float64
        np.testing.assert_allclose(effort, oracle(1.0, np.full((1, 2), 0.1)), rtol=1e-14)


def test_operational_space():
    tree = tree_of("panda")
    qpos = np.zeros((2, tree.dof), np.longdouble)
    params = ts.make_osc_params(tree, integral_gain=1.0)
    state = ts.init(params, qpos)
    goal = ts.link_poses(tree, qpos, ["panda_hand"])[:, 0].astype(np.longdouble)
    new, terms = ts.osc(
        ts.discretise(params, DT),
        state,
        ts.Tool(tree, "panda_hand"),
        ts.OSCInputs(goal, qpos, qpos),
    )
    assert dtypes(state, new, terms) == {"float64"}
