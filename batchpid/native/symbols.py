"""Symbols in place of arrays in a trace (:mod:`batchpid.native.tracing`), and the namespace of
their operations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from batchpid.arrays.array_types import Array, DType
from batchpid.native.extensions import MASKS, OPERATIONS

_OTHER_NAMES = {"abs": "absolute", "logical_and": "and", "logical_or": "or", "logical_not": "not"}
"""Operations that have another name in NumPy."""


class Namespace:
    """Array namespace of symbols; it records the operations on them in order."""

    inf = np.inf

    def __init__(self, dtype: DType = np.float64) -> None:
        self.dtype = np.dtype(dtype)
        self.noted: list[tuple[str, tuple[Symbol, ...], Symbol]] = []
        self.literals: dict[str, tuple[float, Symbol]] = {}
        """Numbers and their symbols, by ``repr``, which distinguishes -0.0 from 0.0."""

    def symbol(self, value: Array) -> Symbol:
        """Return the symbol of a number; a symbol is returned unchanged.

        A number is rounded to the arrays' dtype. A scalar of a wider dtype is a TypeError, because
        NumPy would promote the arrays instead.
        """
        if isinstance(value, Symbol):
            return value
        # A Python number takes the dtype of the arrays.
        if isinstance(value, np.generic) and np.result_type(value, self.dtype) != self.dtype:
            raise TypeError(f"a program of {self.dtype} cannot hold a scalar of {value.dtype}")
        return self.literals.setdefault(repr(float(value)), (float(value), Symbol(self)))[1]

    def apply(self, name: str, *values: Array) -> Symbol:
        """Record an operation; return its result."""
        operands = tuple(map(self.symbol, values))
        result = Symbol(self, name in MASKS or (name == "gather" and operands[0].is_mask))
        self.noted.append((name, operands, result))
        return result

    def __getattr__(self, name: str) -> Callable[..., Symbol]:
        name = _OTHER_NAMES.get(name, name)
        if name not in OPERATIONS:
            raise AttributeError(f"programs have no operation {name!r}")
        return lambda *values: self.apply(name, *values)

    def zeros_like(self, _: object) -> Symbol:
        """Return the number 0."""
        return self.symbol(0.0)

    def ones_like(self, _: object) -> Symbol:
        """Return the number 1."""
        return self.symbol(1.0)


def _operator(name: str) -> Callable[[Symbol, Any], Symbol]:
    """Return a method that records an operation on the symbol and another operand."""
    return lambda self, other: self.record(name, self, other)


class Symbol:
    """Array (rows, columns) in a trace; a mask holds 1.0 and 0.0.

    It can also be a matrix in each row, or a history of samples, which a program changes in place.
    """

    ndim = 2

    def __init__(self, namespace: Namespace, is_mask: bool = False) -> None:
        self._namespace = namespace
        self.is_mask = is_mask

    def __array_namespace__(self) -> Namespace:
        return self._namespace

    @property
    def dtype(self) -> np.dtype[Any]:
        """Dtype of the array: bool for a mask, else the dtype of the trace."""
        if self.is_mask:
            return np.dtype(bool)
        return self._namespace.dtype

    def astype(self, dtype: DType) -> Symbol:
        """Return a mask as numbers; return numbers unchanged."""
        assert np.dtype(dtype) == self._namespace.dtype
        if self.is_mask:
            return self.record("add", self, -0.0)
        return self

    def copy(self) -> Symbol:
        """Return the same symbol: the results of a program are new arrays."""
        return self

    def record(self, name: str, *arrays: Array) -> Symbol:
        """Record a function of :mod:`batchpid.arrays.elementwise` as the operation ``name``; return
        its result.
        """
        return self._namespace.apply(name, *arrays)

    def __bool__(self) -> NoReturn:
        raise TypeError("a traced function cannot branch on the entries of an array")

    def __abs__(self) -> Symbol:
        return self.record("absolute", self)

    def __neg__(self) -> Symbol:
        return self.record("negative", self)

    def __invert__(self) -> Symbol:
        return self.record("not", self)

    def __rsub__(self, other: Any) -> Symbol:
        return self.record("subtract", other, self)

    def __rtruediv__(self, other: Any) -> Symbol:
        return self.record("divide", other, self)

    __hash__ = object.__hash__
    __add__ = __radd__ = _operator("add")
    __sub__ = _operator("subtract")
    __mul__ = __rmul__ = _operator("multiply")
    __truediv__ = _operator("divide")
    __gt__, __ge__, __lt__, __le__ = map(
        _operator, ("greater", "greater_equal", "less", "less_equal")
    )
    __eq__ = _operator("equal")  # type: ignore[assignment]
    __ne__ = _operator("not_equal")  # type: ignore[assignment]
    __and__, __or__ = map(_operator, ("and", "or"))
