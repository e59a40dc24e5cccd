"""Digest of the content of values: equal for equal content, in any process and memory layout.

It is a SHA-256 over the digests of a value's parts, each with its type, so that the bytes of different values differ.
Values of unknown types are refused: their ``repr`` may omit content, or contain an address.
"""

from __future__ import annotations

import hashlib
import os
import struct
import sys
import sysconfig
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache, cached_property
from operator import itemgetter
from types import CellType, CodeType, FunctionType, MappingProxyType, ModuleType
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.errors import BatchPIDError, InvalidArgumentError

DEPTH, OBJECTS = 60, 20_000
"""Levels and number of objects that :func:`object_digest` looks at."""

_KINDS = "biufcSU"
"""Kinds of dtypes whose bytes are their content: no objects, no padding."""
_WIDEST = {"f": 8, "c": 16}
"""Size [bytes] of the widest dtype of a kind without padding."""
_CODE = (
    "co_code", "co_consts", "co_names", "co_freevars", "co_cellvars", "co_flags", "co_argcount",
    "co_posonlyargcount", "co_kwonlyargcount", "co_exceptiontable",
)  # fmt: skip
"""Attributes of a code that its calls depend on: no names of files, no lines."""
_OF_EVERY_CLASS = {
    "__module__", "__qualname__", "__doc__", "__dict__", "__weakref__", "__annotations__", "__abstractmethods__",
    "_abc_impl", "__dataclass_fields__", "__dataclass_params__", "__match_args__", "__parameters__",
    "__firstlineno__", "__static_attributes__", "__annotate__", "__annotate_func__", "__annotations_cache__",
}  # fmt: skip
"""Attributes of a class that its calls do not depend on."""


def digest(*values: Array) -> str:
    """Return the digest of ``values``, 64 hexadecimal digits.

    Values may be None, bools, numbers, strings, bytes, arrays, and sequences, sets, mappings, named tuples and
    dataclasses of these. Numbers of different types, and arrays of different dtypes, have different digests. Byte
    order, strides, and the order of sets and mappings do not matter. Raises InvalidArgumentError for a value of another
    type, or an array of objects; the message names its place, such as ``[0].kp``.
    """
    return _of_parts("values", [_digest(value, f"[{index}]") for index, value in enumerate(values)]).hex()


def object_digest(value: object) -> str:
    """Return the digest of an object or function of the caller's: of all that its calls depend on.

    - A function counts by its code, constants, defaults, closure, attributes, and the globals that it names; a class by
      its bases, functions and attributes. Functions and classes of batchpid, of Python and of installed packages count
      by their names, and by the closure, so that a function in a wrapper counts.
    - An object counts by its class and by the state that pickle would save, without ``cached_property``. An object
      without such a state (a lock, an open file) counts by its type, as do those deeper than :data:`DEPTH` levels or
      beyond the first :data:`OBJECTS`.

    It is equal in another process of the same Python version.
    """
    return _ObjectDigest().of(value).hex()


class _ObjectDigest:
    """Walk through the objects that one value reaches; each is read once, so that it ends in any graph."""

    def __init__(self) -> None:
        self._known: dict[int, bytes] = {}
        self._open: list[int] = []
        """Objects that contain the present one, from the outermost on."""
        self._kept: list[Any] = []
        """All objects of ``_known``: the id of an object that is gone may be another's."""

    def of(self, value: Any) -> bytes:
        """Return the digest of ``value``."""
        kind = type(value)
        if value is None or kind in (bool, int, float, complex, str, bytes):
            return _digest(value, "")
        if hasattr(kind, "__array__"):
            try:
                return _of_array(np.asarray(value), "")
            except Exception:  # of objects, or a type that cannot be read here
                pass
        if (found := self._known.get(id(value))) is not None:
            return found
        if id(value) in self._open:
            return _of_bytes("outer", str(len(self._open) - self._open.index(id(value))).encode())
        if len(self._open) >= DEPTH or len(self._known) >= OBJECTS:
            return _of_bytes("type", _name(kind))
        self._open.append(id(value))
        self._kept.append(value)
        try:
            found = self._known[id(value)] = self._content(value)
        finally:
            self._open.pop()
        return found

    def _content(self, value: Any) -> bytes:
        kind = type(value)
        if kind in (list, tuple):
            return self._parts("sequence", *value)
        if kind in (set, frozenset):
            return _of_parts("set", sorted(map(self.of, value)))
        if kind in (dict, OrderedDict, MappingProxyType):
            return self._mapping(value)
        if isinstance(value, CodeType):
            return self._parts("code", *(getattr(value, name) for name in _CODE))
        if isinstance(value, FunctionType):
            return self._function(value)
        if isinstance(value, CellType):
            return self._parts("cell", *_contents(value))
        if isinstance(value, ModuleType):
            return _of_bytes("module", value.__name__.encode())
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, property | staticmethod | classmethod):
            names = ("fget", "fset", "fdel") if isinstance(value, property) else ("__func__",)
            return self._parts(kind.__name__, *(getattr(value, name) for name in names))
        if "__wrapped__" in getattr(value, "__dict__", ()):  # of functools and jax
            return self._parts("wrapper", _name(kind), vars(value)["__wrapped__"])
        return self._parts("object", kind, _state(value))

    def _parts(self, label: str, *parts: Any) -> bytes:
        return _of_parts(label, [self.of(part) for part in parts])

    def _mapping(self, value: Mapping[Any, Any]) -> bytes:
        pairs = sorted(((self.of(key), part) for key, part in value.items()), key=itemgetter(0))
        return _of_parts("mapping", [each for key, part in pairs for each in (key, self.of(part))])

    def _function(self, function: FunctionType) -> bytes:
        defaults = function.__defaults__, function.__kwdefaults__, vars(function)
        parts = [*defaults, function.__closure__]
        if _is_installed(function.__globals__.get("__name__")):
            return self._parts("installed", _name(function), *parts)
        named = {name: function.__globals__[name] for name in _names(function.__code__) & function.__globals__.keys()}
        return self._parts("function", function.__code__, named, *parts)

    def _class(self, kind: type) -> bytes:
        if _is_installed(kind.__module__):
            return _of_bytes("class", _name(kind))
        own = {name: each for name, each in vars(kind).items() if name not in _OF_EVERY_CLASS}
        return self._parts("class", kind.__qualname__, list(kind.__bases__), own)


