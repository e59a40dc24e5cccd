"""Solutions and bounded inverses of small symmetric matrices against numpy.linalg, row by row."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from batchpid.task_space import symmetric


def matrices(seed, rows, size, spread=1.0):
    """Return positive definite matrices with eigenvalues between 10^-spread and 10^spread, and
    these.
    """
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(rows, size, size)))[0]
    values = 10 ** rng.uniform(-spread, spread, (rows, size))
    return (axes * values[:, None]) @ axes.transpose(0, 2, 1), values


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), size=st.integers(1, 9))
def test_solutions_are_those_of_linalg(seed, size):
    matrix, _ = matrices(seed, 5, size)
    right = np.random.default_rng(seed).normal(size=(5, size, 3))
    np.testing.assert_allclose(
        symmetric.solve(matrix, right), np.linalg.solve(matrix, right), rtol=1e-8, atol=1e-8
    )
    factor = symmetric.whitened(matrix, right)
    np.testing.assert_allclose(
        symmetric.gram(factor, factor),
        right.transpose(0, 2, 1) @ symmetric.solve(matrix, right),
        atol=1e-8,
    )


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), singular=st.booleans())
def test_the_bounded_inverse_changes_small_eigenvalues_only(seed, singular):
    matrix, values = matrices(seed, 6, 6)
    if singular:
        axes = np.linalg.eigh(matrix)[1]
        values = np.sort(values)
        values[:, 0] = 0.0
        matrix = (axes * values[:, None]) @ axes.transpose(0, 2, 1)
    s0 = 0.3
    found, _, near = symmetric.bounded_inverses(matrix, np.array(s0), np.array(s0))
    values, axes = np.linalg.eigh(matrix)
    bounded = np.where(values >= s0, 1 / np.maximum(values, s0), np.maximum(values, 0) / s0**2)
    np.testing.assert_allclose(
        found, (axes * bounded[:, None]) @ axes.transpose(0, 2, 1), atol=1e-9
    )
    np.testing.assert_array_equal(near, (values < s0).any(1))
    assert np.linalg.norm(found, 2, axis=(1, 2)).max() <= 1 / s0 + 1e-9


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31))
def test_the_smooth_bounded_inverse_has_a_continuous_derivative(seed):
    matrix, _ = matrices(seed, 6, 6)
    s0, s1 = np.array(0.5), np.array(0.2)
    first, found, near = symmetric.bounded_inverses(matrix, s0, s1)
    np.testing.assert_array_equal(found[~near], first[~near])
    values, axes = np.linalg.eigh(matrix)
    smooth = np.where(
        values >= s1, 1 / np.maximum(values, s1), values * (2 - (values / s1) ** 2) / s1**2
    )
    np.testing.assert_allclose(found, (axes * smooth[:, None]) @ axes.transpose(0, 2, 1), atol=1e-9)
    step = 1e-5
    around = s1 * np.array([1 - 2 * step, 1 - step, 1, 1 + step, 1 + 2 * step])
    along = symmetric.bounded_inverses(around[:, None, None], s0, s1)[1][:, 0, 0]
    np.testing.assert_allclose(np.diff(along) / (s1 * step), -1 / s1**2, rtol=1e-3)


def test_a_matrix_that_is_not_positive_definite_or_not_finite_is_nan_alone():
    matrix = np.tile(np.eye(3), (4, 1, 1))
    matrix[1, 2, 2], matrix[2, 0, 1] = 0.0, np.nan
    found = symmetric.solve(matrix, np.ones((4, 3, 1)))
    np.testing.assert_array_equal(np.isnan(found).any((1, 2)), [False, True, True, False])
    np.testing.assert_array_equal(found[[0, 3]], 1.0)
    bounded, *_ = symmetric.bounded_inverses(matrix, np.array(0.1), np.array(0.1))
    np.testing.assert_array_equal(np.isnan(bounded).any((1, 2)), [False, False, True, False])
