r"""Gaussian noise from counters: a function of seed, env, episode, step and joint, and of nothing
else.

The hash is pcg4d (M. Jarzynski and M. Olano, "Hash functions for GPU rendering", Journal of
Computer Graphics Techniques 9, 2020), on four words of 32 bits each. 16 bits i of its result choose
a quantile of the normal distribution from a table::

    z = c Phi^-1((i + 1/2) / 2^16)          i = 0, ..., 2^16 - 1, c such that the variance is 1

So there are 65,536 equally likely values, up to 4.3 standard deviations, and not a function whose
last bits depend on the library. The mean is 0 and the kurtosis 3 to within 3e-3.
"""

from __future__ import annotations

from functools import cache
from statistics import NormalDist

import numpy as np

from batchpid.arrays.array_types import Array, ArrayModule, DType, Rows

_FACTOR, _SUMMAND = np.uint32(1664525), np.uint32(1013904223)
_HALF = np.uint32(16)


@cache
def quantiles(dtype: DType) -> Rows:
    """Return the values of z in ascending order (65536,), read-only: all callers share them."""
    inverse = NormalDist().inv_cdf
    upper = np.array([inverse((i + 0.5) / 2**16) for i in range(2**15, 2**16)])
    upper /= np.sqrt((upper**2).mean())
    # One half is the mirror of the other, so the mean is 0.
    table = np.concatenate((-upper[::-1], upper)).astype(dtype)
    table.setflags(write=False)
    return table


def pcg4d(
    x: Array,
    y: Array,
    z: Array,
    w: Array,
) -> tuple[Array, Array, Array, Array]:
    """Return four hashed words of uint32 arrays that broadcast against each other."""
    x, y, z, w = (word * _FACTOR + _SUMMAND for word in (x, y, z, w))
    for is_last in (False, True):
        x = x + y * w
        y = y + z * x
        z = z + x * y
        w = w + y * z
        if not is_last:
            x, y, z, w = (word ^ (word >> _HALF) for word in (x, y, z, w))
    return x, y, z, w


def keys(
    seed: Array,
    envs: Array,
    episode: Array,
    xp: ArrayModule,
) -> Array:
    """Return the key of each env's noise (..., 2) uint32, from a ``seed`` (2,) or (1, 2) uint32
    and numbers (...).
    """
    words = (xp.asarray(number).astype(xp.uint32) for number in (envs, episode))
    return xp.stack(pcg4d(seed[..., 0], seed[..., 1], *words)[:2], axis=-1)


def normals(
    key: Array,
    step: Array,
    joints: int,
    dtype: DType,
    xp: ArrayModule,
) -> tuple[Array, Array]:
    """Return two independent standard normal numbers for each step, env and joint.

    ``key`` is (envs, 2), ``step`` (..., envs) uint32; the results are (..., envs, joints).
    """
    # With the axes of the key, whose ranks JAX does not promote in its strict mode.
    joint = xp.arange(joints, dtype=xp.uint32).reshape(*[1] * (key.ndim - 1), joints)
    table = xp.asarray(quantiles(np.dtype(dtype)))
    first, second, *_ = pcg4d(
        key[..., :1],
        key[..., 1:],
        step[..., None],
        joint,
    )
    return table.take(first >> _HALF), table.take(second >> _HALF)
