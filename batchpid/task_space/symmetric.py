r"""Symmetric positive matrices of a few rows: Cholesky's factor, inverses, eigenvalues.

Matrices are (..., n, n). For NumPy, each operation is elementwise over the leading axes, so that the result of a row
does not depend on the others, and a row that is not finite stays alone: ``numpy.linalg`` promises neither. JAX's arrays
go to JAX's linear algebra.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from batchpid.arrays.elementwise import namespace
from batchpid.errors import InvalidArgumentError

SWEEPS = 12
"""Sweeps of Jacobi's method; matrices of six rows need five, or twelve where several eigenvalues are 0."""


def quiet() -> np.errstate:
    """Return a context in which rows that are not finite, or not positive definite, cause no warnings."""
    return np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore")


def whitened(matrix: Any, right: Any) -> Any:
    """Return L^-1 B (..., n, m) with Cholesky's factor L of ``matrix`` = L L^T, for B = ``right`` (..., n, m).

    A matrix that is not positive definite gives NaN or inf. For each column j::

        l = S_:j / sqrt(S_jj)      S <- S - l l^T      y_j = B_j / sqrt(S_jj)      B <- B - l y_j
    """
    xp, size, rows = namespace(matrix, right), matrix.shape[-1], list[Any]()
    if xp is not np:
        return xp.linalg.solve(xp.linalg.cholesky(matrix), right)
    for j in range(size):
        root = 1 / np.sqrt(matrix[..., :1, :1])  # of the rest of the matrix, which shrinks
        rows.append(right[..., :1, :] * root)
        if j + 1 < size:
            below = matrix[..., 1:, :1] * root
            right = right[..., 1:, :] - below * rows[-1]
            matrix = matrix[..., 1:, 1:] - below * (matrix[..., :1, 1:] * root)
    return np.concatenate(rows, axis=-2)


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


def bounded_inverse(matrix: Any, smallest: Any, *smooth: Any) -> tuple[Any, ...]:
    """Return the bounded inverses (..., n, n) of positive semidefinite matrices, and where they differ from inverses.

    An eigenvalue s becomes 1/s if s >= s0 = ``smallest`` (a number or (...)), else s/s0^2: continuous, at most 1/s0,
    and 0 where s is 0. Where 1/|matrix^-1| >= s0, no eigenvalue is below s0, and the inverse is Cholesky's.

    For each further bound s1 <= s0 of ``smooth``, an inverse follows the first in which s becomes s (2 - s^2/s1^2) /
    s1^2 below s1, with a continuous derivative. It has the bits of the first where no eigenvalue is below s0.
    """
    with quiet():
        if matrix.ndim > 2:
            return _bounded_inverse(matrix, smallest, *smooth)
        return tuple([leaf[0] for leaf in _bounded_inverse(matrix[None], smallest, *smooth)])


def _bounded_inverse(matrix: Any, *bounds: Any) -> tuple[Any, ...]:
    xp = namespace(matrix)
    plain = inverse(matrix)
    s0, *smooth = [xp.asarray(bound, dtype=matrix.dtype) for bound in bounds]
    norm = xp.sqrt((plain * plain).sum(-1).sum(-1))
    sure = norm * s0 <= 1  # False for NaN
    if xp is not np:
        *bounded, low = _bounded(matrix, s0, *smooth)
        return *[xp.where(sure[..., None, None], plain, each) for each in bounded], ~sure & low
    if sure.all():
        return *[plain for _ in bounds], ~sure
    out, near = [plain.copy() for _ in bounds], ~sure
    *bounded, low = _bounded(matrix[near], *[np.broadcast_to(bound, near.shape)[near] for bound in (s0, *smooth)])
    for leaf, rows in zip(out, bounded, strict=True):
        leaf[near] = rows
    near[near] = low
    return *out, near


