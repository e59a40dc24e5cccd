"""Laws of coupled joints."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from batchpid.motors import Coupling, Follower

NUMBER = st.floats(-3, 3, allow_subnormal=False)


@st.composite
def couplings(draw):
    """Return a coupling in which followers follow any joint before them in a random order."""
    joints = draw(st.integers(2, 6))
    order = draw(st.permutations(range(joints)))
    followers = [
        Follower(joint, order[draw(st.integers(0, place - 1))], draw(NUMBER), draw(NUMBER))
        for place, joint in enumerate(order)
        if place and draw(st.booleans())
    ]
    return Coupling.of(joints, followers), followers


def arrays(joints, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, joints, joints))
    return (
        rng.normal(size=(3, joints)),
        rng.normal(size=(3, joints)),
        root @ root.mT + np.eye(joints),
    )


@settings(max_examples=25)
@given(couplings())
def test_every_follower_is_where_its_leader_says_also_through_chains(case):
    coupling, followers = case
    q = coupling.positions(arrays(len(coupling.leader))[0])
    for joint, leader, multiplier, offset in followers:
        np.testing.assert_allclose(q[:, joint], multiplier * q[:, leader] + offset, atol=1e-12)
    np.testing.assert_array_equal(coupling.positions(q), q)  # a projection
    free = q[:, coupling.independent]
    np.testing.assert_allclose(free @ coupling.matrix.T + coupling.offset, q, atol=1e-12)
    np.testing.assert_allclose(
        q @ coupling.jacobian.T,
        np.broadcast_to(coupling.offset[coupling.followers], (3, len(coupling.followers))),
        atol=1e-12,
    )
    np.testing.assert_allclose(coupling.jacobian @ coupling.matrix, 0.0, atol=1e-12)


@settings(max_examples=25)
@given(couplings())
def test_power_and_kinetic_energy_are_those_of_the_independent_joints(case):
    coupling, _ = case
    v, u, mass = arrays(len(coupling.leader))
    v = coupling.rates(v)
    free = v[:, coupling.independent]
    acting = coupling.efforts(u)
    assert not acting[:, ~coupling.independent].any()
    np.testing.assert_allclose((acting * v).sum(1), (u * v).sum(1), atol=1e-9)
    whole, reduced = (
        np.einsum("ni,nij,nj->n", *rows)
        for rows in ((v, mass, v), (free, coupling.reduced(mass), free))
    )
    np.testing.assert_allclose(whole, reduced, rtol=1e-9, atol=1e-9)
    embedded = coupling.mass_matrix(mass)
    np.testing.assert_array_equal(
        embedded[:, coupling.independent][:, :, coupling.independent], coupling.reduced(mass)
    )
    assert (np.linalg.eigvalsh(embedded) > 0).all()
    damping = np.abs(u[0])
    np.testing.assert_allclose(
        coupling.reduced_damping(damping),
        np.diag(coupling.reduced(np.diag(damping))),
        rtol=1e-9,
        atol=1e-12,
    )


@settings(max_examples=25)
@given(couplings())
def test_figures_of_followers_are_those_of_their_leaders(case):
    coupling, _ = case
    figures = np.arange(len(coupling.leader))
    np.testing.assert_array_equal(coupling.of_leaders(figures), coupling.leader)
    np.testing.assert_array_equal(coupling.of_all(figures[coupling.independent]), coupling.leader)


def test_the_identity_returns_its_arguments():
    coupling, given = Coupling.of(3), object()
    assert coupling.is_identity
    of_figures, of_matrices = (
        ["of_independent", "of_leaders", "of_all"],
        ["mass_matrix", "reduced", "reduced_damping"],
    )
    for name in ["positions", "rates", "efforts", *of_figures, *of_matrices]:
        assert getattr(coupling, name)(given) is given
    assert coupling.native() == {}
    assert not len(coupling.followers)
    np.testing.assert_array_equal(coupling.matrix, np.eye(3))
    assert not Coupling.of(3, [Follower(2, 0)]).is_identity


def test_a_loop_of_followers_is_refused():
    with pytest.raises(ValueError, match="follows itself"):
        Coupling.of(3, [Follower(0, 1), Follower(1, 0)])
