"""Distributions: moments, bounds, and their form in a file."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from batchpid.errors import InvalidArgumentError
from batchpid.sim import LogUniform, Normal, Randomization, Uniform

COUNT = 20_000
numbers = st.floats(-1e3, 1e3, allow_nan=False)
pairs = st.tuples(numbers, numbers).map(sorted)
options = st.fixed_dictionaries(
    {"operation": st.sampled_from(["add", "scale", "abs"]), "shared": st.booleans()}
)
distributions = st.one_of(
    st.builds(lambda ends, rest: Uniform(*ends, **rest), pairs, options),
    st.builds(
        lambda ends, rest: LogUniform(*(1e-3 + abs(end) for end in sorted(ends, key=abs)), **rest),
        pairs,
        options,
    ),
    st.builds(
        lambda mean, std, rest: Normal(mean, std, **rest), numbers, st.floats(1e-3, 1e3), options
    ),
)


def read(described):
    return Randomization.from_dict({"qpos": described})


def moments(distribution):
    drawn = distribution.sample(np.random.default_rng(0), COUNT)
    return drawn.mean(), drawn.std(), 4 * drawn.std() / math.sqrt(COUNT)


def test_the_logarithm_of_log_uniform_is_uniform():
    drawn = np.log(LogUniform(0.1, 10).sample(np.random.default_rng(0), COUNT))
    assert drawn.mean() == pytest.approx(0, abs=4 * drawn.std() / math.sqrt(COUNT))
    assert drawn.std() == pytest.approx(2 * math.log(10) / math.sqrt(12), rel=0.02)


@pytest.mark.parametrize(
    ("distribution", "center", "spread"),
    [(Uniform(1, 4), 2.5, 3 / math.sqrt(12)), (Normal(-2, 0.5), -2, 0.5)],
)
def test_a_distribution_has_its_moments(distribution, center, spread):
    mean, std, error = moments(distribution)
    assert mean == pytest.approx(center, abs=error)
    assert std == pytest.approx(spread, rel=0.02)


@settings(max_examples=40)
@given(distributions)
def test_draws_are_within_the_support(distribution):
    drawn = distribution.sample(np.random.default_rng(1), 50)
    low, high = distribution.support
    assert drawn.shape == (50,)
    assert ((drawn >= low) & (drawn <= high)).all()


@pytest.mark.parametrize(
    ("operation", "expected"), [("add", [5, 7]), ("scale", [6, 12]), ("abs", [3, 3])]
)
def test_operations(operation, expected):
    np.testing.assert_array_equal(
        Uniform(0, 9, operation=operation).apply(np.array([2.0, 4.0]), 3.0), expected
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Uniform(2, 1), "high: out of range"),
        (lambda: Uniform("a", 1), "low: must be a number"),
        (lambda: Uniform(0, math.inf), "high: out of range"),
        (lambda: Uniform(0, 1, operation="times"), "operation: unknown option"),
        (lambda: LogUniform(0, 1), "low: out of range"),
        (lambda: Normal(0, 0), "std: out of range"),
        (lambda: Normal(1e301, 1), "mean: out of range"),
        (
            lambda: read({"gamma": [1, 2]}),
            "qpos: is not a distribution.*uniform, log_uniform",
        ),
        (
            lambda: read({"uniform": [1, 2, 3]}),
            "qpos: is not a distribution: .*arguments",
        ),
        (lambda: read({"uniform": 1}), "qpos: uniform needs a list of numbers"),
        (lambda: read({"normal": [0, "x"]}), "qpos: std: "),
        (
            lambda: read({"uniform": [0, 1], "mode": "add"}),
            "qpos: is not a distribution: .*keyword argument 'mode'",
        ),
        (lambda: read({"uniform": [2, 1]}), "qpos: high: out of range"),
    ],
)
def test_what_is_no_distribution_is_refused(make, message):
    with pytest.raises(InvalidArgumentError, match=message):
        make()
