r"""Trees of arrays: nested tuples, lists, mappings and dataclasses. A leaf is an array, a traced
symbol, or a placeholder (``...``).

Programs take the leaves of a tree of tuples, mappings and dataclasses in order: :func:`leaves`,
:func:`mapped`, :func:`structure` and :func:`filled`. Numbers and other values are constants there, not leaves.
Files and snapshots take all values by name: :func:`walked`, :func:`flatten` and :func:`unflatten`. None is a tree
without leaves.

A :func:`digest` of values is equal for equal content, in any process and memory layout. It is a
SHA-256 over the digests of a value's parts, each with its type, so that the bytes of
different values differ. Values of unknown types are refused: their ``repr`` may omit content, or
contain an address.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Document, Pytree
from batchpid.errors import InvalidArgumentError


def is_leaf(tree: Pytree) -> bool:
    """Return whether ``tree`` is an array, a symbol, or a placeholder (``...``)."""
    return tree is ... or (
        hasattr(tree, "__array_namespace__") and not isinstance(tree, np.generic)
    )


def leaves(tree: Pytree) -> list[Pytree]:
    """Return the leaves of a tree of tuples, mappings and dataclasses, in order."""
    if is_leaf(tree):
        return [tree]
    if isinstance(tree, tuple):
        return [leaf for part in tree for leaf in leaves(part)]
    if isinstance(tree, dict):
        return leaves(tuple(tree.values()))
    if is_dataclass(tree):
        return leaves(tuple(vars(tree).values()))
    return []


def mapped(function: Callable[[Pytree], Pytree], tree: Pytree) -> Pytree:
    """Return a tree of tuples, mappings and dataclasses with ``function`` applied to its leaves."""
    if is_leaf(tree):
        return function(tree)
    if isinstance(tree, tuple) and tree:
        return rebuilt_as(tree, [mapped(function, part) for part in tree])
    if isinstance(tree, dict):
        return {name: mapped(function, part) for name, part in tree.items()}
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


def walked(function: Callable[[str, Pytree], Pytree], tree: Pytree, name: str = "") -> Pytree:
    """Return a tree with ``function(name, value)`` in place of each value; None stays.

    A name consists of the keys and fields on the way to the value, joined by "/". A tree that is one
    value has the name "state".
    """
    if tree is None:
        return None
    if not isinstance(tree, Mapping | tuple | list):
        return function(name or "state", tree)
    # Keys on the way become the name.
    rebuilt = [
        walked(function, part, f"{name}/{key}" if name else key)
        for key, part in parts(tree).items()
    ]
    return rebuilt_as(tree, rebuilt)


def flatten(tree: Pytree, read: Callable[[Pytree], Array] = np.asarray) -> Document:
    """Return all values in a tree by the names of :func:`walked`, converted to arrays by ``read``."""
    named: Document = {}
    walked(lambda name, value: named.update({name: read(value)}), tree)
    return named


def unflatten(like: Pytree, named: Mapping[str, Array], name: str = "") -> Pytree:
    """Return a tree with the structure of ``like`` from the arrays that :func:`flatten`
    returned.
    """
    return walked(lambda name, _: named[name], like, name)


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


_DTYPE_KINDS = "biufcSU"
"""Kinds of dtypes whose bytes are their content: no objects."""
_PADDED = (np.longdouble, np.clongdouble)
"""Types whose bytes hold padding, which is not content."""


def digest(*values: Array) -> str:
    """Return the digest of ``values``, 64 hexadecimal digits.

    Values may be None, bools, ints, floats, strings, bytes, arrays, and sequences, sets, mappings,
    named tuples and dataclasses of these. Numbers of different types, and arrays of different dtypes,
    have different digests. Byte order, strides, and the order of sets and mappings do not matter.
    Raises InvalidArgumentError for a value of another type, or an array of objects.
    """
    return _digest(values).hex()


def _digest(value: Any) -> bytes:
    # Exact types: a bool is an int, and must not have the digest of 1.
    kind = type(value)
    if value is None or kind in (bool, int, float, str):
        return _hashed(kind.__name__, repr(value).encode())
    if kind is bytes:
        return _hashed("bytes", value)
    if hasattr(value, "__array_namespace__"):
        # Byte order and strides do not change the digest.
        array = np.asarray(value)
        dtype = array.dtype.newbyteorder("<")
        if dtype.kind in _DTYPE_KINDS and dtype.type not in _PADDED:
            content = array.astype(dtype, order="C", copy=False).tobytes()
            return _hashed(f"{dtype.str} {array.shape}", content)
    title = f"{kind.__module__}.{kind.__qualname__}"
    names = getattr(kind, "_fields", getattr(kind, "__dataclass_fields__", None))
    if names is not None:
        return _hashed(title, _digest({name: getattr(value, name) for name in names}))
    # The digests of parts all have the same length, so that no separator is needed.
    if kind in (list, tuple):
        return _hashed("sequence", b"".join(map(_digest, value)))
    if kind in (set, frozenset):
        return _hashed("set", b"".join(sorted(map(_digest, value))))
    if isinstance(value, Mapping):
        # Sorted by digest, since keys of different types have no order.
        pairs = (_digest(key) + _digest(part) for key, part in value.items())
        return _hashed("mapping", b"".join(sorted(pairs)))
    problem = f"is a {title}, which has no digest"
    remedy = "pass numbers, strings and arrays, or tuples, mappings and dataclasses of these"
    raise InvalidArgumentError("values", problem, remedy=remedy)


def _hashed(kind: str, content: bytes) -> bytes:
    return hashlib.sha256(kind.encode() + b"\0" + content).digest()
