"""Inverses and eigenvalues of small symmetric matrices against numpy.linalg, row by row."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from batchpid.errors import InvalidArgumentError
from batchpid.task_space.symmetric import bounded_inverse, eigen, gram, inverse, solve, whitened


def matrices(seed, rows, size, spread=1.0):
    """Return positive definite matrices with eigenvalues between 10^-spread and 10^spread, and these."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(rows, size, size)))[0]
    values = 10 ** rng.uniform(-spread, spread, (rows, size))
    return (axes * values[:, None]) @ axes.transpose(0, 2, 1), values


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), size=st.integers(1, 9))
def test_inverse_and_solution_are_those_of_linalg(seed, size):
    matrix, _ = matrices(seed, 5, size)
    np.testing.assert_allclose(inverse(matrix), np.linalg.inv(matrix), rtol=1e-8, atol=1e-10)
    right = np.random.default_rng(seed).normal(size=(5, size, 3))
    np.testing.assert_allclose(solve(matrix, right), np.linalg.solve(matrix, right), rtol=1e-8, atol=1e-8)
    factor = whitened(matrix, right)
    np.testing.assert_allclose(gram(factor, factor), right.transpose(0, 2, 1) @ solve(matrix, right), atol=1e-8)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), size=st.integers(1, 6))
def test_eigenvalues_are_those_of_linalg(seed, size):
    matrix, wanted = matrices(seed, 4, size, spread=4.0)
    values, vectors = eigen(matrix)
    np.testing.assert_allclose(np.sort(values), np.sort(wanted), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose((vectors * values[:, None]) @ vectors.transpose(0, 2, 1), matrix, atol=1e-6)
    np.testing.assert_allclose(vectors.transpose(0, 2, 1) @ vectors, np.tile(np.eye(size), (4, 1, 1)), atol=1e-13)


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
    found, near = bounded_inverse(matrix, s0)
    values, axes = np.linalg.eigh(matrix)
    bounded = np.where(values >= s0, 1 / np.maximum(values, s0), np.maximum(values, 0) / s0**2)
    np.testing.assert_allclose(found, (axes * bounded[:, None]) @ axes.transpose(0, 2, 1), atol=1e-9)
    np.testing.assert_array_equal(near, (values < s0).any(1))
    assert np.linalg.norm(found, 2, axis=(1, 2)).max() <= 1 / s0 + 1e-9


def test_it_is_continuous_where_the_bound_begins():
    s0 = 0.02
    for size in (1, 3, 6):
        matrix = np.stack([np.diag([s0 * share, *[1.0] * (size - 1)]) for share in (1 - 1e-9, 1, 1 + 1e-9)])
        found, near = bounded_inverse(matrix, s0)
        np.testing.assert_allclose(found[:, 0, 0], 1 / s0, rtol=1e-6)
        np.testing.assert_array_equal(near, [True, False, False])


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31))
def test_the_smooth_bounded_inverse_has_a_continuous_derivative(seed):
    matrix, _ = matrices(seed, 6, 6)
    s0, s1 = 0.5, 0.2
    first, found, near = bounded_inverse(matrix, s0, s1)
    np.testing.assert_array_equal(first, bounded_inverse(matrix, s0)[0])
    np.testing.assert_array_equal(found[~near], first[~near])
    values, axes = np.linalg.eigh(matrix)
    smooth = np.where(values >= s1, 1 / np.maximum(values, s1), values * (2 - (values / s1) ** 2) / s1**2)
    np.testing.assert_allclose(found, (axes * smooth[:, None]) @ axes.transpose(0, 2, 1), atol=1e-9)
    step = 1e-5
    around = s1 * np.array([1 - 2 * step, 1 - step, 1, 1 + step, 1 + 2 * step])
    along = bounded_inverse(around[:, None, None], s0, s1)[1][:, 0, 0]
    np.testing.assert_allclose(np.diff(along) / (s1 * step), -1 / s1**2, rtol=1e-3)


def test_a_row_does_not_depend_on_the_others_and_nan_stays_alone():
    matrix, _ = matrices(0, 30, 6, spread=3.0)
    matrix[4], matrix[5, 0, 0] = np.nan, np.inf
    found, near = bounded_inverse(matrix, 0.1)
    assert near.any()
    assert not near.all()
    assert np.isfinite(np.delete(found, [4, 5], 0)).all()
    assert np.isnan(found[4]).all()
    for rows in (slice(0, 1), slice(6, 7), slice(7, 29)):
        np.testing.assert_array_equal(bounded_inverse(matrix[rows], 0.1)[0], found[rows])
        np.testing.assert_array_equal(bounded_inverse(matrix[rows], 0.1)[1], near[rows])


def test_a_matrix_that_is_not_square_is_refused():
    with pytest.raises(InvalidArgumentError, match="square"):
        inverse(np.zeros((2, 3)))
