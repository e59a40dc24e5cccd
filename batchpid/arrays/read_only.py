"""Read-only views of arrays that an object owns and returns without a copy."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

T = TypeVar("T")


def read_only(array: T) -> T:
    """Return a read-only view of a NumPy array; return any other object unchanged."""
    if not isinstance(array, np.ndarray):
        return array
    view = array.view()
    view.flags.writeable = False
    return view