def _state(value: Any) -> Any:
    """Return the state of an object as pickle would save it; None if it has none that can be read."""
    kind = type(value)
    if kind.__module__.partition(".")[0] == "batchpid" and hasattr(kind, "describe"):
        return value.describe(), getattr(value, "actuators", None)  # a robot, independent of its folder
    try:
        reduced = value.__reduce_ex__(4)
    except BatchPIDError:  # a runner
        return None
    except Exception:
        reduced = (None, None, getattr(value, "__dict__", None))
    if isinstance(reduced, str):
        return reduced
    made, arguments, state, *items = (*reduced, None)[: max(3, len(reduced))]
    if isinstance(state, dict) and state.keys() <= getattr(value, "__dict__", {}).keys():
        state = {name: each for name, each in state.items() if not isinstance(_of_class(kind, name), cached_property)}
    return made, arguments, state, [list(each) if isinstance(each, Iterator) else each for each in items]


def _of_class(kind: type, name: str) -> Any:
    """Return an attribute of a class as it was defined."""
    return next((vars(each)[name] for each in kind.__mro__ if name in vars(each)), None)


def _contents(cell: CellType) -> tuple[Any, ...]:
    try:
        return (cell.cell_contents,)
    except ValueError:  # not assigned yet
        return ()


def _names(code: CodeType) -> set[str]:
    """Return the names of globals and attributes in a code, and in the functions within."""
    return {*code.co_names}.union(*(_names(part) for part in code.co_consts if isinstance(part, CodeType)))


def _name(value: Any) -> bytes:
    return f"{value.__module__}.{value.__qualname__}".encode()


def _is_installed(module: Any) -> bool:
    """Return whether a module belongs to batchpid, to Python or to an installed package."""
    if not isinstance(module, str) or module == "__main__" or module not in sys.modules:
        return False
    file = getattr(sys.modules[module], "__file__", None)
    return file is None or module.partition(".")[0] == "batchpid" or file.startswith(_folders())


def _digest(value: Any, where: str) -> bytes:
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
        return _of_fields(kind, {each.name: getattr(value, each.name) for each in fields(value)}, where)
    if kind in (list, tuple):
        return _of_parts("sequence", [_digest(part, f"{where}[{index}]") for index, part in enumerate(value)])
    if kind in (set, frozenset):
        return _of_parts("set", sorted(_digest(part, where) for part in value))
    if isinstance(value, Mapping):
        pairs = [(_digest(key, where), _digest(part, f"{where}[{key!r}]")) for key, part in value.items()]
        return _of_parts("mapping", [part for pair in sorted(pairs) for part in pair])
    if hasattr(value, "__array_namespace__"):
        return _of_array(np.asarray(value), where)
    raise InvalidArgumentError(
        f"values{where}",
        f"is a {kind.__module__}.{kind.__qualname__}, which has no digest",
        remedy="pass numbers, strings and arrays, or sequences, mappings, named tuples and dataclasses of these",
    )


def _of_array(array: Array, where: str) -> bytes:
    array = np.asarray(array)
    dtype = array.dtype.newbyteorder("<")
    if dtype.kind not in _KINDS or dtype.itemsize > _WIDEST.get(dtype.kind, dtype.itemsize):
        remedy = "pass an array of bools, numbers up to 64 bits, or strings"
        raise InvalidArgumentError(
            f"values{where}", f"is an array of {array.dtype}, which has no digest", remedy=remedy
        )
    content = array.astype(dtype, order="C", copy=False).tobytes()
    head = _of_bytes("dtype", dtype.str.encode()), _of_bytes("shape", str(array.shape).encode())
    return _of_parts("array", [*head, _of_bytes("content", content)])


def _of_fields(kind: type, parts: Mapping[str, Any], where: str) -> bytes:
    name = _of_bytes("class", f"{kind.__module__}.{kind.__qualname__}".encode())
    found = [(_of_bytes("field", key.encode()), _digest(part, f"{where}.{key}")) for key, part in parts.items()]
    return _of_parts("fields", [name, *(part for pair in found for part in pair)])


def _of_bytes(kind: str, content: bytes) -> bytes:
    return hashlib.sha256(kind.encode() + b"\0" + content).digest()


def _of_parts(kind: str, parts: list[bytes]) -> bytes:
    """Return the digest of digests, which all have the same length, so that no separator is needed."""
    return _of_bytes(kind, b"".join(parts))


@cache
def _folders() -> tuple[str, ...]:
    """Return the folders of Python and of installed packages."""
    return tuple({sysconfig.get_path(name) + os.sep for name in ("stdlib", "platstdlib", "purelib", "platlib")})
