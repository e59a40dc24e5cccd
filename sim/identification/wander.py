r"""Wander: motion by unlogged disturbances (noise between rows, initial velocity), and residuals without it.

The law reacts to the noise n of the sensors and thereby moves the robot. Between the rows of a log that noise is
unknown, so it is drawn several times. The deviations of the simulated motions from their mean, over the root of their
number less 1, are columns of W. A further column is the motion due to one standard deviation of an unknown initial
velocity. Residuals r of white noise of size sigma and of wander have the covariance::

    C = sigma^2 (I + W W^T / n^2),     r_white = (I + W W^T / n^2)^(-1/2) r

r_white and its Jacobian replace r and J; half the logarithm of det(I + W W^T / n^2) is added to the negative logarithm
of the likelihood (generalized least squares; L. Ljung, System Identification, 2nd edition, Prentice Hall, 1999, section
7.2).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64


def spread(draws: Float64) -> Float64:
    """Return the columns (rows, joints, draws) of W for positions of several draws (draws, rows, joints)."""
    return (draws - draws.mean(0)).transpose(1, 2, 0) / np.sqrt(max(len(draws) - 1, 1))


def whiten(
    wander: Float64, stretches: list[NDArray[np.intp]], residual: Float64, jacobian: Float64
) -> tuple[Float64, Float64, Float64]:
    """Return residuals and Jacobian without wander in the rows of ``stretches``, and half log-determinants.

    Parameters
    ----------
    wander
        W over the noise n (rows, joints, columns).
    residual, jacobian
        (rows, joints) and (rows, joints, unknowns).

    Returns
    -------
    residual, jacobian, determinants
        The last one over the number of rows (stretches, joints).
    """
    determinants = np.zeros((len(stretches), residual.shape[1]))
    if not np.isfinite(wander).all():
        return residual, jacobian, determinants
    white, jacobian = residual.copy(), jacobian.copy()
    for number, rows in enumerate(stretches):
        for joint in range(residual.shape[1]):
            directions, sizes, _ = np.linalg.svd(wander[rows, joint], full_matrices=False)
            shrink = (1 - 1 / np.sqrt(1 + sizes**2))[:, None]
            table = np.column_stack([white[rows, joint], jacobian[rows, joint]])
            table -= directions @ (shrink * (directions.T @ table))
            white[rows, joint], jacobian[rows, joint] = table[:, 0], table[:, 1:]
            determinants[number, joint] = 0.5 * np.log1p(sizes**2).sum() / len(rows)
    return white, jacobian, determinants
