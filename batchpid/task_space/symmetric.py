r"""Symmetric positive matrices of a few rows: Cholesky's factor, inverses, eigenvalues.

Matrices are (..., n, n). Each operation is elementwise over the leading axes, so that the result of a row does not
depend on the others, and a row that is not finite stays alone; ``numpy.linalg`` promises neither.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from batchpid.arrays.elementwise import namespace
from batchpid.errors import InvalidArgumentError

SWEEPS = 7
"""Sweeps of Jacobi's method; convergence is quadratic, and matrices of six rows need five."""


def whitened(matrix: Any, right: Any) -> Any:
    """Return L^-1 B (..., n, m) with Cholesky's factor L of ``matrix`` = L L^T, for B = ``right`` (..., n, m).

    A matrix that is not positive definite gives NaN or inf. For each column j::

        l = S_:j / sqrt(S_jj)      S <- S - l l^T      y_j = B_j / sqrt(S_jj)      B <- B - l y_j
    """
    size, rows = matrix.shape[-1], []
    for j in range(size):
        root = 1 / namespace(matrix).sqrt(matrix[..., :1, :1])  # of the rest of the matrix, which shrinks
        rows.append(right[..., :1, :] * root)
        if j + 1 < size:
            below = matrix[..., 1:, :1] * root
            right = right[..., 1:, :] - below * rows[-1]
            matrix = matrix[..., 1:, 1:] - below * (matrix[..., :1, 1:] * root)
    return namespace(matrix).concatenate(rows, axis=-2)


def gram(factor: Any, other: Any) -> Any:
    """Return the products Y^T Z (..., m, k) of (..., n, m) and (..., n, k)."""
    total = factor[..., 0, :, None] * other[..., 0, None, :]
    for row in range(1, factor.shape[-2]):
        total = total + factor[..., row, :, None] * other[..., row, None, :]
    return total


def product(matrix: Any, vector: Any) -> Any:
    """Return the products (..., n) of matrices (..., n, m) and vectors (..., m)."""
    return (matrix * vector[..., None, :]).sum(-1)


def inverse(matrix: Any) -> Any:
    """Return the inverses (..., n, n) of positive definite matrices: (L^-1)^T L^-1."""
    factor = whitened(matrix, _identity(matrix))
    return gram(factor, factor)


def solve(matrix: Any, right: Any) -> Any:
    """Return the solutions (..., n, m) of positive definite systems."""
    factor = whitened(matrix, _identity(matrix))
    return gram(factor, gram(namespace(right).swapaxes(factor, -1, -2), right))


def bounded_inverse(matrix: Any, smallest: Any) -> tuple[Any, Any]:
    """Return the bounded inverses (..., n, n) of positive semidefinite matrices, and where they differ from inverses.

    An eigenvalue s becomes 1/s if s >= s0 = ``smallest`` (a number or (...)), else s/s0^2: continuous, at most 1/s0,
    and 0 where s is 0. Where 1/|matrix^-1| >= s0, no eigenvalue is below s0, and the inverse is Cholesky's.
    """
    xp = namespace(matrix)
    plain = inverse(matrix)
    s0 = xp.asarray(smallest, dtype=matrix.dtype)
    norm = xp.sqrt((plain * plain).sum(-1).sum(-1))
    sure = norm * s0 <= 1  # False for NaN
    if xp is not np:
        bounded, low = _bounded(matrix, s0)
        return xp.where(sure[..., None, None], plain, bounded), ~sure & low
    if sure.all():
        return plain, ~sure
    out, near = plain.copy(), ~sure
    rows = np.broadcast_to(s0, near.shape)[near]
    out[near], near[near] = _bounded(matrix[near], rows)
    return out, near


def _bounded(matrix: Any, smallest: Any) -> tuple[Any, Any]:
    """Return the bounded inverse by eigenvalues, and whether any is below ``smallest`` (...)."""
    xp = namespace(matrix)
    values, vectors = eigen(matrix)
    s0 = smallest[..., None]
    large = values >= s0
    scale = xp.where(large, 1 / xp.where(large, values, 1.0), xp.maximum(values, 0.0) / (s0 * s0))
    rows = xp.swapaxes(vectors, -1, -2)
    return gram(rows * scale[..., None], rows), ~large.all(-1)


def eigen(matrix: Any) -> tuple[Any, Any]:
    """Return the eigenvalues (..., n) and eigenvectors (..., n, n), as columns, of symmetric matrices, in no order.

    Jacobi's method, with the pairs of a tournament: rotations of one round touch different rows (G. H. Golub and C. F.
    Van Loan, Matrix Computations, 4th ed., section 8.5).
    """
    xp, size = namespace(matrix), matrix.shape[-1]
    vectors = _identity(matrix) + xp.zeros_like(matrix)
    for _ in range(SWEEPS):
        for first, second in _rounds(size):
            matrix, vectors = _rotated(matrix, vectors, first, second, xp)
    return xp.stack([matrix[..., k, k] for k in range(size)], axis=-1), vectors


def _rotated(a: Any, vectors: Any, first: list[int], second: list[int], xp: Any) -> tuple[Any, Any]:
    """Return matrix and eigenvectors after the rotations that clear the entries (first, second) of the matrix."""
    order = [*first, *second, *(k for k in range(a.shape[-1]) if k not in (*first, *second))]
    back, pairs = [order.index(k) for k in range(len(order))], len(first)
    p, q, off = a[..., first, first], a[..., second, second], a[..., first, second]
    clear = off == 0
    cot = (q - p) / (2 * xp.where(clear, 1.0, off))
    sign = xp.where(cot < 0, -1.0, 1.0)
    tan = xp.where(clear, 0.0, sign / (xp.abs(cot) + xp.sqrt(cot * cot + 1)))
    cos = 1 / xp.sqrt(tan * tan + 1)
    sin = cos * tan

    def columns(x: Any) -> Any:
        one, two = x[..., first], x[..., second]
        c, s = cos[..., None, :], sin[..., None, :]
        parts = [c * one - s * two, s * one + c * two, x[..., order[2 * pairs :]]]
        return xp.concatenate(parts, axis=-1)[..., back]

    half = columns(a)
    return xp.swapaxes(columns(xp.swapaxes(half, -1, -2)), -1, -2), columns(vectors)


def _rounds(size: int) -> list[tuple[list[int], list[int]]]:
    """Return the rounds of a tournament in which each of ``size`` players meets each other once."""
    players = [*range(size), *([-1] * (size % 2))]
    rounds = []
    for _ in range(len(players) - 1):
        half = len(players) // 2
        pairs = [sorted(pair) for pair in zip(players[:half], reversed(players[half:]), strict=True) if -1 not in pair]
        if pairs:
            rounds.append(([pair[0] for pair in pairs], [pair[1] for pair in pairs]))
        players = [players[0], players[-1], *players[1:-1]]
    return rounds


def _identity(matrix: Any) -> Any:
    if matrix.shape[-1] != matrix.shape[-2]:
        raise InvalidArgumentError("matrix", f"has shape {matrix.shape}", remedy="give square matrices")
    return namespace(matrix).eye(matrix.shape[-1], dtype=matrix.dtype)
