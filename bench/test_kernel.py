"""Speed of the law alone, for 1 to 2^20 envs of 9 joints, against other kernels.

The law has P, I, filtered D, feedforward, effort limits and back-calculation, in float32.
Compilation is never timed. "native", "numpy" and "jax" are :class:`batchpid.BatchPID`, the first
two with and without the extension; efforts of "native" are written into kept arrays (``out=``). The
bound is "fused by hand": this law alone, with its gains, as one pass over the arrays (numba).
"""

import os
import time
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import simple_pid
from tutorial import SimplePID

import batchpid as bp
from batchpid.native.array_program import SWITCH

numba = pytest.importorskip("numba")
pytestmark = pytest.mark.usefixtures("quick_smoke")

JOINTS, DT = 9, 1 / 2000
GAINS = {"kp": 40.0, "ki": 5.0, "kd": 2.0}
PARAMS = bp.make_params(
    JOINTS,
    **GAINS,
    effort_limit=87.0,
    derivative_filter_time=0.01,
    anti_windup="back_calculation",
    dtype=np.float32,
)
SIZES = [1, 64, 4096, 2**16, 2**20]


def inputs(num_envs, dtype=np.float32):
    """Return setpoint, two measurements to alternate between, and feedforward."""
    rng = np.random.default_rng(0)
    return [rng.normal(size=(num_envs, JOINTS)).astype(dtype) for _ in range(4)]


@pytest.fixture(scope="module", autouse=True)
def devices(most):
    """One JAX device per core. A smoke run shares its process with other tests and keeps the
    devices there are.
    """
    if most.floors:
        jax.config.update("jax_num_cpu_devices", os.cpu_count())


@pytest.fixture(scope="module")
def best(most):
    """Function that returns the least time of a call [s]."""

    def best(call, seconds=0.3):
        call()
        times, until = [], time.perf_counter() + min(seconds, most.seconds)
        while not times or (time.perf_counter() < until or len(times) < min(5, most.rounds)):
            began = time.perf_counter()
            call()
            times.append(time.perf_counter() - began)
        return min(times)

    return best


ROWS = 16
"""Rows of a block of the fused law, which repeats its gains for each."""


