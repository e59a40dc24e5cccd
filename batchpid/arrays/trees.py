"""Trees of arrays: nested tuples, lists, mappings and dataclasses. A leaf is an array, a traced
symbol, or a placeholder (``...``).

Programs take the leaves of a tree of tuples and dataclasses in order: :func:`leaves`, :func:`mapped`,
:func:`structure` and :func:`filled`. Numbers and other values are constants there, not leaves.
Files and snapshots take all values by name: :func:`flatten` and :func:`unflatten`. None is a tree
without leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass

import numpy as np

from batchpid.arrays.array_types import Array, Document, Pytree


def is_leaf(tree: Pytree) -> bool:
    """Return whether ``tree`` is an array, a symbol, or a placeholder (``...``)."""
    return tree is ... or (
        hasattr(tree, "__array_namespace__") and not isinstance(tree, np.generic)
    )


def leaves(tree: Pytree) -> list[Pytree]:
    """Return the leaves of a tree of tuples and dataclasses, in order."""
    if is_leaf(tree):
        return [tree]
    if isinstance(tree, tuple):
        return [leaf for part in tree for leaf in leaves(part)]
    if is_dataclass(tree):
        return leaves(tuple(vars(tree).values()))
    return []


def mapped(function: Callable[[Pytree], Pytree], tree: Pytree) -> Pytree:
    """Return a tree of tuples and dataclasses with ``function`` applied to its leaves."""
    if is_leaf(tree):
        return function(tree)
    if isinstance(tree, tuple) and tree:
        return rebuilt_as(tree, [mapped(function, part) for part in tree])
    if is_dataclass(tree):
        kind: Callable[..., Pytree] = type(tree)
        return kind(*[mapped(function, part) for part in vars(tree).values()])
    return tree


def structure(tree: Pytree) -> Pytree:
    """Return a tree with ``...`` in place of each leaf; the result is hashable."""
    return mapped(lambda _: ..., tree)


def filled(tree: Pytree, given: Iterator[Pytree]) -> Pytree:
    """Return a :func:`structure` with its placeholders replaced by values of ``given``, in
    order.
    """
    return mapped(lambda _: next(given), tree)


def flatten(
    tree: Pytree,
    separator: str = "/",
    read: Callable[[Pytree], Array] = np.asarray,
    name: str = "",
) -> Document:
    """Return all values in a tree by name, converted to arrays by ``read``.

    A name consists of the keys and fields on the way to the value, joined by ``separator``. A tree
    that is one value has the name "state".
    """
    if tree is None:
        return {}
    if not isinstance(tree, Mapping | tuple | list):
        return {name or "state": read(tree)}
    # Keys on the way become the name.
    named: Document = {}
    for key, part in parts(tree).items():
        named |= flatten(part, separator, read, f"{name}{separator}{key}" if name else key)
    return named


def unflatten(
    like: Pytree,
    named: Mapping[str, Array],
    separator: str = "/",
    name: str = "",
) -> Pytree:
    """Return a tree with the structure of ``like`` from the arrays that :func:`flatten`
    returned.
    """
    if like is None:
        return None
    if not isinstance(like, Mapping | tuple | list):
        return named[name or "state"]
    rebuilt = [
        unflatten(part, named, separator, f"{name}{separator}{key}" if name else key)
        for key, part in parts(like).items()
    ]
    return rebuilt_as(like, rebuilt)


def parts(tree: Pytree) -> Document:
    """Return the parts of a mapping, tuple or list by name."""
    if isinstance(tree, Mapping):
        return {str(key): part for key, part in tree.items()}
    return dict(zip(getattr(tree, "_fields", map(str, range(len(tree)))), tree, strict=True))


def rebuilt_as(like: Pytree, parts: list[Pytree]) -> Pytree:
    """Return a mapping, tuple or list of the type of ``like`` with other parts."""
    if isinstance(like, Mapping):
        return dict(zip(like, parts, strict=True))
    if hasattr(like, "_fields"):
        return type(like)(*parts)
    return type(like)(parts)
