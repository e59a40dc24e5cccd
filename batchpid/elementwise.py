"""The elementwise operations that the law is written in, for NumPy and JAX alike."""

from __future__ import annotations

import math
from functools import cache
from types import NoneType
from typing import Any

import numpy as np

from batchpid.choices import CHOICE_TYPES

TURN = 2 * math.pi
_NUMPY_OR_NEUTRAL = frozenset({np.ndarray, NoneType, float, int, *CHOICE_TYPES})


def namespace(*leaves: Any) -> Any:
    """Return the array namespace in which all these leaves can be used: NumPy's, unless one belongs elsewhere."""
    if not _NUMPY_OR_NEUTRAL.issuperset(map(type, leaves)):
        for leaf in leaves:
            if not isinstance(leaf, np.ndarray) and hasattr(leaf, "__array_namespace__"):
                return leaf.__array_namespace__()
    return np


def clip(x: Any, low: Any, high: Any, xp: Any) -> Any:
    """Return x within [low, high], either of which may be None; NaN stays NaN."""
    if low is not None:
        x = xp.maximum(x, low)
    if high is not None:
        x = xp.minimum(x, high)
    return x


def wrap(angle: Any, turns_per_rad: Any, xp: Any) -> Any:
    """Return an angle, or a difference of two, less its whole turns; ``turns_per_rad`` is 0 where none are taken."""
    return angle if turns_per_rad is None else angle - TURN * xp.rint(angle * turns_per_rad)


def flush(x: Any, tiny: Any) -> Any:
    """Return x rounded to a multiple of the last bit of ``tiny``, which leaves larger numbers as they are.

    Arithmetic on denormal numbers is ten times slower, and a decaying filter ends there. Adding and taking away a
    tiny number costs two additions, and no branch.
    """
    return (x + tiny) - tiny


@cache
def tiny_of(dtype: Any) -> float:
    """Return the square root of the smallest normal number.

    Its last bit is far above the denormals, and itself far below the last bit of any number that matters.
    """
    return float(np.sqrt(np.finfo(dtype).tiny))
