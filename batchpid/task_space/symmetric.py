"""Small symmetric positive matrices: Cholesky's factor, solutions, bounded inverses.

Matrices are (..., n, n). The result of a matrix does not depend on the others in a batch.
"""

from __future__ import annotations

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace


def quiet() -> np.errstate:
    """Return a context in which rows that are not finite, or not positive definite, cause no
    warnings.
    """
    return np.errstate(all="ignore")


def whitened(matrix: Array, right: Array) -> Array:
    """Return L^-1 B (..., n, m) with Cholesky's factor L of ``matrix`` = L L^T, for B = ``right``
    (..., n, m).

    A matrix that is not positive definite gives NaN.
    """
    xp = namespace(matrix, right)
    size = matrix.shape[-1]
    # Gaussian elimination of the rows [A, B]: A becomes sqrt(D) L^T of A = L D L^T, row by row.
    rows = xp.concatenate([matrix, right], axis=-1)
    result = []
    with quiet():
        for left in range(size, 0, -1):
            pivot = rows[..., 0, :1]
            row = rows[..., 0, :] / xp.sqrt(xp.where(pivot > 0, pivot, xp.nan))
            result.append(row[..., left:])
            rows = rows[..., 1:, 1:] - row[..., 1:left, None] * row[..., None, 1:]
    return xp.stack(result, axis=-2)


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
    xp = namespace(matrix, right)
    size = matrix.shape[-1]
    identity = xp.zeros_like(matrix) + xp.eye(size, dtype=matrix.dtype)
    factor = whitened(matrix, xp.concatenate([identity, right], axis=-1))
    return gram(factor[..., :size], factor[..., size:])


def bounded_inverses(matrix: Array, s0: Array, s1: Array) -> tuple[Array, Array, Array]:
    """Return two bounded inverses (..., n, n) of positive semidefinite matrices, and the mask of
    those that have an eigenvalue below s0; the bounds s1 <= s0 are (...).

    An eigenvalue s >= s0 becomes 1/s. In the first inverse smaller ones become s/s0^2: continuous,
    at most 1/s0, and 0 where s is 0. In the second one those below s1 become s (2 - s^2/s1^2) /
    s1^2, with a continuous derivative. Both are equal to the bit where no eigenvalue is below s0.
    """
    xp = namespace(matrix)
    s0, s1 = s0[..., None], s1[..., None]
    with quiet():
        if xp is np:
            # NumPy raises for the whole batch if one matrix is not finite.
            sound: Array = np.isfinite(matrix).all((-2, -1), keepdims=True)
            values, vectors = np.linalg.eigh(np.where(sound, matrix, 0.0))
            values = np.where(sound[..., 0], values, np.nan)
        else:
            values, vectors = xp.linalg.eigh(matrix)
        # Rounding may leave eigenvalues a little below 0.
        small = xp.maximum(values, 0.0)
        exact = 1 / xp.where(values >= s1, values, 1.0)
        first = xp.where(values >= s0, exact, small / (s0 * s0))
        second = xp.where(values >= s1, exact, small * (2 - (small / s1) ** 2) / (s1 * s1))
        rows = xp.swapaxes(vectors, -1, -2)
        inverse = gram(rows * first[..., None], rows)
        smooth = gram(rows * second[..., None], rows)
    return inverse, smooth, ~(values >= s0).all(-1)