@numba.njit(parallel=True)
def _fused(kp, ki_dt, kd, low, high, decay, intake, back, r, y, ff, integral, last, rate, effort):
    """Step blocks of ``kp.size`` numbers."""
    for block in numba.prange((r.size + kp.size - 1) // kp.size):
        at = block * kp.size
        for i in range(min(kp.size, r.size - at)):
            e = r[at + i] - y[at + i]
            v = decay[i] * rate[at + i] + intake[i] * (last[at + i] - y[at + i])
            u = kp[i] * e + integral[at + i] + kd[i] * v + ff[at + i]
            s = min(max(u, low[i]), high[i])
            integral[at + i] += ki_dt[i] * e + back[i] * (s - u)
            last[at + i], rate[at + i], effort[at + i] = y[at + i], v, s


def native_step(num_envs, dtype=np.float32):
    """Return a call of BatchPID by the native extension, which writes over the efforts of the call
    before last.
    """
    r, y0, y1, ff = inputs(num_envs, dtype)
    pid, turn = bp.BatchPID(PARAMS.replace(dtype=dtype), num_envs, DT), [y0, y1]
    outs = [np.empty_like(r), np.empty_like(r)]
    if not pid.native:
        pytest.skip("there is no extension")

    def call():
        turn.reverse()
        outs.reverse()
        return pid(r, turn[0], feedforward=ff, out=outs[0])

    return call


def numpy_step(num_envs, dtype=np.float32):
    r, y0, y1, ff = inputs(num_envs, dtype)
    with mock.patch.dict(os.environ, {SWITCH: "0"}):
        pid, turn = bp.BatchPID(PARAMS.replace(dtype=dtype), num_envs, DT), [y0, y1]

    def call():
        turn.reverse()
        return pid(r, turn[0], feedforward=ff)

    return call


def jax_step(num_envs):
    """Return a call of BatchPID on device arrays that waits for the effort."""
    r, y0, y1, ff = (jnp.asarray(x) for x in inputs(num_envs))
    pid, turn = bp.BatchPID(PARAMS, num_envs, DT, "jax"), [y0, y1]

    def call():
        turn.reverse()
        return pid(r, turn[0], feedforward=ff).block_until_ready()

    return call


def fused_step(num_envs, dtype=np.float32):
    r, y0, y1, ff = (array.ravel() for array in inputs(num_envs, dtype))
    k = bp.discretise(PARAMS.replace(dtype=dtype), DT)
    gains = (k.kp, k.ki_dt, k.kd, k.effort_min, k.effort_max, k.decay, k.intake * k.per_dt)
    rows = [np.tile(np.asarray(x, dtype).ravel(), ROWS) for x in (*gains, k.tracking)]
    state = [np.zeros_like(r), y1.copy(), np.zeros_like(r)]
    effort, turn = np.empty_like(r), [y0, y1]

    def call():
        turn.reverse()
        _fused(*rows, r, turn[0], ff, *state, effort)
        return effort.reshape(num_envs, JOINTS)

    return call


def scalar_step(make):
    """Return a loop over one Python object per joint, as in SAPIEN's tutorial."""

    def build(num_envs):
        r, y0, y1, ff = (x.astype(float).ravel().tolist() for x in inputs(num_envs))
        compute, turn = [make() for _ in r], [y0, y1]

        def call():
            turn.reverse()
            return [f(a, b) + c for f, a, b, c in zip(compute, r, turn[0], ff, strict=True)]

        return call

    return build


def tutorial():
    pid = SimplePID(*GAINS.values())
    return lambda r, y: pid.compute(r - y, DT)


def simple():
    pid = simple_pid.PID(*GAINS.values(), sample_time=None, output_limits=(-87, 87))

    def compute(r, y):
        pid.setpoint = r
        return pid(y, dt=DT)

    return compute


KERNELS = {
    "native": native_step,
    "numpy": numpy_step,
    "jax": jax_step,
    "fused by hand": fused_step,
}
SCALARS = {"tutorial": scalar_step(tutorial), "simple-pid": scalar_step(simple)}


@pytest.fixture(scope="module")
def found():
    """First effort and least time [s] of the tests so far, by number of envs and kernel."""
    return {}


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("num_envs", SIZES)
def test_step(benchmark, compare, most, best, found, kernel, num_envs):
    num_envs = min(num_envs, most.rows)
    call = KERNELS[kernel](num_envs)
    first = np.array(call())
    assert np.isfinite(first).all()
    assert not np.array_equal(first, call()), "the efforts follow the measurements"
    rounds = max(5, min(5000, int(0.3 / best(call, 0.1))))
    benchmark.pedantic(call, rounds=min(rounds, most.rounds), warmup_rounds=2)
    least = benchmark.stats.stats.min
    benchmark.extra_info |= {
        "us per step": round(1e6 * least, 2),
        "ns per env": round(1e9 * least / num_envs, 2),
        "device": str(jax.devices()[0]) if kernel.startswith("jax") else f"{os.cpu_count()} CPUs",
    }
    others = {
        over: figures
        for (envs, over), figures in found.items()
        if envs == num_envs and over != kernel
    }
    for over, (effort, seconds) in others.items():
        np.testing.assert_allclose(first, effort, rtol=1e-3, atol=1e-2)
        compare(f"law, {num_envs} envs", kernel, over, seconds / least)
    found[num_envs, kernel] = first, least


@pytest.mark.parametrize(("num_envs", "threads"), [(64, 1), (4096, 1), (2**20, 1), (2**20, 2)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_native_against_numpy_and_a_fused_pass(
    benchmark,
    compare,
    most,
    dtype,
    num_envs,
    threads,
    monkeypatch,
):
    """Least times of rounds in turn: the law by the extension and by NumPy, and fused by hand on as
    many threads.
    """
    num_envs, threads = min(num_envs, most.rows), min(threads, numba.config.NUMBA_NUM_THREADS)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(threads))
    calls = {
        "native": native_step(num_envs, dtype),
        "numpy": numpy_step(num_envs, dtype),
        "fused": fused_step(num_envs, dtype),
    }
    times = {name: [] for name in calls}
    repeat = max(1, min(most.ticks, 2**17 // num_envs))

    def rounds():
        for name, call in calls.items():
            began = time.perf_counter()
            for _ in range(repeat):
                call()
            times[name].append((time.perf_counter() - began) / repeat)

    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        rounds()
        for each in times.values():
            each.clear()  # compilation
        benchmark.pedantic(rounds, rounds=min(10, most.rounds))
    finally:
        numba.set_num_threads(before)
    assert calls["native"]().tobytes() == calls["numpy"]().tobytes()
    least = {name: min(each) for name, each in times.items()}
    benchmark.extra_info |= {
        f"us, {name}": round(1e6 * seconds, 2) for name, seconds in least.items()
    }
    setup = f"law, {num_envs} envs, {np.dtype(dtype)}, {threads} threads"
    compare(setup, "native", "numpy", least["numpy"] / least["native"])
    compare(setup, "native", "fused by hand", least["fused"] / least["native"])


@pytest.mark.parametrize("kernel", SCALARS)
@pytest.mark.parametrize("num_envs", [1, 64, 4096])
def test_scalar_loop(benchmark, most, kernel, num_envs):
    """The time is proportional to the envs, so that the ns per env hold for 2^20 too."""
    num_envs = min(num_envs, most.rows)
    call = SCALARS[kernel](num_envs)
    benchmark.pedantic(call, rounds=min(max(3, 4096 // num_envs), most.rounds), warmup_rounds=1)
    benchmark.extra_info["ns per env"] = round(1e9 * benchmark.stats.stats.min / num_envs, 1)


def test_against_the_scalar_loop_in_one_run(benchmark, compare, most, best):
    """JAX at 2^20 x 9 takes less than a tenth of the time of the tutorial's scalar loop, per
    env.
    """
    few, many = min(4096, most.rows), min(2**20, most.rows)
    slow = best(SCALARS["tutorial"](few)) / few
    benchmark.pedantic(jax_step(many), rounds=min(5, most.rounds), warmup_rounds=2)
    ratio = slow / (benchmark.stats.stats.min / many)
    benchmark.extra_info["times the scalar loop"] = round(ratio)
    compare(f"law, {many} envs", "jax", "tutorial's scalar loop", ratio, least=10)


@pytest.mark.parametrize("num_envs", [64, 4096])
def test_scan(benchmark, most, num_envs):
    """Time per step of jax.lax.scan over a closed loop: the law on a double integrator."""
    num_envs, steps, params = (
        min(num_envs, most.rows),
        2000 if most.floors else 500,
        jax.tree.map(jnp.asarray, PARAMS),
    )
    r, y, _, ff = (jnp.asarray(x) for x in inputs(num_envs))

    @jax.jit
    def run(params, y):
        def body(carry, _):
            state, y, v = carry
            state, effort = bp.step(params, state, r, y, DT, feedforward=ff)
            v = v + effort * DT
            return (state, y + v * DT, v), None

        return jax.lax.scan(body, (bp.init(params, y), y, jnp.zeros_like(y)), None, length=steps)[
            0
        ][1]

    assert np.abs(run(params, y) - y).max() > 0.01, "the loop moved"
    benchmark.pedantic(lambda: run(params, y).block_until_ready(), rounds=min(5, most.rounds))
    benchmark.extra_info["us per step"] = round(1e6 * benchmark.stats.stats.min / steps, 3)


@pytest.mark.parametrize("kernel", ["numpy", "jax"])
def test_settled_filters_cost_the_same(benchmark, compare, most, kernel):
    """Steps after 10,000 at rest, with decayed filters, cost no more than fresh ones; blocks of
    both alternate.
    """
    y = np.zeros((64, JOINTS), np.float32)
    r = np.zeros_like(y)
    pids = {name: bp.BatchPID(PARAMS, 64, DT, kernel) for name in ("moving", "settled")}
    for pid in pids.values():
        pid(r, y + 1)
    for _ in range(min(10_000, 50 * most.ticks)):
        pids["settled"](r, y)
    moving = [y + 0.1, y - 0.1]
    ratios = []

    def block(pid, measurements):
        began = time.perf_counter()
        for _ in range(min(250, most.ticks)):
            for measurement in measurements:
                effort = pid(r, measurement)
        np.asarray(effort)
        return time.perf_counter() - began

    def both():
        ratios.append(block(pids["moving"], moving) / block(pids["settled"], [y, y]))

    benchmark.pedantic(both, rounds=min(15, most.rounds), warmup_rounds=2)
    assert np.abs(np.asarray(pids["settled"].state.derivative)).max() < 1e-10
    ratio = float(np.median(ratios))
    benchmark.extra_info["settled / moving"] = round(1 / ratio, 3)
    compare("law, 64 envs", f"{kernel}, settled filters", "moving ones", ratio, least=1 / 1.2)
