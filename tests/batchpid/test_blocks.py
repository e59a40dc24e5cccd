"""Steps in blocks on JAX's CPU backend equal plain steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from law_cases import DT, ENVS, GAINS, JOINTS, LIMITED, OPTIONS
from quick_jit import quick_jit

import batchpid as bp
from batchpid import backends
from batchpid.law import blocks
from batchpid.law.blocks import advance_in_blocks

OTHERS = ("p", "per env", "zero effort", "everything")
RATES = ("measurement_rate", "setpoint_rate", "feedforward")


def compare(params, inputs, rows):
    """Assert that steps in blocks, each written over the state before last, equal plain steps."""
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params)
    k = bp.discretise(params, DT)
    blocks = quick_jit(lambda out, *given: advance_in_blocks(k, *given, out=out, rows=rows), donate_argnums=0)
    plain = quick_jit(lambda *given: bp.advance(k, *given))
    expected = state = bp.init(params, jnp.asarray(inputs.measurement[0], jnp.float32))
    out = None
    for t in range(4):
        now = [jnp.asarray(getattr(inputs, n)[t], jnp.float32) for n in ("setpoint", "measurement", *RATES)]
        now[0] = now[0][:1]  # for all envs alike
        expected, terms = plain(expected, *now)
        (new, again), before = blocks(out, state, *now), state
        state, out = new, (before, again)
        np.testing.assert_allclose(again, terms.effort, rtol=1e-5, atol=1e-4)
        assert jax.tree.structure(state) == jax.tree.structure(expected)
        for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(expected), strict=True):
            assert a.shape == (ENVS, JOINTS)
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("case", ["mixed per env", *(pytest.param(case, marks=pytest.mark.slow) for case in OTHERS)])
def test_steps_in_blocks_equal_plain_steps(case, inputs):
    """Four envs in blocks of three: the second block repeats two rows of the first."""
    compare(bp.make_params(JOINTS, **OPTIONS[case], dtype=np.float32), inputs, rows=3)


@pytest.mark.parametrize(
    "rows", [pytest.param(1, marks=pytest.mark.slow), 2, pytest.param(4, marks=pytest.mark.slow), 5]
)
def test_blocks_of_any_size(rows, inputs):
    params = bp.make_params(JOINTS, **LIMITED, anti_windup="back_calculation", dtype=np.float32)
    compare(params, inputs, rows)


@pytest.mark.slow
def test_gradients_through_blocks_equal_plain_gradients(inputs):
    params = bp.make_params(JOINTS, **GAINS, dtype=np.float32)
    r, y = (jnp.asarray(x[0], jnp.float32) for x in (inputs.setpoint, inputs.measurement))

    def total(step, kp, **how):
        k = bp.discretise(jax.tree.map(jnp.asarray, params)._replace(kp=kp), DT)
        return jnp.sum(step(k, bp.init(params, y), r, y, **how)[1])

    kp = jnp.asarray(params.kp)
    slopes = [jax.grad(lambda kp: total(lambda *given: (None, bp.advance(*given)[1].effort), kp))(kp)]
    slopes.append(jax.grad(lambda kp: total(advance_in_blocks, kp, rows=3))(kp))
    assert (slopes[0] != 0).any()
    np.testing.assert_allclose(*slopes, rtol=1e-5)


def test_a_large_batch_is_stepped_in_blocks_with_equal_results(monkeypatch, inputs):
    """Through reset, track and a change of params, after which the overwritten state must not be in use."""
    params = bp.make_params(JOINTS, **LIMITED, setpoint_weight=0.5, anti_windup="back_calculation", dtype=np.float32)
    pids, traced = [], []

    def spy(*inputs, **options):
        traced.append(inputs)
        return advance_in_blocks(*inputs, **options)

    monkeypatch.setattr(blocks, "advance_in_blocks", spy)
    for large in (10**9, ENVS):
        monkeypatch.setattr(backends, "LARGE", large)
        pid, efforts = bp.BatchPID(params, ENVS, DT, "jax"), []
        for t in range(12):
            r, y = inputs.setpoint[t], inputs.measurement[t]
            if t == 4:
                pid.reset(y, np.arange(ENVS) == 1)
            if t == 6:
                pid.track(r, y, np.full_like(y, 0.3))
            if t == 8:
                pid.params = params.replace(derivative_filter_time=0.02)
            efforts.append(pid(r, y, feedforward=inputs.feedforward[t]))
        assert bool(traced) == (large == ENVS)
        pids.append((np.stack(efforts), pid.state))
    np.testing.assert_allclose(pids[0][0], pids[1][0], rtol=1e-5, atol=1e-4)
    for a, b in zip(*(jax.tree.leaves(state) for _, state in pids), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4)


def test_a_large_batch_returns_terms_on_request(monkeypatch):
    monkeypatch.setattr(backends, "LARGE", ENVS)
    pid = bp.BatchPID(bp.make_params(JOINTS, 3.0), ENVS, DT, "jax", terms=True)
    pid(np.ones(JOINTS), np.zeros((ENVS, JOINTS)))
    assert (np.asarray(pid.terms.p) == 3).all()
