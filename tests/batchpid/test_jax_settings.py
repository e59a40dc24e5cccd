"""Debugging settings of JAX change no result of BatchPID, and hold in the caller's own programs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax_debugging import SETTINGS, changed

import batchpid as bp


def controller():
    """Return a controller with float32 params."""
    options = {
        "ki": 3.0,
        "kd": 1.0,
        "effort_limit": [1.0, 2.0, 3.0],
        "derivative_filter_time": 0.01,
    }
    return bp.BatchPID(
        bp.make_params(3, [4.0, 5.0, 6.0], dtype=np.float32, **options), 2, 0.01, backend="jax"
    )


def efforts(pid):
    """Return the efforts of calls, resets and changes of params, with NaN among the
    measurements.
    """
    rows, params = [], pid.params
    pid.reset(np.zeros((2, 3)))
    with jax.transfer_guard("allow"), jax.numpy_rank_promotion("allow"):
        ones = jnp.ones((2, 3), jnp.int32)
    for step in range(3):
        measurement = np.full((2, 3), 0.1 * step)
        measurement[1, 0] = np.nan if step == 1 else 0.0
        rows.append(pid([1.0, 0.0, 2.0], measurement, feedforward=ones))
    pid.reset(np.zeros((2, 3)), [True, False])
    pid.track(1.0, np.zeros((2, 3)), ones)
    pid.params = params.replace(kp=7.0)
    rows.append(pid(ones, np.zeros((2, 3)), feedforward=1.0))
    pid.params = params
    assert rows[0].dtype == np.float32
    return np.array(rows)


@pytest.fixture(scope="module")
def pid():
    return controller()


@pytest.mark.parametrize("name", SETTINGS)
def test_no_setting_changes_a_result(pid, name):
    expected = efforts(pid)
    with changed(**{name: SETTINGS[name]}):
        np.testing.assert_array_equal(efforts(pid), expected)


def test_a_controller_keeps_the_precision_that_it_was_built_with(x64):
    params = bp.make_params(2, 3.0, ki=1.0)
    wide = bp.BatchPID(params, 1, 0.01, backend="jax")
    expected = [np.array(wide(1.0, np.full((1, 2), 0.1))) for _ in range(2)]
    assert expected[0].dtype == np.float64
    other = bp.BatchPID(params, 1, 0.01, backend="jax")
    np.testing.assert_array_equal(other(1.0, np.full((1, 2), 0.1)), expected[0])
    with changed(jax_enable_x64=False):
        np.testing.assert_array_equal(other(1.0, np.full((1, 2), 0.1)), expected[1])


def test_a_change_of_settings_compiles_nothing_again(caplog):
    pid = bp.BatchPID(bp.make_params(2, 3.0, dtype=np.float32), 1, 0.01, backend="jax")
    pid(1.0, np.zeros((1, 2)))
    with changed(**SETTINGS), caplog.at_level("WARNING"):
        pid(1.0, np.zeros((1, 2)))
    assert not [record for record in caplog.records if "Compiling" in record.message]


def test_the_callers_own_programs_keep_the_callers_settings():
    pid = bp.BatchPID(bp.make_params(2, 3.0), 1, 0.01, backend="jax")
    with changed(
        jax_debug_nans=True,
        jax_numpy_rank_promotion="raise",
        jax_transfer_guard_host_to_device="disallow",
    ):
        pid(1.0, np.full((1, 2), np.nan))
        assert jax.config.jax_debug_nans
        assert jax.config.jax_numpy_rank_promotion == "raise"
        assert jax.config.jax_transfer_guard_host_to_device == "disallow"
        with jax.transfer_guard("allow"):
            rows = jnp.zeros((1, 2))
            with pytest.raises(FloatingPointError):
                jax.jit(bp.step, static_argnames="dt")(*stepped(rows))


def stepped(rows):
    """Return arguments of bp.step, with a NaN."""
    params = bp.make_params(2, 3.0, ki=1.0, dtype=np.float32)
    return params, bp.init(params, rows), rows, rows * np.float32(np.nan), 0.01
