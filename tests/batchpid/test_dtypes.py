"""States and results have the params' dtype, whatever the dtype of the inputs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from law_cases import DT, ENVS, JOINTS, UNITS, advanced, generated_options, made_up_inputs
from trees import tree_of

import batchpid as bp
import batchpid.task_space as ts
from batchpid.law.pid import advance_drive
from batchpid.motors import guard as guards

OTHERS = (np.longdouble, np.float32, np.float16, np.int32)


def dtypes(*trees):
    """Return the dtypes of the float arrays in named tuples and arrays."""
    flat = [leaf for tree in trees for leaf in (tree if isinstance(tree, tuple) else (tree,))]
    return {
        str(leaf.dtype) for leaf in flat if getattr(getattr(leaf, "dtype", None), "kind", "") == "f"
    }


def run_of(xp, dtype, seed, own):
    """Return all states and results of the law, a guard and motors, on inputs of ``dtype`` under
    params of ``own``.
    """
    units = UNITS[seed % 3]
    params = bp.make_params(JOINTS, **generated_options(seed, units=units), dtype=own)
    names = "measurement_rate", "setpoint_rate", "feedforward"
    more = () if units == "effort" else ("setpoint_acceleration", "mass_matrix")
    inputs = made_up_inputs().given(*names, *more)
    row = inputs.at(9, lambda rows: xp.asarray(rows.astype(dtype)))
    y, v, u = (row[name] for name in ("measurement", "measurement_rate", "feedforward"))
    state = bp.init(params, y)
    yield state
    yield from advanced(params, state, row)
    yield bp.reset(params, state, y, xp.asarray(np.arange(ENVS) > 1))
    if units == "effort":
        yield from bp.advance(bp.discretise(params, DT), state, **row)
    drive = bp.make_params(JOINTS, 4.0, 2.0, 1.0, dtype=own)
    own_rows = (rows.astype(own) for rows in (row["setpoint"], y))  # as the Runner's are
    yield from advance_drive(bp.discretise(drive, DT), bp.init(drive, y), *own_rows)
    limits = bp.make_guard(JOINTS, rate=1.0, acceleration=5.0, dtype=own)
    yield (guarded := guards.init(limits, y))
    yield guards.advance(limits, guarded, row["setpoint"], DT)[0]
    motors = bp.make_actuators(JOINTS, **MOTORS, dtype=own)
    yield bp.motors.init(motors, y, DT, qvel=v, effort=u)


MOTORS = {"command_delay": 0.02, "sensor_delay": 0.01, "lag": 0.1, "backlash": 0.1}


@given(st.integers(0, 2**31), st.sampled_from(OTHERS), st.sampled_from([np.float64, np.float32]))
@settings(max_examples=30)
def test_numpy(seed, dtype, own):
    for result in run_of(np, dtype, seed, own):
        assert dtypes(result) <= {np.dtype(own).name}


@pytest.mark.parametrize(("seed", "dtype"), [(0, np.float32), (1, np.int32)])
def test_jax(seed, dtype, x64):
    jax = pytest.importorskip("jax")
    # traced, which compiles nothing
    for result in jax.eval_shape(lambda: [*run_of(jax.numpy, dtype, seed, np.float64)]):
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
    params = ts.make_osc_params(tree, DT, integral_gain=1.0)
    state = ts.init(params, qpos)
    goal = ts.link_poses(tree, qpos, ["panda_hand"])[:, 0].astype(np.longdouble)
    new, terms = ts.osc(
        params,
        state,
        ts.Tool(tree, "panda_hand"),
        ts.OSCInputs(goal, qpos, qpos),
    )
    assert dtypes(state, new, terms) == {"float64"}
