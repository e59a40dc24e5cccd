"""The law, traced as in a native program, is bit-identical to the law in NumPy, for all options and inputs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import batchpid as bp
from batchpid.arrays.trees import filled, leaves, structure
from batchpid.errors import InvalidArgumentError
from batchpid.law.computed_torque import check_gain_units
from batchpid.native.array_program import ArrayProgram
from batchpid.native.tracing import trace
from batchpid.sim.engine import native
from batchpid.sim.loop.pid_law import PIDLaw
from tests.batchpid.native.test_compiled_law import CHOICES, bits, numbers

needs_extension = pytest.mark.skipif(bool(native.obstacle()), reason="there are no native calls")
DT = 1 / 2000
OPTIONS = st.fixed_dictionaries(
    {"kp": st.just(40.0)},
    optional=CHOICES
    | {
        "measurement_rate": st.just("measured"),
        "gain_units": st.sampled_from(["inertia", "mass_matrix"]),
        "discretization": st.just("implicit"),
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


def run_traced(law, k, *arguments):
    """Return new state, effort and saturated joints of :meth:`PIDLaw.advance`, traced and run by the extension."""

    def function(*symbols):
        given = iter(symbols)
        k, *inputs = (filled(each, given) for each in structures)
        return leaves(law.advance(k, *inputs))

    structures, constants, inputs = [structure(each) for each in (k, *arguments)], leaves(k), leaves(arguments)
    program = ArrayProgram(trace(function, len(constants), len(inputs)), constants, len(inputs), arguments[2].shape)
    return program(*inputs)


@needs_extension
@given(OPTIONS, st.integers(1, 20), st.integers(1, 5), st.sampled_from([0.0, 0.1]), st.integers(0, 2**32), st.data())
def test_the_traced_law_is_bit_identical_to_numpy(options, joints, envs, odd, seed, data):
    params, rng, shape = params_of(joints, options), np.random.default_rng(seed), (envs, joints)
    law, k = PIDLaw.of(params), bp.discretise(params, DT, envs)
    state = bp.PIDState(
        *(None if leaf is None else numbers(rng, shape, odd, float) for leaf in bp.init(params, np.zeros(shape)))
    )
    rate, acceleration, qvel, feedforward = (
        numbers(rng, shape, odd, float) if given else None for given in data.draw(st.tuples(*[st.booleans()] * 4))
    )
    acceleration = None if params.gain_units is None else acceleration
    qvel = numbers(rng, shape, odd, float) if law.measures_rate else qvel
    matrix, viscous = (
        (numbers(rng, (*shape, joints), odd, float), numbers(rng, shape, odd, float)) if law.whole else (None, None)
    )
    matrix = numbers(rng, shape, odd, float) if law.per_inertia else matrix
    ends = np.sort(numbers(rng, (2, *shape), odd, float), axis=0) if data.draw(st.booleans()) else (None, None)
    signals = (numbers(rng, shape, odd, float), rate, acceleration), numbers(rng, shape, odd, float), qvel, feedforward
    arguments = (state, *signals, matrix, viscous, *ends)
    with np.errstate(all="ignore"):
        expected = law.advance(k, *arguments)
    found = run_traced(law, k, *arguments)
    assert [bits(leaf) for leaf in found] == [bits(leaf) for leaf in leaves(expected)]


@needs_extension
@pytest.mark.parametrize("joints", [1, 7, 8, 9, 15, 16, 17, 40, 128])
def test_sums_are_in_the_order_of_numpys(joints):
    rng = np.random.default_rng(joints)
    matrix, vector = rng.normal(size=(3, joints, joints)), rng.normal(size=(3, joints))
    params = bp.make_params(joints, 1.0, gain_units="mass_matrix")
    law, k = PIDLaw.of(params), bp.discretise(params, DT, 3)
    state, zero = bp.init(params, np.zeros_like(vector)), np.zeros_like(vector)
    arguments = (state, (vector, None, None), zero, None, None, matrix)
    assert bits(run_traced(law, k, *arguments)[-2]) == bits(law.advance(k, *arguments)[1])
