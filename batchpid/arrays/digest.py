"""Digest of the content of values: equal for equal content, in any process and memory layout.

It is a SHA-256 over the digests of a value's parts, each with its type, so that the bytes of
different values differ. Values of unknown types are refused: their ``repr`` may omit content, or
contain an address.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.errors import InvalidArgumentError

_KINDS = "biufcSU"
"""Kinds of dtypes whose bytes are their content: no objects, no padding."""
_WIDEST = {"f": 8, "c": 16}
"""Size [bytes] of the widest dtype of a kind without padding."""


def digest(*values: Array) -> str:
    """Return the digest of ``values``, 64 hexadecimal digits.

    Values may be None, bools, numbers, strings, bytes, arrays, and sequences, sets, mappings, named
    tuples and dataclasses of these. Numbers of different types, and arrays of different dtypes,
    have different digests. Byte order, strides, and the order of sets and mappings do not matter.
    Raises InvalidArgumentError for a value of another type, or an array of objects; the message
    names its place, such as ``[0].kp``.
    """
    return _of_parts(
        "values", [_digest(value, f"[{index}]") for index, value in enumerate(values)]
    ).hex()


def _digest(value: Any, where: str) -> bytes:
    # Exact types: a bool is an int, and must not have the digest of 1.
    kind = type(value)
    if value is None or kind in (bool, int, complex):
        return _of_bytes(kind.__name__, repr(value).encode())
    if kind is float:
        return _of_bytes("float", struct.pack("<d", value))
    if kind is str:
        return _of_bytes("str", value.encode("utf-8", "surrogatepass"))
    if kind is bytes:
        return _of_bytes("bytes", value)
    if isinstance(value, np.ndarray | np.generic):
        return _of_array(value, where)
    if isinstance(value, tuple) and (names := getattr(kind, "_fields", None)) is not None:
        return _of_fields(kind, dict(zip(names, value, strict=True)), where)
    if is_dataclass(value) and not isinstance(value, type):
        return _of_fields(
            kind, {entry.name: getattr(value, entry.name) for entry in fields(value)}, where
        )
    if kind in (list, tuple):
        return _of_parts(
            "sequence", [_digest(part, f"{where}[{index}]") for index, part in enumerate(value)]
        )
    if kind in (set, frozenset):
        return _of_parts("set", sorted(_digest(part, where) for part in value))
    if isinstance(value, Mapping):
        # Sorted by digest, since keys of different types have no order.
        pairs = [
            (_digest(key, where), _digest(part, f"{where}[{key!r}]")) for key, part in value.items()
        ]
        return _of_parts("mapping", [part for pair in sorted(pairs) for part in pair])
    if hasattr(value, "__array_namespace__"):
        return _of_array(np.asarray(value), where)
    raise InvalidArgumentError(
        f"values{where}",
        f"is a {kind.__module__}.{kind.__qualname__}, which has no digest",
        remedy=(
            "pass numbers, strings and arrays, or sequences, mappings, named tuples and dataclasses"
            " of these"
        ),
    )


def _of_array(array: Array, where: str) -> bytes:
    array = np.asarray(array)
    dtype = array.dtype.newbyteorder("<")
    if dtype.kind not in _KINDS or dtype.itemsize > _WIDEST.get(dtype.kind, dtype.itemsize):
        remedy = "pass an array of bools, numbers up to 64 bits, or strings"
        raise InvalidArgumentError(
            f"values{where}", f"is an array of {array.dtype}, which has no digest", remedy=remedy
        )
    # Equal numbers have one digest, whatever their byte order and strides.
    content = array.astype(dtype, order="C", copy=False).tobytes()
    head = _of_bytes("dtype", dtype.str.encode()), _of_bytes("shape", str(array.shape).encode())
    return _of_parts("array", [*head, _of_bytes("content", content)])


def _of_fields(kind: type, parts: Mapping[str, Any], where: str) -> bytes:
    name = _of_bytes("class", f"{kind.__module__}.{kind.__qualname__}".encode())
    results = [
        (_of_bytes("field", key.encode()), _digest(part, f"{where}.{key}"))
        for key, part in parts.items()
    ]
    return _of_parts("fields", [name, *(part for pair in results for part in pair)])


def _of_bytes(kind: str, content: bytes) -> bytes:
    return hashlib.sha256(kind.encode() + b"\0" + content).digest()


def _of_parts(kind: str, parts: list[bytes]) -> bytes:
    """Return the digest of digests, which all have the same length, so that no separator is
    needed.
    """
    return _of_bytes(kind, b"".join(parts))
