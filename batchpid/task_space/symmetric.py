r"""Small symmetric positive matrices: Cholesky's factor, solutions, bounded inverses, eigenvalues.

Matrices are (..., n, n), and their linear algebra is NumPy's or JAX's. The result of a matrix does
not depend on the others in a batch. NumPy solves them separately, but raises for the whole batch if
one is not finite. So such a matrix is replaced by the identity, and its result by NaN.
"""

from __future__ import annotations

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace
from batchpid.errors import InvalidArgumentError


def quiet() -> np.errstate:
    """Return a context in which rows that are not finite, or not positive definite, cause no
    warnings.
    """
    return np.errstate(
        invalid="ignore",
        divide="ignore",
        over="ignore",
        under="ignore",
    )


def whitened(matrix: Array, right: Array) -> Array:
    """Return L^-1 B (..., n, m) with Cholesky's factor L of ``matrix`` = L L^T, for B = ``right``
    (..., n, m).

    A matrix that is not positive definite gives NaN.
    """
    xp = namespace(matrix, right)
    # JAX returns NaN by itself; NumPy would raise for the whole batch.
    if xp is not np:
        return xp.linalg.solve(xp.linalg.cholesky(matrix), right)
    matrix, sound = _sound(matrix)
    factor = _cholesky(matrix)
    positive = sound & ~np.isnan(factor[..., :1, :1])
    # With rows and columns in reverse the factor is upper triangular, and its solution a
    # substitution, without pivots.
    sane: Array = np.where(positive, factor, _identity(matrix))
    reverse = sane[..., ::-1, ::-1]
    return np.where(
        positive,
        np.linalg.solve(reverse, right[..., ::-1, :])[..., ::-1, :],
        np.nan,
    )


def _cholesky(matrix: Array) -> Array:
    """Return Cholesky's factors (..., n, n), NaN where a matrix is not positive definite."""
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        if matrix.ndim == 2:
            return np.full_like(matrix, np.nan)
        return np.stack([_cholesky(row) for row in matrix])


def _sound(matrix: Array) -> tuple[Array, Array]:
    """Return ``matrix`` with the identity for non-finite matrices, and the mask of finite ones
    (..., 1, 1).
    """
    sound = np.isfinite(matrix).all((-2, -1), keepdims=True)
    return (matrix if sound.all() else np.where(sound, matrix, _identity(matrix))), sound


def gram(factor: Array, other: Array) -> Array:
    """Return the products Y^T Z (..., m, k) of (..., n, m) and (..., n, k)."""
    # A sum in a fixed order: a row does not depend on the size of the batch.
    total = factor[..., 0, :, None] * other[..., 0, None, :]
    for row in range(1, factor.shape[-2]):
        total = total + factor[..., row, :, None] * other[..., row, None, :]
    return total


def product(matrix: Array, vector: Array) -> Array:
    """Return the products (..., n) of matrices (..., n, m) and vectors (..., m)."""
    return (matrix * vector[..., None, :]).sum(-1)


def solve(matrix: Array, right: Array) -> Array:
    """Return the solutions (..., n, m) of positive definite systems."""
    factor = whitened(matrix, _identity(matrix))
    return gram(factor, gram(namespace(right).swapaxes(factor, -1, -2), right))


def bounded_inverse(matrix: Array, smallest: Array, *smooth: Array) -> tuple[Array, ...]:
    """Return the bounded inverses (..., n, n) of positive semidefinite matrices, and the mask of
    those that differ.

    An eigenvalue s becomes 1/s if s >= s0 = ``smallest`` (a number or (...)), else s/s0^2:
    continuous, at most 1/s0, and 0 where s is 0.

    Each bound s1 <= s0 in ``smooth`` gives a further inverse: below s1, s becomes s (2 - s^2/s1^2)
    / s1^2, with a continuous derivative. It is bit-identical to the first inverse if no eigenvalue
    is below s0.
    """
    xp = namespace(matrix)
    s0, *bounds = [
        xp.asarray(bound, dtype=matrix.dtype)[..., None] for bound in (smallest, *smooth)
    ]
    with quiet():
        values, vectors = eigen(matrix)
        # Rounding may leave eigenvalues a little below 0.
        positive = xp.maximum(values, 0.0)
        rows = xp.swapaxes(vectors, -1, -2)

        def inverse_with(bound: Array, below: Array) -> Array:
            large = values >= bound
            scale = xp.where(
                large,
                1 / xp.where(large, values, 1.0),
                below / (bound * bound),
            )
            return gram(rows * scale[..., None], rows)

        inverses = [inverse_with(s0, positive)]
        inverses += [inverse_with(s1, positive * (2 - (positive / s1) ** 2)) for s1 in bounds]
        return *inverses, ~(values >= s0).all(-1)


def eigen(matrix: Array) -> tuple[Array, Array]:
    """Return the eigenvalues (..., n), ascending, and eigenvectors (..., n, n), as columns, of
    symmetric matrices.
    """
    if namespace(matrix) is not np:
        eigen: tuple[Array, Array] = namespace(matrix).linalg.eigh(matrix)
        return eigen
    matrix, sound = _sound(matrix)
    values, vectors = np.linalg.eigh(matrix)
    return np.where(sound[..., 0], values, np.nan), np.where(sound, vectors, np.nan)


def _identity(matrix: Array) -> Array:
    if matrix.shape[-1] != matrix.shape[-2]:
        raise InvalidArgumentError(
            "matrix", f"has shape {matrix.shape}", remedy="give square matrices"
        )
    return namespace(matrix).eye(matrix.shape[-1], dtype=matrix.dtype)