def _bounded(matrix: Any, smallest: Any, *smooth: Any) -> tuple[Any, ...]:
    """Return the inverses by eigenvalues, and whether any is below ``smallest`` (...)."""
    xp = namespace(matrix)
    values, vectors = eigen(matrix)
    positive, rows = xp.maximum(values, 0.0), xp.swapaxes(vectors, -1, -2)

    def inverse_with(bound: Any, below: Any) -> Any:
        large = values >= bound
        scale = xp.where(large, 1 / xp.where(large, values, 1.0), below / (bound * bound))
        return gram(rows * scale[..., None], rows)

    s0 = smallest[..., None]
    inverses = [inverse_with(s0, positive)]
    bounds = [each[..., None] for each in smooth]
    inverses += [inverse_with(s1, positive * (2 - (positive / s1) ** 2)) for s1 in bounds]
    return *inverses, ~(values >= s0).all(-1)


def eigen(matrix: Any) -> tuple[Any, Any]:
    """Return the eigenvalues (..., n) and eigenvectors (..., n, n), as columns, of symmetric matrices, in no order.

    Jacobi's method, with the pairs of a tournament: rotations of one round touch different rows (G. H. Golub and C. F.
    Van Loan, Matrix Computations, 4th ed., section 8.5).
    """
    xp, size = namespace(matrix), matrix.shape[-1]
    if xp is not np:
        return xp.linalg.eigh(matrix)
    vectors = _identity(matrix) + np.zeros_like(matrix)
    if size == 1:
        return matrix[..., 0], vectors
    for partner, sign, upper, lower in _rounds(size) * SWEEPS:
        own = np.diagonal(matrix, axis1=-2, axis2=-1)
        # The same entry for both of a pair: above and below the diagonal roundings differ.
        off = matrix[..., upper, lower]
        other = np.take(own, partner, axis=-1)
        clear = (np.abs(off) <= 1e-30 * (np.abs(own) + np.abs(other))) | (sign == 0)
        cot = (other - own) / (2 * np.where(clear, 1.0, off))
        tan = np.where(cot == 0, sign, np.sign(cot)) / (np.abs(cot) + np.sqrt(cot * cot + 1))
        tan = np.where(clear, 0.0, tan)
        cos = 1 / np.sqrt(tan * tan + 1)
        matrix = _combined(_combined(matrix, partner, cos, tan, -1), partner, cos, tan, -2)
        vectors = _combined(vectors, partner, cos, tan, -1)
    return np.diagonal(matrix, axis1=-2, axis2=-1), vectors


def _combined(x: Any, partner: Any, cos: Any, tan: Any, axis: int) -> Any:
    """Return cos (x_k - tan x_partner) of the columns or rows k of ``x``."""
    cos, tan = (cos[..., None, :], tan[..., None, :]) if axis == -1 else (cos[..., None], tan[..., None])
    return cos * (x - tan * np.take(x, partner, axis=axis))


@cache
def _rounds(size: int) -> list[tuple[Any, ...]]:
    """Return the rounds of a tournament in which each of ``size`` players meets each other once.

    For each player: the partner; 1 for the first of a pair, -1 for the second, 0 for one who sits out; the lower and
    the higher number of the pair.
    """
    players = list(range(size + size % 2))
    rounds = []
    for _ in range(len(players) - 1):
        partner, sign = np.arange(size), np.zeros(size)
        for pair in zip(players[: len(players) // 2], reversed(players), strict=False):
            if max(pair) < size:
                partner[list(pair)], sign[list(pair)] = pair[::-1], (1.0, -1.0)
        rounds.append((partner, sign, np.minimum(partner, range(size)), np.maximum(partner, range(size))))
        players = [players[0], players[-1], *players[1:-1]]
    return rounds


def _identity(matrix: Any) -> Any:
    if matrix.shape[-1] != matrix.shape[-2]:
        raise InvalidArgumentError("matrix", f"has shape {matrix.shape}", remedy="give square matrices")
    return namespace(matrix).eye(matrix.shape[-1], dtype=matrix.dtype)
