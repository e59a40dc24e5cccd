"""Plans: chunks of a slow policy become setpoints, by the formulas of ACT and linear
interpolation, without a step at a seam, within their limits; the same in NumPy, JAX and C.
"""

import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_programs import COMPILERS, compiled
from quick_jit import quick_jit

import batchpid as bp
from batchpid.export import to_c

PERIOD, DT = 1 / 30, 1 / 2000
PLANS = {
    "align": {"fade": [0.5, 1.0, 0.3], "latest": [2]},
    "newest": {},
    "ensemble": {"weight": 0.1, "latest": [0], "rate": 2.0, "acceleration": 15.0},
    "linear": {"blend": "newest", "interpolation": "linear", "acceleration": [15.0, 9.0, np.inf]},
    "hold": {"blend": "newest", "interpolation": "hold"},
}


def made(name, joints=3, horizon=8, **options):
    chosen = {"blend": name, "period": PERIOD, "horizon": horizon} | PLANS.get(name, {})
    return bp.make_plan(joints, **chosen | options)


def run(plan, times, chunks, start=0.0):
    """Return setpoints, rates and accelerations (3, times, joints) and the last state; ``chunks``
    are pairs (chunk, time) by the index of the sample that they follow.
    """
    state, rows = bp.plan.init(plan, np.zeros((1, plan.num_joints)) + start), []
    for index, t in enumerate(times):
        state, *row = bp.plan.sample(plan, state, t)
        rows.append(np.concatenate(row))
        for chunk, time in chunks.get(index, ()):
            state = bp.plan.add(plan, state, np.asarray(chunk)[None], time)
    return np.moveaxis(np.array(rows), 1, 0), state


def aligned(chunks, plan, ticks):
    """Return the rows of the plan (ticks, joints) by the formulas of batchpid/plan/sampling.py;
    chunk k is for the times from k + 1 on.
    """
    knots, rates = np.zeros((2, ticks + plan.horizon, plan.num_joints))
    rows, fade = np.arange(plan.horizon), plan.fade[0, 0]
    for k, ((chunk, _),) in chunks.items():
        offset, slope = knots[k + 1] - chunk[0], rates[k + 1] - (chunk[1] - chunk[0]) / PERIOD
        time = PERIOD * rows[:, None]
        rise = np.minimum(5 * time / fade, 1)
        eased = (offset + fade * slope) * rise * (1 - rise) ** 2 / 5
        blended = chunk + offset * np.maximum(1 - time / fade, 0) + eased
        knots[k + 1 :], rates[k + 1 :] = blended[-1], 0.0
        knots[k + 1 + rows] = blended
        rates[k + 1 + rows] = np.gradient(blended, PERIOD, axis=0)
    return knots[1:ticks]


@pytest.mark.parametrize("seed", range(20))
def test_ensembles_are_those_of_act_and_chunks_are_aligned_by_the_formulas(seed):
    rng = np.random.default_rng(seed)
    weight, horizon = rng.uniform(0, 1), int(rng.integers(2, 9))
    chunks = {k: [(rng.normal(size=(horizon, 3)), (k + 1) * PERIOD)] for k in range(30)}
    kept = {k: chunk for k, chunk in chunks.items() if k == 0 or rng.random() < 0.6}
    acts = np.zeros((29, 3))
    for k in range(29):
        rows = [entry[0][0][k - at] for at, entry in kept.items() if 0 <= k - at < horizon]
        weights = np.exp(-weight * np.arange(len(rows)))
        acts[k] = weights @ rows / weights.sum() if rows else acts[k - 1]
    bare = {"horizon": horizon, "latest": (), "rate": None, "acceleration": None}
    ensemble = made("ensemble", weight=weight, **bare)
    offset = made("align", fade=rng.uniform(0.2, 1.5), **bare)
    for plan, expected in ((ensemble, acts), (offset, aligned(kept, offset, 30))):
        (setpoint, _, _), _ = run(plan, PERIOD * np.arange(30), kept)
        np.testing.assert_allclose(setpoint[1:], expected, atol=1e-6)


