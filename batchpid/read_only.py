"""Read-only arrays, for what belongs to an object and is handed out without a copy."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")


def read_only(array: T) -> T:
    """Return a view of a NumPy array that cannot be written to; anything else as it is."""
    if not isinstance(array, np.ndarray):
        return array
    view: Any = array.view()
    view.flags.writeable = False
    return view
