"""Short representations of params, states and other tuples of arrays."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.choices import CHOICE_TYPES, CHOICES
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
        known = array[~np.isnan(array)]
    except (TypeError, ValueError, RuntimeError):
        return type(values).__name__
    ends = dict.fromkeys(f"{end:.4g}" for end in (known.min(), known.max())) if known.size else ()
    parts = [" to ".join(ends)] if ends else []
    return " or ".join([*parts, "nan"] if known.size < array.size else parts) or "empty"


def summary(name: str, parts: Iterable[str]) -> str:
    """Return ``name(part, part, ...)``, on as many lines as needed."""
    return "\n".join(
        textwrap.wrap(f"{name}({', '.join(parts)})", WIDTH, subsequent_indent="    ", break_on_hyphens=False)
    )


def array_summary(arrays: Any, *axes: str) -> str:
    """Return the type of a named tuple of arrays, the sizes of their ``axes``, and the range of each."""
    ranges = [f"{name} {span(leaf)}" for name, leaf in arrays._asdict().items() if _is_array(leaf)]
    return summary(type(arrays).__name__, [*_sizes(arrays, axes), *ranges])


def params_summary(params: Any) -> str:
    """Return the joints of params, and the options that are on with their ranges."""
    rest = {name: leaf for name, leaf in params._asdict().items() if leaf is not None}
    sizes = [size for size in _sizes(params, ("envs", "joints")) if size != "1 env"]
    parts = [*reversed(sizes), *(f"{name} {span(rest.pop(name))}" for name in ("kp", "ki", "kd") if name in rest)]
    for name in ("effort", "integral"):
        low, high = rest.pop(f"{name}_min", None), rest.pop(f"{name}_max", None)
        parts += _limits(name, low, high)
    back, conditional = rest.pop("tracking_time", None), rest.pop("conditional", None)
    chosen = ["back-calculation"] * (back is not None) + ["conditional"] * (conditional is not None)
    parts += [f"anti-windup {' and '.join(chosen)}"] if chosen else []
    if isinstance(mask := rest.get("continuous"), np.ndarray):
        rest["continuous"] = mask > 0
    for name, leaf in rest.items():
        parts.append(f"{name.replace('_', ' ')} {span(leaf) if _is_array(leaf) else _named(name, leaf)}")
    return summary(type(params).__name__, parts)


def _limits(name: str, low: Array, high: Array) -> list[str]:
    if low is None or high is None:
        return [f"{name} {sign} {span(end)}" for sign, end in ((">=", low), ("<=", high)) if end is not None]
    try:
        symmetric = np.array_equal(np.negative(low), high)
    except TypeError:  # traced
        symmetric = False
    if symmetric:
        return [f"{name} within ±{span(high).replace(' to ', ' to ±')}"]
    return [f"{name} from {span(low)} up to {span(high)}"]


def _named(option: str, chosen: Any) -> str:
    """Return the name of a choice."""
    return next(name for name, one in CHOICES[option].items() if type(one) is type(chosen))


def _is_array(leaf: Array) -> bool:
    return leaf is not None and not isinstance(leaf, CHOICE_TYPES)


def _sizes(leaves: Iterable[Any], axes: tuple[str, ...]) -> list[str]:
    """Return the largest size of each axis with its name, as in ["64 envs", "9 joints"]."""
    shapes = [leaf.shape for leaf in leaves if len(getattr(leaf, "shape", ())) == len(axes)]
    sizes = (max(lengths) for lengths in zip(*shapes, strict=True))
    return [f"{size} {axis if size != 1 else axis[:-1]}" for size, axis in zip(sizes, axes, strict=False)]