def test_single_rows_in_straight_lines_are_a_linear_interpolator():
    actions = np.random.default_rng(0).normal(size=(20, 3))
    plan = made("newest", interpolation="linear")
    times = PERIOD / 3 * np.arange(61)
    chunks = {3 * k: [(actions[k : k + 1], PERIOD * k)] for k in range(20)}
    (setpoint, _, _), _ = run(plan, times, chunks)
    before = np.vstack([np.zeros((1, 3)), actions[:-1]])
    thirds = np.arange(1, 4)[None, :, None] / 3
    expected = before[:, None] + thirds * (actions - before)[:, None]
    np.testing.assert_allclose(setpoint[1:], expected.reshape(60, 3), atol=1e-12)


@pytest.mark.parametrize("name", ["align", "newest", "ensemble"])
def test_a_seam_has_no_step_and_no_dip(name):
    def reference(t):
        return 0.5 * np.sin(2.0 * t + np.arange(3))

    plan = made(name, horizon=16, rate=None, acceleration=None)
    state = bp.plan.init(plan, reference(0.0)[None])
    for index in range(1500):
        t = index * 4 * DT
        if index % 100 == 0:
            before = bp.plan.sample(plan, state, t)
            chunk = reference(t + PERIOD * np.arange(16)[:, None])
            state = bp.plan.add(plan, before[0], chunk[None], t)
            after = bp.plan.sample(plan, state, t)
            np.testing.assert_allclose(after[1:3], before[1:3], atol=1e-9)
        state, _, rate, _ = bp.plan.sample(plan, state, t)
        speed = np.cos(2.0 * t + np.arange(3))
        fast = (np.abs(speed) > 0.3) & (t > 1.0)
        if name != "align":  # it follows late for a second
            assert (np.abs(rate[0])[fast] > 0.95 * np.abs(speed)[fast]).all()
    assert state.starved.max() == 0


@pytest.mark.parametrize("frequency", [60, 30])
def test_single_rows_are_followed_within_the_limits_without_a_stop(frequency):
    plan = made("newest", joints=1, period=1 / frequency, rate=3.0, acceleration=15.0)
    chunks = {
        int(k / frequency / DT): [(np.full((1, 1), 0.02 * (k + 1)), k / frequency)]
        for k in range(frequency)
    }
    times = DT * np.arange(1, 2001)
    (setpoint, rate, _), _ = run(plan, times, chunks)
    assert np.abs(np.diff(setpoint[:, 0], 2)).max() <= 15.0 * DT**2 * (1 + 1e-6)
    assert (rate[20:, 0] > 0).all()
    assert abs(setpoint[-1, 0] - 0.02 * frequency) < 0.02
    np.testing.assert_allclose(np.diff(setpoint[:, 0]) / DT, rate[1:, 0], atol=0.05)


def test_without_a_chunk_it_stops_within_the_limits_and_resumes_without_a_step():
    plan = made("newest", joints=1, horizon=16, rate=1.0, acceleration=9.0)
    ramp = 0.8 * PERIOD * np.arange(16)[:, None]
    times = DT * np.arange(5000)
    # The second chunk comes one second after the end of the first one.
    end = int(15 * PERIOD / DT)
    chunks = {0: [(ramp, 0.0)], end + 2000: [(ramp + 0.3, times[end + 2000])]}
    (setpoint, rate, _), _ = run(plan, times, chunks)
    stop = end + np.argmax(rate[end:, 0] <= 0)
    assert 0 < (stop - end) * DT <= rate[end, 0] / 9.0 + DT
    np.testing.assert_allclose(setpoint[end + 1999], ramp[-1], atol=1e-9)
    assert np.abs(np.diff(setpoint[:, 0])).max() <= 1.0 * DT * (1 + 1e-9)


def stream(seed, plan, steps):
    """Yield irregular samples (None, t) and chunks (chunk, time) of two envs."""
    rng, t = np.random.default_rng(seed), np.zeros(2)
    for _ in range(steps):
        if rng.random() < 0.05:
            rows = int(rng.integers(1, plan.horizon + 1))
            chunk = 0.05 * np.cumsum(rng.normal(size=(2, rows, plan.num_joints)), axis=1)
            yield chunk.astype(plan.dtype), (t - rng.uniform(-0.02, 0.15)).astype(plan.dtype)
        t = t + rng.exponential(1e-3, 2) * (rng.random() < 0.95)
        yield None, t.astype(plan.dtype)


def samples(plan, entries, add, sample, state):
    rows = []
    for chunk, t in entries:
        if chunk is None:
            state, *row = sample(plan, state, t)
            rows.append(np.array(row))
        else:
            state = add(plan, state, chunk, t)
    return np.array(rows)


