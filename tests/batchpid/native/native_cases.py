"""Numbers of all kinds, and comparison to the last bit."""

import numpy as np


def bits(leaf):
    """Return dtype, shape and bits of an array, with one NaN for all."""
    return (
        None
        if leaf is None
        else (leaf.dtype, leaf.shape, np.where(np.isnan(leaf), np.nan, leaf).tobytes())
    )


def numbers(rng, shape, odd, dtype):
    """Return numbers of many sizes; a share ``odd`` of them is zero, infinite or not a number."""
    values = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 3, shape)
    special = rng.choice([0.0, -0.0, np.inf, -np.inf, np.nan], shape)
    return np.where(rng.random(shape) < odd, special, values).astype(dtype)
