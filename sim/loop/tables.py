"""Tables of arrays by name: groups of them, and rows of different lengths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Document, Rows


def flatten(groups: Mapping[str, Any]) -> dict[str, Rows]:
    """Return all arrays by name; a group's arrays as "group.name"."""
    tables: dict[str, Rows] = {}
    for name, value in groups.items():
        tables |= {f"{name}.{leaf}": rows for leaf, rows in value.items()} if isinstance(value, dict) else {name: value}
    return tables


def nest(tables: Mapping[str, Rows]) -> Document:
    """Return the groups of :func:`flatten`."""
    groups: Document = {
        name: {} for name in ("controller", "friction", "actuators", "guard", "containment", "sensors", "pushes")
    }
    for name, rows in tables.items():
        group, dot, leaf = name.partition(".")
        if dot:
            groups.setdefault(group, {})[leaf] = rows
        else:
            groups[name] = rows
    return groups


def widen(rows: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return ``rows`` (envs, n) with ``width`` columns, the new ones NaN."""
    return np.pad(rows, ((0, 0), (0, width - rows.shape[1])), constant_values=np.nan)
