"""The closed-form bound against the exact one-step matrix, and both against the law itself on a
chain of masses.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampled_loop import spectral_radius

import batchpid as bp
from batchpid import stability_bound

DT = 1 / 2000


def random_mass(rng, joints):
    """A positive definite matrix whose joints differ by decades and are strongly coupled."""
    a = rng.normal(size=(joints, joints)) + 1.5
    scale = 10.0 ** rng.uniform(-3, 0, joints)
    return scale[:, None] * (a @ a.T + 0.02 * np.eye(joints)) * scale


def test_one_joint_without_filter_is_the_textbook_bound():
    inertia, kp, kd = 0.3, 4.0e5, 500.0
    bound = stability_bound([[inertia]], kp, kd, DT)
    assert bound.ratio == pytest.approx((kd * DT / inertia + kp * DT**2 / (2 * inertia)) / 2)
    assert bound.participation == pytest.approx([1.0])


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**31),
    joints=st.integers(1, 6),
    filter_time=st.sampled_from([0.0, 1e-4, 5e-3]),
    damping=st.sampled_from([0.0, 0.5]),
    stiff=st.floats(0.01, 1),
)
def test_ratio_is_where_the_exact_loop_turns_unstable(seed, joints, filter_time, damping, stiff):
    rng = np.random.default_rng(seed)
    mass = random_mass(rng, joints)
    kd = np.diag(mass) * rng.uniform(0.2, 2, joints) / DT
    kp = stiff * kd * rng.uniform(0.1, 1, joints) * 10
    ratio = stability_bound(mass, kp, kd, DT, filter_time=filter_time, damping=damping).ratio
    options = {"filter_time": filter_time, "damping": damping}
    below, above = 0.98 / ratio, 1.02 / ratio
    assert spectral_radius(mass, below * kp, 0.0, below * kd, DT, **options) < 1
    assert spectral_radius(mass, above * kp, 0.0, above * kd, DT, **options) > 1


def test_the_integral_is_in_the_exact_loop():
    # Continuous time: kp kd / I > ki.
    inertia, kp, kd = 1.0, 100.0, 20.0
    assert spectral_radius([[inertia]], kp, 0.9 * kp * kd, kd, DT) < 1
    assert spectral_radius([[inertia]], kp, 1.1 * kp * kd, kd, DT) > 1


def test_stacks():
    mass = np.stack([np.eye(2), 2 * np.eye(2)])
    bound = stability_bound(mass, [1.0, 1.0], [100.0, 1.0], DT)
    assert bound.ratio[0] == pytest.approx(2 * bound.ratio[1])
    np.testing.assert_allclose(bound.participation, [[1, 0], [1, 0]])


def test_the_joint_whose_motor_is_late_is_in_the_mode_that_becomes_unstable():
    """The law multiplies by the mass matrix, so that only the joint that is late can oscillate."""
    mass = np.array([[2.0, 0.8, 0.2], [0.8, 0.7, 0.2], [0.2, 0.2, 0.1]])
    for late in range(3):
        delay = np.where(np.arange(3) == late, 0.03, 0.0)
        bound = bp.stability_bound(mass, 400.0, 40.0, 5e-4, delay=delay, model=mass)
        assert bound.ratio > 0.2
        np.testing.assert_allclose(bound.participation, np.arange(3) == late, atol=0.01)
