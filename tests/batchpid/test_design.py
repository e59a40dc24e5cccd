"""Designed gains: the equations, the poles, and the stability bound, on robots made of arrays."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampled_loop import spectral_radius

import batchpid as bp
from batchpid import stability_bound
from batchpid.gains import pid_from_inertia

DT = 1 / 2000


class Chain:
    """A robot of constant mass matrices, one per pose."""

    def __init__(self, mass, damping=None):
        self.mass = mass
        self.damping = np.zeros(mass.shape[1]) if damping is None else damping

    def mass_matrix(self, qpos):
        return self.mass[np.arange(len(qpos)) % len(self.mass)]

    def sample(self, count, seed=0):
        return np.zeros((count, self.mass.shape[1]))

    def params(self, **options):
        return bp.make_params(self.mass.shape[1], **options)


def random_chain(seed, joints=4, poses=5):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(poses, joints, joints)) + 1.0
    scale = 10.0 ** rng.uniform(-2, 0, joints)
    return Chain(scale[:, None] * (a @ a.transpose(0, 2, 1) + 0.05 * np.eye(joints)) * scale)


@given(
    inertia=st.floats(1e-6, 1e3),
    hertz=st.floats(0.1, 20),
    zeta=st.floats(0.2, 2),
    ti=st.none() | st.floats(0.05, 5),
)
def test_gains_follow_the_equations(inertia, hertz, zeta, ti):
    w = 2 * np.pi * hertz
    gains = pid_from_inertia([inertia], hertz, zeta, integral_time=ti)
    np.testing.assert_allclose(gains["kp"], inertia * w**2)
    np.testing.assert_allclose(gains["kd"], 2 * zeta * w * inertia)
    np.testing.assert_allclose(
        gains["ki"], gains["kp"] / (3 * np.sqrt(3) / w if ti is None else ti)
    )


def test_the_three_poles_coincide_by_default():
    gains = pid_from_inertia([2.0], 3.0)
    w = 2 * np.pi * 3.0
    poles = np.roots([2.0, gains["kd"][0], gains["kp"][0], gains["ki"][0]])
    np.testing.assert_allclose(poles, -w / np.sqrt(3), rtol=1e-4)


def test_own_damping_counts_towards_the_damping():
    w = 2 * np.pi * 2.0
    free, damped, stuck = (pid_from_inertia([1.0], 2.0, 1.0, damping=[c]) for c in (0.0, w, 10 * w))
    np.testing.assert_allclose(damped["kd"], free["kd"] - w)
    np.testing.assert_allclose(damped["kp"], free["kp"])
    assert stuck["kd"] > 0  # never none at all
    assert stuck["kp"] == pytest.approx(
        5 * free["kp"]
    )  # stiff enough for what its damping holds back


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**31), units=st.sampled_from(["effort", "mass_matrix"]))
def test_designed_gains_are_stable_at_every_pose(seed, units):
    robot = random_chain(seed)
    params = bp.design_gains(robot, gain_units=units)
    tau, kp, ki, kd = (
        leaf[0] for leaf in (params.derivative_filter_time, params.kp, params.ki, params.kd)
    )
    mass = np.eye(4)[None] if units == "mass_matrix" else robot.mass
    assert stability_bound(mass, kp, kd, DT, filter_time=tau).ratio.max() <= 0.5 + 1e-9
    assert (spectral_radius(mass, kp, ki, kd, DT, filter_time=tau) < 1).all()
    w = np.sqrt(
        kp / (np.diagonal(robot.mass, axis1=1, axis2=2).max(0) if units == "effort" else 1.0)
    )
    assert (tau <= np.maximum(0.3 / w, 4 * DT) * 1.01).all()


def test_the_implicit_law_keeps_the_bandwidth_at_any_time_step():
    robot, options = random_chain(0), {"gain_units": "mass_matrix", "dt": 0.01}
    implicit = bp.design_gains(robot, 20.0, discretization="implicit", **options)
    np.testing.assert_allclose(implicit.kp, (40 * np.pi) ** 2)
    assert implicit.derivative_filter_time is None
    assert (bp.design_gains(robot, 20.0, **options).kp < implicit.kp).all()
