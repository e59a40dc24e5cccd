"""Short representations of params, states and other tuples of arrays."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.checks.validate import is_traced

WIDTH = 130


def span(values: Array) -> str:
    """Return the range of an array's entries, as in "40 to 87"; "3 of 12" for bools."""
    if is_traced(values):
        return "traced"
    try:
        array = np.asarray(values)
        if array.dtype == bool:
            return f"{array.sum()} of {array.size}"
        # The range is that of the other entries; "nan" follows it.
        present = array[~np.isnan(array)]
    except (TypeError, ValueError, RuntimeError):
        return type(values).__name__
    parts = []
    if present.size:
        parts.append(" to ".join(dict.fromkeys(f"{e:.4g}" for e in (present.min(), present.max()))))
    if present.size < array.size:
        parts.append("nan")
    return " or ".join(parts) or "empty"


def summary(name: str, parts: Iterable[str]) -> str:
    """Return ``name(part, part, ...)``, on as many lines as needed."""
    return "\n".join(
        textwrap.wrap(
            f"{name}({', '.join(parts)})", WIDTH, subsequent_indent="    ", break_on_hyphens=False
        )
    )


def array_summary(arrays: Any, *axes: str) -> str:
    """Return the type of a named tuple, the sizes of the ``axes`` of its arrays, and the range of
    each.
    """
    leaves = {name: leaf for name, leaf in arrays._asdict().items() if leaf is not None}
    ranges = [
        f"{name} {type(leaf).__name__ if isinstance(leaf, tuple) else span(leaf)}"
        for name, leaf in leaves.items()
    ]
    return summary(type(arrays).__name__, [*_sizes(arrays, axes), *ranges])


def _sizes(leaves: Iterable[Any], axes: tuple[str, ...]) -> list[str]:
    """Return the largest size of each axis with its name, as in ["64 envs", "9 joints"]."""
    shapes = [leaf.shape for leaf in leaves if len(getattr(leaf, "shape", ())) == len(axes)]
    sizes = (max(lengths) for lengths in zip(*shapes, strict=True))
    return [
        f"{size} {axis if size != 1 else axis[:-1]}"
        for size, axis in zip(sizes, axes, strict=False)
    ]
