"""Digest of the content of values: equal for equal content, in any process and memory layout.

It is a SHA-256 over the digests of a value's parts, each with its type, so that the bytes of
different values differ. Values of unknown types are refused: their ``repr`` may omit content, or
contain an address.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.errors import InvalidArgumentError

_DTYPE_KINDS = "biufcSU"
"""Kinds of dtypes whose bytes are their content: no objects."""
_PADDED = (np.longdouble, np.clongdouble)
"""Types whose bytes hold padding, which is not content."""


def digest(*values: Array) -> str:
    """Return the digest of ``values``, 64 hexadecimal digits.

    Values may be None, bools, ints, floats, strings, bytes, arrays, and sequences, sets, mappings,
    named tuples and dataclasses of these. Numbers of different types, and arrays of different dtypes,
    have different digests. Byte order, strides, and the order of sets and mappings do not matter.
    Raises InvalidArgumentError for a value of another type, or an array of objects; the message
    names its place, such as ``[0]['kp']``.
    """
    return _digest(values, "").hex()


def _digest(value: Any, where: str) -> bytes:
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
        parts = {name: getattr(value, name) for name in names}
        return _hashed(title, _digest(parts, where))
    # The digests of parts all have the same length, so that no separator is needed.
    if kind in (list, tuple):
        entries = [_digest(part, f"{where}[{index}]") for index, part in enumerate(value)]
        return _hashed("sequence", b"".join(entries))
    if kind in (set, frozenset):
        return _hashed("set", b"".join(sorted(_digest(part, where) for part in value)))
    if isinstance(value, Mapping):
        # Sorted by digest, since keys of different types have no order.
        pairs = [
            _digest(key, where) + _digest(part, f"{where}[{key!r}]") for key, part in value.items()
        ]
        return _hashed("mapping", b"".join(sorted(pairs)))
    if hasattr(kind, "dtype"):
        title += f" of {value.dtype}"
    problem = f"is a {title}, which has no digest"
    remedy = "pass numbers, strings and arrays, or tuples, mappings and dataclasses of these"
    raise InvalidArgumentError(f"values{where}", problem, remedy=remedy)


def _hashed(kind: str, content: bytes) -> bytes:
    return hashlib.sha256(kind.encode() + b"\0" + content).digest()
