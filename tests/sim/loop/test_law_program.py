"""The law as a native program is bit-identical to the law in NumPy, for all options and inputs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.law.computed_torque import check_gain_units
from batchpid.sim.engine import native
from batchpid.sim.loop.law_program import LawProgram
from batchpid.sim.loop.pid_law import PIDLaw

needs_extension = pytest.mark.skipif(not native.status().active, reason="there are no native calls")
DT = 1 / 2000


OPTIONS = st.fixed_dictionaries(
    {"kp": st.just(40.0)},
    optional={
        "ki": st.sampled_from([0.0, 50.0]),
        "kd": st.sampled_from([0.0, 2.0]),
        "effort_limit": st.sampled_from([0.0, 5.0, 80.0]),
        "effort_rate_limit": st.just(900.0),
        "integral_limit": st.just(0.2),
        "derivative_filter_time": st.just(0.01),
        "setpoint_weight": st.just(0.7),
        "setpoint_weight_derivative": st.just(0.3),
        "weight_origin": st.just("start"),
        "first_derivative": st.just("kick"),
        "deadband": st.just(0.3),
        "anti_windup": st.sampled_from(["none", "conditional", "back_calculation"]),
        "integration": st.just("integrate_first"),
        "non_finite": st.sampled_from(["zero", "hold"]),
        "measurement_rate": st.just("measured"),
        "gain_units": st.sampled_from(["inertia", "mass_matrix"]),
        "discretization": st.just("implicit"),
        "continuous": st.just(True),
    },
)


def params_of(joints, options):
    """Return params with these options, without those that do not go together."""
    try:
        params = bp.make_params(joints, **options)
        check_gain_units(params)
        return params
    except InvalidArgumentError as error:
        options = {name: value for name, value in options.items() if name not in (error.argument, "anti_windup")}
        return params_of(joints, options)


def numbers(rng, shape, odd):
    """Return numbers of many sizes; a share ``odd`` of them is zero, infinite or not a number."""
    values = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 3, shape)
    return np.where(rng.random(shape) < odd, rng.choice([0.0, np.inf, -np.inf, np.nan], shape), values)


def bits(leaf):
    """Return the bits of an array, with one NaN for all."""
    return None if leaf is None else np.where(np.isnan(leaf), np.nan, leaf).tobytes()


@needs_extension
@given(OPTIONS, st.integers(1, 20), st.integers(1, 5), st.sampled_from([0.0, 0.1]), st.integers(0, 2**32), st.data())
def test_the_program_is_bit_identical_to_numpy(options, joints, envs, odd, seed, data):
    params, rng, shape = params_of(joints, options), np.random.default_rng(seed), (envs, joints)
    law, k = PIDLaw.of(params), bp.discretise(params, DT, envs)
    state = bp.PIDState(
        *(None if leaf is None else numbers(rng, shape, odd) for leaf in bp.init(params, np.zeros(shape)))
    )
    rate, qvel, feedforward = (
        numbers(rng, shape, odd) if given else None for given in data.draw(st.tuples(*[st.booleans()] * 3))
    )
    qvel = numbers(rng, shape, odd) if law.measures_rate else qvel
    matrix, viscous = (numbers(rng, (*shape, joints), odd), numbers(rng, shape, odd)) if law.whole else (None, None)
    matrix = numbers(rng, shape, odd) if law.per_inertia else matrix
    ends = np.sort(numbers(rng, (2, *shape), odd), axis=0) if data.draw(st.booleans()) else (None, None)
    signals = (numbers(rng, shape, odd), rate), numbers(rng, shape, odd), qvel, feedforward
    arguments = (state, *signals, matrix, viscous, *ends)
    program = LawProgram(law, k)
    with np.errstate(all="ignore"):
        new, effort, saturated = law.advance(k, *arguments, observed=True)
        assert [bits(leaf) for leaf in law.advance(k, *arguments)[0]] == [bits(leaf) for leaf in new]
    for ours in (program.advance(*arguments, observed=True), program.advance(*arguments)):
        assert [bits(leaf) for leaf in ours[0]] == [bits(leaf) for leaf in new]
        assert bits(ours[1]) == bits(effort)
    assert bits(program.advance(*arguments, observed=True)[2]) == bits(saturated)


@needs_extension
@pytest.mark.parametrize("joints", [1, 7, 8, 9, 15, 16, 17, 40, 128])
def test_sums_are_in_the_order_of_numpys(joints):
    rng = np.random.default_rng(joints)
    matrix, vector = rng.normal(size=(3, joints, joints)), rng.normal(size=(3, joints))
    params = bp.make_params(joints, 1.0, gain_units="mass_matrix")
    law, k = PIDLaw.of(params), bp.discretise(params, DT, 3)
    state, zero = bp.init(params, np.zeros_like(vector)), np.zeros_like(vector)
    arguments = (state, (vector, None), zero, None, None, matrix)
    assert bits(LawProgram(law, k).advance(*arguments)[1]) == bits(law.advance(k, *arguments)[1])


@needs_extension
def test_arrays_need_not_be_contiguous_but_of_the_right_size():
    params = bp.make_params(2, 3.0, kd=0.1)
    law, k = PIDLaw.of(params), bp.discretise(params, DT, 3)
    state, rows = bp.init(params, np.zeros((3, 2))), np.arange(6.0).reshape(2, 3).T
    program = LawProgram(law, k)
    effort = program.advance(state, (rows, None), -rows, None, None)[1]
    np.testing.assert_array_equal(effort, law.advance(k, state, (rows, None), -rows, None, None)[1])
    for wrong in (rows[:2], rows.astype(np.float32)):
        with pytest.raises(ValueError, match="do not fit"):
            program.advance(state, (wrong, None), rows, None, None)


def test_float32_and_missing_extensions_are_left_to_numpy(monkeypatch):
    k = bp.discretise(bp.make_params(2, 3.0), DT, 3)
    assert LawProgram.available(k) == native.status().active
    assert not LawProgram.available(bp.discretise(bp.make_params(2, 3.0, dtype=np.float32), DT, 3))
    monkeypatch.setenv(native.SWITCH, "0")
    assert not LawProgram.available(k)


@needs_extension
@pytest.mark.parametrize("order", [("zero", "hold"), ("hold", "zero")])
def test_laws_that_differ_in_a_choice_alone_have_programs_of_their_own(order):
    for non_finite in order:
        params = bp.make_params(2, kp=10.0, effort_rate_limit=1e6, non_finite=non_finite)
        law, k = PIDLaw.of(params), bp.discretise(params, DT, 1)
        program, state, setpoint = LawProgram(law, k), bp.init(params, np.zeros((1, 2))), np.ones((1, 2))
        for qpos in (0.5, np.nan):
            state, effort = program.advance(state, (setpoint, None), np.full((1, 2), qpos), None, None)[:2]
        assert (effort == {"zero": 0.0, "hold": 5.0}[non_finite]).all()
