"""Trees of arrays: nested tuples, lists and mappings, whose leaves are arrays, symbols in a trace, or their places.

A program takes the leaves in order, a file and a snapshot take them by name. None is a tree without leaves. Numbers and
other values in a tree are constants: they have no place among the leaves in order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Document, Pytree


def is_leaf(tree: Pytree) -> bool:
    """Return whether ``tree`` is an array, a symbol, or the place of one (``...``)."""
    return tree is ... or (hasattr(tree, "__array_namespace__") and not isinstance(tree, np.generic))


def leaves(tree: Pytree) -> list[Any]:
    """Return the arrays in a tree of tuples, in order."""
    if is_leaf(tree):
        return [tree]
    return [leaf for part in tree for leaf in leaves(part)] if isinstance(tree, tuple) else []


def mapped(function: Callable[[Any], Any], tree: Pytree) -> Any:
    """Return a tree of tuples with ``function`` applied to its arrays."""
    if is_leaf(tree):
        return function(tree)
    return _rebuilt(tree, [mapped(function, part) for part in tree]) if isinstance(tree, tuple) and tree else tree


def structure(tree: Pytree) -> Any:
    """Return a tree of tuples with ``...`` in place of each array; it is hashable."""
    return mapped(lambda _: ..., tree)


def filled(tree: Pytree, given: Iterator[Any]) -> Any:
    """Return a structure with its places filled from an iterator."""
    return mapped(lambda _: next(given), tree)


def flatten(tree: Pytree, separator: str = "/", read: Callable[[Any], Array] = np.asarray, name: str = "") -> Document:
    """Return all values in a tree, as ``read`` makes arrays of them, by name: keys and fields, joined by ``separator``.

    A tree that is a value itself has the name "state".
    """
    if tree is None:
        return {}
    if not isinstance(tree, Mapping | tuple | list):
        return {name or "state": read(tree)}
    named: Document = {}
    for key, part in _parts(tree).items():
        named |= flatten(part, separator, read, f"{name}{separator}{key}" if name else key)
    return named


def unflatten(like: Pytree, named: Mapping[str, Array], separator: str = "/", name: str = "") -> Any:
    """Return a tree of the structure of ``like`` with the arrays of :func:`flatten`."""
    if like is None:
        return None
    if not isinstance(like, Mapping | tuple | list):
        return named[name or "state"]
    parts = [
        unflatten(part, named, separator, f"{name}{separator}{key}" if name else key)
        for key, part in _parts(like).items()
    ]
    return _rebuilt(like, parts)


def _parts(tree: Pytree) -> Document:
    """Return the parts of a mapping, tuple or list by name."""
    if isinstance(tree, Mapping):
        return {str(key): part for key, part in tree.items()}
    return dict(zip(getattr(tree, "_fields", map(str, range(len(tree)))), tree, strict=True))


def _rebuilt(like: Pytree, parts: list[Any]) -> Any:
    """Return a tree of the kind of ``like`` with other parts."""
    if isinstance(like, Mapping):
        return dict(zip(like, parts, strict=True))
    return type(like)(*parts) if hasattr(like, "_fields") else type(like)(parts)
