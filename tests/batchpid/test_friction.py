"""The friction model on robots that are equations: stability, stiction, energy, equality of NumPy
and JAX.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from batchpid.motors import friction

Friction = friction.Friction
DT = 1 / 2000


def random_plant(seed):
    """Mass matrix, Coulomb friction and damping of a robot of 1 to 7 coupled joints, of very
    different inertia.
    """
    rng = np.random.default_rng(seed)
    joints = rng.integers(1, 8)
    basis, _ = np.linalg.qr(rng.normal(size=(joints, joints)))
    scale = 10.0 ** rng.uniform(-2, 0, joints)
    mass = scale[:, None] * (basis * 10.0 ** rng.uniform(-2, 0, joints)) @ basis.T * scale
    coulomb = np.diag(mass) * np.where(rng.random(joints) < 0.7, rng.uniform(10, 200, joints), 0.0)
    viscous = np.diag(mass) / DT * 10.0 ** rng.uniform(-3, 1.3, joints) * (rng.random(joints) < 0.7)
    return mass[None], Friction(coulomb[None], viscous[None])


def simulate(mass, model, efforts, velocity=0.0, load=0.0):
    """Return velocities and applied efforts (steps, envs, joints) under ``efforts`` (steps, envs,
    joints).
    """
    v = np.zeros_like(efforts[0]) + velocity
    inverse = np.linalg.inv(mass + DT * model.viscous[..., None] * np.eye(v.shape[1]))
    state = friction.init(model, v, np.zeros_like(v), mass, DT)
    rows = []
    for effort in efforts:
        state, total = friction.advance(model, state, effort, v)
        v = v + DT * (inverse @ (total - load)[..., None])[..., 0]
        rows.append((v, total))
    return tuple(map(np.array, zip(*rows, strict=True)))


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_joints_come_to_rest_and_stay(seed):
    """However the joints are coupled, and however heavy the damping."""
    mass, model = random_plant(seed)
    rng = np.random.default_rng(seed)
    load = 0.9 * model.coulomb * rng.uniform(-1, 1, model.coulomb.shape)
    stop = (
        model.coulomb / np.diagonal(mass, axis1=1, axis2=2) * DT
    )  # about the change of velocity in a step
    start = stop * rng.uniform(-3, 3, model.coulomb.shape)
    velocity, _ = simulate(mass, model, np.zeros((2500, *start.shape)), start, load)
    rubbing = model.coulomb[0] > 0
    assert np.abs(velocity).max() < 1e4 * (np.abs(start).max() + 1e-9)
    if rubbing.all():  # stiction of joints that are coupled may ring, and dies away
        assert np.abs(velocity[-1] / stop).max() < 0.01


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_friction_is_within_its_limit(seed):
    mass, model = random_plant(seed)
    rng = np.random.default_rng(seed)
    efforts = 3 * rng.normal(size=(200, 1, mass.shape[1]))
    velocity, total = simulate(mass, model, efforts)
    before = np.concatenate([np.zeros_like(velocity[:1]), velocity[:-1]])
    coulomb = total - efforts + model.viscous * before
    assert (np.abs(coulomb) <= model.coulomb * (1 + 1e-9) + 1e-9 * np.abs(total)).all()


@pytest.mark.parametrize("viscous", [None, 4.0])
@pytest.mark.parametrize(
    ("damping", "stiffness"), [(0.0, 0.0), (30.0, 0.0), (0.0, 3e4), (30.0, 3e4)]
)
def test_it_takes_its_share_of_the_velocity_that_a_joint_would_have_without_a_change_of_effort(
    viscous, damping, stiffness
):
    """Also where the simulator integrates a drive implicitly: the prediction is exact under a
    constant load.
    """
    inertia, load, (q, v) = 0.02, 0.3, (0.01, 0.2)
    model = Friction(np.full((1, 1), 1e6), None if viscous is None else np.full((1, 1), viscous))
    b = viscous or 0.0
    mobility = 1 / (inertia + DT * (b + damping + DT * stiffness))

    def after(effort):
        return v + DT * mobility * (effort - b * v - load - damping * v - stiffness * (q + DT * v))

    mass, one = np.full((1, 1, 1), inertia), np.ones((1, 1))
    state = friction.init(model, v * one, load * one, mass, DT, damping * one, stiffness * one)
    for step in range(6):
        unchanged = after(state.effort[0, 0])
        state, total = friction.advance(model, state, 0 * one, v * one)
        v, before = after(total[0, 0] + b * v), v
        if step:  # the first step has no velocity of a step before
            np.testing.assert_allclose(
                v, (1 - friction.DEADBEAT_SHARE) * unchanged, rtol=1e-9, atol=1e-12 * abs(before)
            )
        q += DT * v


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_compensation_never_exceeds_the_friction_it_works_against(seed):
    rng = np.random.default_rng(seed)
    coulomb, error, rate = (
        rng.uniform(0, 2, 4),
        rng.normal(size=(3, 4)) * 1e-3,
        rng.normal(size=(3, 4)) * 1e-3,
    )
    forward = friction.compensation(coulomb, error, rate, 1e-4)
    assert (np.abs(forward) <= coulomb).all()
    assert (forward * (error + 0.1 * rate) >= 0).all()  # the setpoint 0.1 s ahead
    far = np.abs(error) > 1e-4
    still = friction.compensation(coulomb, error, None, 1e-4)
    np.testing.assert_array_equal(still[far], (np.sign(error) * coulomb)[far])
