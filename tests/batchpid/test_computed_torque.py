"""Gains per unit of inertia: properties; test_law_conformance.py compares them with plain
numbers.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.law import advance_with_mass_matrix, check_gain_units

DT = 1e-3


def mass(rng, envs, joints):
    a = rng.normal(size=(envs, joints, joints))
    return a @ a.transpose(0, 2, 1) + 0.1 * np.eye(joints)


def params(joints, **options):
    return bp.make_params(
        joints, 100.0, 50.0, 20.0, anti_windup="conditional", gain_units="mass_matrix", **options
    )


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), envs=st.integers(1, 4), joints=st.integers(1, 5))
def test_limits_keep_the_direction_of_the_acceleration(seed, envs, joints):
    rng = np.random.default_rng(seed)
    matrix, passive = mass(rng, envs, joints), rng.uniform(-1, 1, (envs, joints))
    limit = rng.uniform(1.1, 10.0 ** rng.integers(1, 6), joints)
    rate = rng.uniform(100, 1e5, joints)
    y, r = rng.normal(size=(2, envs, joints))
    last = 0.1 * passive

    def efforts(**limits):
        state = bp.init(params(joints, effort_rate_limit=1.0), y)._replace(effort=last)
        k = bp.discretise(params(joints, **limits), DT)
        return advance_with_mass_matrix(k, state, r, y, matrix, feedforward=passive)[1].effort

    def share(part, whole):
        """Return the one factor of all joints of each env."""
        factor = (part * whole).sum(1) / (whole**2).sum(1)
        np.testing.assert_allclose(part, factor[:, None] * whole, rtol=1e-6, atol=1e-6)
        assert ((factor >= 0) & (factor <= 1 + 1e-9)).all()
        return factor < 1 - 1e-9

    free, limited = efforts(), efforts(effort_limit=limit)
    assert (np.abs(limited) <= limit).all()
    to_acceleration = np.linalg.inv(matrix)
    short = share(*(np.einsum("eij,ej->ei", to_acceleration, u - passive) for u in (limited, free)))
    assert (np.isclose(np.abs(limited), limit).any(1) == short).all()
    changed = efforts(effort_limit=limit, effort_rate_limit=rate)
    assert (np.abs(changed) <= limit).all()
    np.testing.assert_allclose(changed, np.clip(limited, last - rate * DT, last + rate * DT))


def test_back_calculation_of_accelerations_is_refused():
    options = {"anti_windup": "back_calculation", "effort_limit": 1.0}
    with pytest.raises(InvalidArgumentError, match="mass_matrix"):
        check_gain_units(bp.make_params(1, 1.0, 1.0, 1.0, gain_units="mass_matrix", **options))
    check_gain_units(bp.make_params(1, 1.0, 1.0, 1.0, **options))
