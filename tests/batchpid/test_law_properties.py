"""Properties of the law for all numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from law_cases import DT, ENVS, JOINTS, OPTIONS

import batchpid as bp
from batchpid.law.coefficients import spread

numbers = st.floats(-1e3, 1e3, allow_subnormal=False)
runs = st.tuples(*[npst.arrays(float, (6, ENVS, JOINTS), elements=numbers)] * 3)
cases = st.sampled_from(sorted(OPTIONS))
seeds = st.integers(0, 2**32 - 1)


def roll(params, r, y, ff=None):
    """Return the states and the terms of a run."""
    k, state, states, terms = bp.discretise(params, DT), bp.init(params, y[0]), [], []
    for t in range(len(r)):
        forward = None if ff is None else ff[t]
        state, shown = bp.advance(k, state, r[t], y[t], feedforward=forward)
        states.append(state)
        terms.append(shown)
    return states, terms


def equal_bits(a, b):
    return all(
        (x is None) == (y is None) and (x is None or x.tobytes() == y.tobytes())
        for x, y in zip(a, b, strict=True)
    )


@pytest.mark.parametrize("strategy", ["clamp", "conditional", "back_calculation"])
def test_the_integral_is_bounded_by_anti_windup(strategy):
    """For an error of any duration, by the limits and the other terms."""
    rng, envs = np.random.default_rng(0), 80
    kp, ki, limit = rng.uniform([[0.1]] * 3, [[10], [50], [10]], (3, envs))[..., None]
    options = {"effort_limit": limit, "anti_windup": strategy}
    if strategy == "back_calculation":
        options["tracking_time"] = 0.1
    params = bp.make_params(1, kp, ki, **options)
    r, y = rng.uniform(-3, 3, (2, 300, envs, 1))
    r[:200] = np.abs(r[:200]) + 4
    bounded = np.max([np.abs(state.integral) for state in roll(params, r, y)[0]], axis=0)
    free = limit + 10 * (kp + ki * (DT + options.get("tracking_time", 0.0)))
    assert (bounded <= (limit if strategy == "clamp" else free) * (1 + 1e-9)).all()


@given(cases, runs, st.integers(1, ENVS - 1), st.booleans())
@settings(max_examples=25)
def test_sharding_envs_changes_no_bit(case, run, cut, is_spread):
    params = bp.make_params(JOINTS, **OPTIONS[case])
    whole = bp.init(params, run[1][0])
    shards = (slice(cut), slice(cut, None))
    parts = [bp.init(params.for_envs(rows), run[1][0][rows]) for rows in shards]
    for t in range(len(run[0])):
        whole, terms = bp.advance(
            bp.discretise(params, DT), whole, run[0][t], run[1][t], feedforward=run[2][t]
        )
        for n, rows in enumerate(shards):
            k = bp.discretise(params.for_envs(rows), DT)
            k = spread(k, len(terms.effort[rows])) if is_spread else k
            inputs = [x[t][rows] for x in run]
            parts[n], part = bp.advance(k, parts[n], *inputs[:2], feedforward=inputs[2])
            assert part.effort.tobytes() == terms.effort[rows].tobytes()
            assert equal_bits(parts[n], whole.for_envs(rows))


def test_a_nan_reaches_the_effort_of_its_joint_alone():
    params = bp.make_params(2, 1.0, 1.0, 1.0, effort_limit=3.0, anti_windup="conditional")
    y = np.array([[np.nan, 0.0]])
    _, effort = bp.step(params, bp.init(params, y * 0), np.ones((1, 2)), y, DT)
    assert np.isfinite(effort).tolist() == [[False, True]]


@pytest.mark.parametrize("case", OPTIONS)
@given(runs, npst.arrays(float, (ENVS, JOINTS), elements=st.floats(-0.9, 0.9)), st.booleans())
@settings(max_examples=10)
def test_track_makes_the_next_step_give_the_effort(case, run, share, rates):
    options = OPTIONS[case] | {"ki": OPTIONS[case].get("ki", 0.0)}
    options.pop("deadband", None)
    params = bp.make_params(JOINTS, **options)._replace(integral_min=None, integral_max=None)
    state = roll(params, *run)[0][-1]
    effort = share * np.minimum(1e3 if params.effort_max is None else params.effort_max, 1e3)
    inputs = {"feedforward": run[2][0]}
    if rates:
        inputs |= {"measurement_rate": run[2][1], "setpoint_rate": run[2][2]}
    state = bp.track(params, state, run[0][0], run[1][0], effort, DT, **inputs)
    _, again = bp.step(params, state, run[0][0], run[1][0], DT, **inputs)
    np.testing.assert_allclose(again, effort, rtol=1e-6, atol=1e-6)


def test_a_manual_joint_that_is_tracked_at_every_step_goes_on_without_a_jump():
    params = bp.make_params(JOINTS, 40.0, 5.0, 2.0, derivative_filter_time=0.02)
    y = np.zeros((ENVS, JOINTS))
    state, manual = bp.init(params, y), np.full_like(y, 5.0)
    for _ in range(100):
        y = y + DT  # 1 rad/s, whose derivative the first steps see
        state = bp.track(params, state, np.ones_like(y), y, manual, DT)
    _, effort = bp.step(params, state, np.ones_like(y), y, DT)
    np.testing.assert_allclose(effort, manual)
    _, effort = bp.step(params, state, np.ones_like(y), y + DT, DT)
    assert np.abs(effort - manual).max() < 3.0  # not kd times the speed since the start


@given(runs, st.floats(0, 100))
@settings(max_examples=30)
def test_a_change_of_ki_is_bumpless(run, ki):
    params = bp.make_params(JOINTS, 4.0, 3.0, 0.2)
    state = roll(params, *run)[0][-1]
    before = bp.step(params, state, run[0][0], run[1][0], DT)[1]
    after = bp.step(params.replace(ki=ki), state, run[0][0], run[1][0], DT)[1]
    assert before.tobytes() == after.tobytes()


@settings(max_examples=25)
@given(b=st.floats(0.0, 1.0), seed=st.integers(0, 999), implicit=st.booleans(), turns=st.booleans())
def test_to_begin_and_to_end_with_rates_makes_no_bump(b, seed, implicit, turns):
    """P and I go on from step to step; a rate of 0 is no rate."""
    options = {"gain_units": "mass_matrix", "discretization": "implicit"} if implicit else {}
    params = bp.make_params(3, 170.0, 500.0, 26.0, setpoint_weight=b, continuous=turns, **options)
    k, rng = bp.discretise(params, DT)._replace(gain_units=None), np.random.default_rng(seed)
    y, r, rate = rng.normal(size=(3, 2, 3))
    state, _ = bp.advance(k, bp.init(params, y), r, y, setpoint_rate=rate)
    (with_rate, given), (without, none) = (
        bp.advance(k, state, r, y, setpoint_rate=x) for x in (0 * rate, None)
    )
    for one, other in zip((*with_rate, *given), (*without, *none), strict=True):
        np.testing.assert_array_equal(one, other)
    _, rated = bp.advance(k, state, r, y, setpoint_rate=rate)
    moved = (1 - b) * np.asarray(k.kp) * DT * np.abs(rate) if implicit else 0.0
    assert (np.abs(rated.p - none.p) <= 1.001 * moved + 1e-12 * np.abs(none.p)).all()
    np.testing.assert_array_equal(rated.i, none.i)


@given(cases, runs, npst.arrays(bool, ENVS))
@settings(max_examples=25)
def test_reset_restarts_the_masked_envs_alone(case, run, mask):
    params = bp.make_params(JOINTS, **OPTIONS[case])
    state = roll(params, *run)[0][-1]
    fresh = bp.init(params, run[1][0])
    after = bp.reset(params, state, run[1][0], mask)
    for old, new, start in zip(state, after, fresh, strict=True):
        if old is not None:
            assert np.array_equal(new[mask], start[mask])
            assert np.array_equal(new[~mask], old[~mask])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_decayed_filters_never_hold_denormal_numbers(dtype):
    params = bp.make_params(
        1,
        0.0,
        1.0,
        1.0,
        derivative_filter_time=0.02,
        effort_limit=0.0,
        anti_windup="back_calculation",
        tracking_time=0.02,
        dtype=dtype,
    )
    zero, one = np.zeros((1, 1), dtype), np.ones((1, 1), dtype)
    state, _ = bp.step(params, bp.init(params, zero), zero, one, DT)
    tiny = np.finfo(dtype).tiny
    state = state._replace(
        **{name: getattr(state, name) * tiny**0.9 for name in ("derivative", "integral")}
    )
    for _ in range(400):
        state, _ = bp.step(params, state, one, one, DT)
        for leaf in (state.derivative, state.integral):
            assert leaf == 0 or abs(leaf) >= tiny
    assert abs(state.derivative) < np.sqrt(tiny)


# -- Inputs
# --------------------------------------------------------------------------------------------------

Y = np.zeros((4, 3))
PARAMS = bp.make_params(3, 40.0, 5.0, 2.0, effort_limit=10.0)
STATE = bp.init(PARAMS, Y)


def test_lists_are_arrays():
    given, same = (
        bp.step(PARAMS, bp.init(PARAMS, make(Y)), make(Y + 1), make(Y), DT, feedforward=1)
        for make in (np.ndarray.tolist, np.array)
    )
    np.testing.assert_array_equal(given[1], same[1])
    fresh = bp.reset(PARAMS, given[0], (Y + 2).tolist(), [True, False, False, False])
    np.testing.assert_array_equal(fresh.measurement[:, 0], [2, 0, 0, 0])


def test_jax_names_them_while_it_traces():
    jax = pytest.importorskip("jax")

    @jax.jit
    def step(setpoint, mask):
        return bp.step(PARAMS, bp.reset(PARAMS, STATE, Y, mask), setpoint, Y, DT)[1]

    assert step(np.ones((4, 3)), np.ones(4, bool)).shape == (4, 3)
    with pytest.raises(bp.InvalidArgumentError, match=r"^setpoint: has shape"):
        step(np.ones((4, 2)), np.ones(4, bool))
    with pytest.raises(bp.InvalidArgumentError, match=r"^mask: is int"):
        step(np.ones((4, 3)), np.ones(4, int))