@pytest.mark.parametrize(("name", "alone"), [*((name, True) for name in PLANS), ("align", False)])
def test_jax_agrees_with_times_of_each_env(name, alone, x64):
    """One robot at a time, under vmap, or all envs."""
    plan = made(name)
    # Chunks of two lengths alone: each is compiled.
    entries = [
        (chunk if chunk is None or chunk.shape[1] == plan.horizon else chunk[:, :1], t)
        for chunk, t in stream(2, plan, 100)
    ]
    start = np.zeros((2, 3))
    found = samples(plan, entries, bp.plan.add, bp.plan.sample, bp.plan.init(plan, start))
    add, sample, init = bp.plan.add, bp.plan.sample, bp.plan.init
    if alone:
        start = start[:, None]
        entries = [(None if chunk is None else chunk[:, None], t[:, None]) for chunk, t in entries]
        init = jax.vmap(init, (None, 0))
        add, sample = jax.vmap(add, (None, 0, 0, 0)), jax.vmap(sample, (None, 0, 0))
    # A plan is a constant: its horizon is the length of the arrays.
    state = init(plan, jnp.asarray(start))
    shown = samples(plan, entries, quick_jit(add), quick_jit(sample), state)
    np.testing.assert_allclose(shown.reshape(found.shape), found, atol=1e-8)


PROGRAM = """#include <stdio.h>
{header}
int main(void) {{
  batchpid_plan plan;
  {t} zero[{n}] = {{0}}, head[2], chunk[64 * {n}], setpoint[{n}], rate[{n}];
  batchpid_plan_init(&plan, zero, 0);
  while (fread(head, sizeof head, 1, stdin) == 1) {{
    if (head[0] > 0) {{
      if (fread(chunk, sizeof({t}) * {n}, (size_t)head[0], stdin) != (size_t)head[0]) return 1;
      batchpid_add_chunk(&plan, chunk, (int)head[0], head[1]);
    }} else {{
      batchpid_sample(&plan, head[1], setpoint, rate);
      fwrite(setpoint, sizeof setpoint, 1, stdout);
      fwrite(rate, sizeof rate, 1, stdout);
    }}
  }}
  return 0;
}}
"""


@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
@pytest.mark.parametrize("steps", [1500, pytest.param(1_000_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", PLANS)
def test_c_computes_the_same_bits(name, dtype, steps, tmp_path):
    plan = made(name, dtype=dtype)
    header, (said,) = to_c(bp.make_params(3, 1.0, kd=0.1, dtype=dtype), DT, plan=plan)
    assert "acceleration" in said
    kind = "double" if dtype == np.float64 else "float"
    binary = compiled(tmp_path, PROGRAM.format(header=header, t=kind, n=3), "-std=c99", "-O2")
    entries = [
        (chunk if chunk is None else chunk[:1], t[:1]) for chunk, t in stream(3, plan, steps)
    ]
    state = bp.plan.init(plan, np.zeros((1, 3), dtype))
    found = samples(plan, entries, bp.plan.add, bp.plan.sample, state)[:, :2, 0]
    parts = []
    for chunk, t in entries:
        parts += [
            [0 if chunk is None else chunk.shape[1], t[0]],
            [] if chunk is None else chunk.ravel(),
        ]
    data = np.concatenate(parts).astype(dtype).tobytes()
    ran = subprocess.run([binary], input=data, capture_output=True, check=True)
    np.testing.assert_array_equal(np.frombuffer(ran.stdout, dtype).reshape(-1, 2, 3), found)


@pytest.mark.parametrize("name", PLANS)
def test_a_file_keeps_a_plan(name, tmp_path):
    plan = made(name)
    bp.save_plan(tmp_path / "plan.yaml", plan, ["a", "b", "c"])
    read, joints = bp.load_plan(tmp_path / "plan.yaml")
    assert (joints, str(read)) == (["a", "b", "c"], str(plan))
    jax.tree.map(np.testing.assert_array_equal, read, plan)


def test_a_chunk_longer_than_the_horizon_is_refused():
    plan = made("align")
    with pytest.raises(bp.InvalidArgumentError, match="chunk"):
        bp.plan.add(plan, bp.plan.init(plan, np.zeros((1, 3))), np.zeros((1, 9, 3)), 0.0)
