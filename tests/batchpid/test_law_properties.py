"""Properties of the law for all numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from law_cases import DT, ENVS, JOINTS, LIMITED, OPTIONS

import batchpid as bp

numbers = st.floats(-1e3, 1e3, allow_subnormal=False)
runs = st.tuples(*[npst.arrays(float, (6, ENVS, JOINTS), elements=numbers)] * 3)
cases = st.sampled_from(sorted(OPTIONS))
seeds = st.integers(0, 2**32 - 1)


def roll(params, r, y, ff=None):
    """Return the states and the terms of a run."""
    state, states, terms = bp.init(params, y[0]), [], []
    for t in range(len(r)):
        state, shown = bp.step_terms(
            params, state, r[t], y[t], DT, feedforward=None if ff is None else ff[t]
        )
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
def test_sharding_envs_changes_no_bit(case, run, cut, spread):
    params = bp.make_params(JOINTS, **OPTIONS[case])
    whole = bp.init(params, run[1][0])
    shards = (slice(cut), slice(cut, None))
    parts = [bp.init(params.for_envs(rows), run[1][0][rows]) for rows in shards]
    for t in range(len(run[0])):
        whole, terms = bp.advance(
            bp.discretise(params, DT), whole, run[0][t], run[1][t], feedforward=run[2][t]
        )
        for n, rows in enumerate(shards):
            k = bp.discretise(
                params.for_envs(rows), DT, len(terms.effort[rows]) if spread else None
            )
            inputs = [x[t][rows] for x in run]
            parts[n], part = bp.advance(k, parts[n], *inputs[:2], feedforward=inputs[2])
            assert part.effort.tobytes() == terms.effort[rows].tobytes()
            assert equal_bits(parts[n], whole.for_envs(rows))


@given(
    runs,
    st.sampled_from([np.nan, np.inf, -np.inf]),
    st.integers(0, 2),
    st.sampled_from(["zero", "hold"]),
)
@settings(max_examples=40)
def test_a_non_finite_input_affects_its_joint_alone(run, bad, which, policy):
    """Its state is kept, its effort is 0 or the last, the mask marks it, and the others are
    bit-identical.
    """
    params = bp.make_params(
        JOINTS,
        **LIMITED,
        anti_windup="back_calculation",
        derivative_filter_time=0.02,
        non_finite=policy,
    )
    hurt = [x.copy() for x in run]
    hurt[which][3, 1, 2] = bad
    (well, well_terms), (ill, ill_terms) = roll(params, *run), roll(params, *hurt)
    hit = np.zeros((ENVS, JOINTS), bool)
    hit[1, 2] = True
    assert np.array_equal(ill_terms[3].finite, ~hit)
    assert ill_terms[3].effort[1, 2] == (0 if policy == "zero" else ill_terms[2].effort[1, 2])
    for t in range(6):
        assert all(x is None or np.isfinite(x).all() for x in ill[t])
        assert all(np.isfinite(x).all() for x in ill_terms[t])
        for a, b in zip([*well[t], *well_terms[t]], [*ill[t], *ill_terms[t]], strict=True):
            assert a is None or a[~hit].tobytes() == b[~hit].tobytes()
    assert all(a is None or a[1, 2] == b[1, 2] for a, b in zip(ill[2], ill[3], strict=True))


def test_finite_numbers_of_any_size_are_no_faults_and_without_the_option_a_nan_propagates():
    params = bp.make_params(2, 1e-9, non_finite="zero")
    r = y = np.array([[np.inf, 1e308]])
    _, terms = bp.step_terms(params, bp.init(params, np.ones((1, 2))), r, y, DT)
    assert (terms.finite.tolist(), terms.effort.tolist()) == ([[False, True]], [[0, 0]])
    params = bp.make_params(2, 1.0, 1.0, 1.0, effort_limit=3.0, anti_windup="conditional")
    y = np.array([[np.nan, 0.0]])
    _, terms = bp.step_terms(params, bp.init(params, y * 0), np.ones((1, 2)), y, DT)
    assert np.isfinite(terms.effort).tolist() == terms.finite.tolist() == [[False, True]]


@pytest.mark.quick_rows(4)
@pytest.mark.parametrize("case", OPTIONS)
@given(runs, npst.arrays(float, (ENVS, JOINTS), elements=st.floats(-0.9, 0.9)), st.booleans())
@settings(max_examples=20)
def test_track_makes_the_next_step_reproduce_the_effort(case, run, share, rates):
    options = OPTIONS[case] | {"ki": OPTIONS[case].get("ki", 0.0)}
    for limited in ("integral_limit", "deadband"):
        options.pop(limited, None)
    if "clamp" in np.ravel(options.get("anti_windup", "none")):
        options["anti_windup"] = "conditional"
    params = bp.make_params(JOINTS, **options)
    state = roll(params, *run)[0][-1]
    limit = np.minimum(1e3 if params.effort_max is None else params.effort_max, 1e3)
    effort = share * limit
    inputs = {"feedforward": run[2][0]}
    if rates:
        inputs |= {"measurement_rate": run[2][1], "setpoint_rate": run[2][2]}
    state = bp.track(params, state, run[0][0], run[1][0], effort, dt=DT, **inputs)
    _, again = bp.step(params, state, run[0][0], run[1][0], DT, **inputs)
    np.testing.assert_allclose(again, effort, rtol=1e-6, atol=1e-6)


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
