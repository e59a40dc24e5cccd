"""Nested named tuples of arrays, or of symbols in a trace."""

from __future__ import annotations

from typing import Any

import numpy as np

from batchpid.arrays.array_types import Pytree
from batchpid.native.symbols import Symbol


def is_leaf(tree: Pytree) -> bool:
    """Return whether ``tree`` is an array, a symbol, or the place of one (``...``)."""
    return isinstance(tree, np.ndarray | Symbol) or tree is ...


def leaves(tree: Pytree) -> list[Any]:
    """Return the arrays in a nested tuple, in order."""
    if is_leaf(tree):
        return [tree]
    return [leaf for part in tree for leaf in leaves(part)] if isinstance(tree, tuple) else []


def mapped(function: Any, tree: Pytree) -> Any:
    """Return a nested tuple with ``function`` applied to its arrays."""
    if is_leaf(tree):
        return function(tree)
    if not isinstance(tree, tuple) or not tree:
        return tree
    parts = [mapped(function, part) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else type(tree)(parts)


def structure(tree: Pytree) -> Any:
    """Return a nested tuple with ``...`` in place of each array; it is hashable."""
    return mapped(lambda _: ..., tree)


def filled(tree: Pytree, given: Any) -> Any:
    """Return a structure with its places filled from an iterator."""
    return mapped(lambda _: next(given), tree)
