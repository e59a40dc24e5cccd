"""Elementwise operations of the law, for NumPy and JAX arrays."""

from __future__ import annotations

import math
from functools import cache
from types import NoneType
from typing import Any

import numpy as np

from batchpid.arrays.choices import CHOICE_TYPES

TURN = 2 * math.pi
_NUMPY_OR_NEUTRAL = frozenset({np.ndarray, NoneType, float, int, *CHOICE_TYPES})


def namespace(*leaves: Any) -> Any:
    """Return the array namespace in which all these leaves can be used: NumPy's, unless one belongs to another."""
    if not _NUMPY_OR_NEUTRAL.issuperset(map(type, leaves)):
        for leaf in leaves:
            if not isinstance(leaf, np.ndarray) and hasattr(leaf, "__array_namespace__"):
                return leaf.__array_namespace__()
    return np


def clip(x: Any, low: Any, high: Any, xp: Any) -> Any:
    """Return x within [low, high], either of which may be None; NaN stays NaN."""
    x = x if low is None else xp.maximum(x, low)
    return x if high is None else xp.minimum(x, high)


def multiply(matrix: Any, vector: Any) -> Any:
    """Return matrix @ vector for each env, with sums in one order for any number of envs."""
    return (matrix * vector[:, None, :]).sum(-1)


def replace_envs(state: Any, fresh: Any, mask: Any) -> Any:
    """Return ``state``, a named tuple of arrays (envs, ...), with the envs of ``mask`` (envs,) bool as in ``fresh``."""
    xp = namespace(*state, mask)
    chosen = xp.asarray(mask)

    def choose(new: Any, old: Any) -> Any:
        return None if old is None else xp.where(chosen.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return type(state)(*map(choose, fresh, state))


def wrap(angle: Any, turns_per_rad: Any, xp: Any) -> Any:
    """Return an angle or a difference of angles, less its whole turns; ``turns_per_rad`` is 0 to keep them."""
    return angle if turns_per_rad is None else angle - TURN * xp.rint(angle * turns_per_rad)


def nearest_turn(angle: Any, near: Any, turns_per_rad: Any, xp: Any) -> Any:
    """Return ``angle`` plus the whole turns that bring it within half a turn of ``near``; other arguments as in
    :func:`wrap`.
    """
    return angle if turns_per_rad is None else angle - TURN * xp.rint((angle - near) * turns_per_rad)


def flush(x: Any, tiny: Any) -> Any:
    """Return x rounded to a multiple of the last bit of ``tiny``, which leaves larger numbers unchanged.

    A decaying filter ends in denormal numbers, whose arithmetic is ten times slower. Adding and subtracting a tiny
    number costs two additions and no branch.
    """
    return (x + tiny) - tiny


@cache
def tiny_of(dtype: Any) -> float:
    """Return the square root of the smallest normal number of ``dtype``.

    Its last bit is far above the denormals, and the number itself far below the last bit of any relevant number.
    """
    return float(np.sqrt(np.finfo(dtype).tiny))
