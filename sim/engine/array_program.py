"""Array functions as programs of a native extension, which executes all their operations in one call.

With few envs, the overhead of a NumPy call is a hundred times its computation. A function is traced: it is called once
with symbols in place of arrays, and the recorded operations are the program. Each operation is rounded as in NumPy, so
that results are bit-identical.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.engine.native import extension
from sim.engine.native.interface import OPERATIONS


class Namespace:
    """Array namespace of symbols; it records the operations on them in order."""

    inf = np.inf

    def __init__(self) -> None:
        self.noted: list[tuple[str, tuple[Symbol, ...], Symbol]] = []
        self.literals: dict[str, tuple[float, Symbol]] = {}
        """Numbers and their symbols, by ``repr``, which distinguishes -0.0 from 0.0."""

    def symbol(self, value: Any) -> Symbol:
        """Return the symbol of a number; a symbol is returned unchanged."""
        if isinstance(value, Symbol):
            return value
        return self.literals.setdefault(repr(float(value)), (float(value), Symbol(self)))[1]

    def apply(self, name: str, *values: Any) -> Symbol:
        """Record an operation; return its result."""
        result = Symbol(self)
        self.noted.append((name, tuple(map(self.symbol, values)), result))
        return result

    def __getattr__(self, name: str) -> Callable[..., Symbol]:
        name = {"abs": "absolute"}.get(name, name)
        if name not in OPERATIONS:
            raise AttributeError(f"programs have no operation {name!r}")
        return lambda *values: self.apply(name, *values)

    def zeros_like(self, _: Any) -> Symbol:
        """Return the number 0."""
        return self.symbol(0.0)

    def ones_like(self, _: Any) -> Symbol:
        """Return the number 1."""
        return self.symbol(1.0)


class Symbol:
    """Array (rows, columns) in a trace."""

    def __init__(self, namespace: Namespace) -> None:
        self._namespace = namespace

    def __array_namespace__(self) -> Namespace:
        return self._namespace

    dtype = np.dtype(np.float64)

    def astype(self, _: Any) -> Symbol:
        """Return the same symbol: masks are 1.0 and 0.0."""
        return self

    def copy(self) -> Symbol:
        """Return the same symbol: the results of a program are new arrays."""
        return self

    def min(self, axis: int, keepdims: bool) -> Symbol:
        """Return the minimum of each row, repeated in all columns."""
        assert (axis, keepdims) == (-1, True)
        return self._namespace.apply("row_minimum", self)

    def __getitem__(self, index: Any) -> _AsRows:
        assert index == (slice(None), None, slice(None))
        return _AsRows(self)

    def __abs__(self) -> Symbol:
        return self._namespace.apply("absolute", self)

    def __neg__(self) -> Symbol:
        return self._namespace.apply("negative", self)

    def __mul__(self, other: Any) -> Any:
        return _Products(self, other.vector) if isinstance(other, _AsRows) else self._apply("multiply", other)

    def __add__(self, other: Any) -> Symbol:
        return self._apply("add", other)

    def __sub__(self, other: Any) -> Symbol:
        return self._apply("subtract", other)

    def __rsub__(self, other: Any) -> Symbol:
        return self._namespace.apply("subtract", other, self)

    def __truediv__(self, other: Any) -> Symbol:
        return self._apply("divide", other)

    def __gt__(self, other: Any) -> Symbol:
        return self._apply("greater", other)

    def __lt__(self, other: Any) -> Symbol:
        return self._apply("less", other)

    def __and__(self, other: Any) -> Symbol:
        return self._apply("and", other)

    def __ne__(self, other: object) -> Symbol:  # type: ignore[override]
        return self._apply("not_equal", other)

    __hash__ = object.__hash__
    __rmul__, __radd__ = __mul__, __add__

    def _apply(self, name: str, other: Any) -> Symbol:
        return self._namespace.apply(name, self, other)


class _AsRows(NamedTuple):
    """vector[:, None, :]"""

    vector: Symbol


class _Products(NamedTuple):
    """matrix * vector[:, None, :]"""

    matrix: Symbol
    vector: Symbol

    def sum(self, axis: int) -> Symbol:
        assert axis == -1
        return self.matrix.__array_namespace__().apply("matrix_vector", self.matrix, self.vector)


class Trace(NamedTuple):
    """Operations of a function, for the extension."""

    operations: bytes
    results: bytes
    """Register of each result."""
    registers: int
    literals: tuple[float, ...]
    """Literal numbers: further constants, after the given ones."""


def trace(function: Callable[..., Any], constants: int, inputs: int) -> Trace:
    """Return the trace of a function with this number of ``constants`` and ``inputs``, which returns a list of arrays.

    The constants are its first arguments.
    """
    namespace = Namespace()
    given = [Symbol(namespace) for _ in range(constants + inputs)]
    results = [namespace.symbol(result) for result in function(*given)]
    needed, operations = set(results), list[tuple[str, tuple[Symbol, ...], Symbol]]()
    for name, operands, result in reversed(namespace.noted):
        if result in needed:
            needed.update(operands)
            operations.insert(0, (name, operands, result))
    literals = {symbol: number for number, symbol in namespace.literals.values() if symbol in needed}
    order = [*given[:constants], *literals, *given[constants:]]
    places = {symbol: place for place, symbol in enumerate(order)}
    last_use = {operand: at for at, (_, operands, _) in enumerate(operations) for operand in operands}
    registers, free, rows = len(order), list[int](), list[list[int]]()
    for at, (name, operands, result) in enumerate(operations):
        if not free:
            free.append(registers)
            registers += 1
        places[result] = free.pop()
        numbers = [places[operand] for operand in operands]
        rows.append([OPERATIONS.index(name), places[result], *(3 * numbers)[:1], *(numbers[1:] + 2 * numbers[:1])[:2]])
        kept = {*order, *results}
        free += {places[one] for one in operands if last_use[one] == at and one not in kept}
    table, ends = np.array(rows, np.int32), np.array([places[result] for result in results], np.int32)
    return Trace(table.tobytes(), ends.tobytes(), registers, tuple(literals.values()))


class ArrayProgram:
    """A trace with its first inputs fixed to ``constants``, for arrays (rows, columns) = ``shape`` of float64.

    An array of constants is (rows, columns), (1, columns) or a number.
    """

    def __init__(self, trace: Trace, constants: Sequence[Any], inputs: int, shape: tuple[int, int]) -> None:
        native = extension("_law_program")
        given = (*map(np.ascontiguousarray, constants), *map(np.array, trace.literals))
        self._run, self._shape = native.run, shape
        self._program = native.program(*trace[:3], inputs, given, *shape)
        self._outputs = len(trace.results) // np.int32().itemsize

    def __call__(self, *arrays: NDArray[Any], masks: int = 0) -> list[NDArray[Any]]:
        """Return the results for the other inputs as new arrays; the last ``masks`` of them have dtype bool.

        An input is (rows, columns), or (rows, columns, columns) for products of matrices and vectors.
        """
        numbers = self._outputs - masks
        outputs = [np.empty(self._shape, np.float64 if at < numbers else bool) for at in range(self._outputs)]
        try:
            self._run(self._program, arrays, tuple(outputs))
        except ValueError:  # one is not contiguous
            self._run(self._program, tuple(map(np.ascontiguousarray, arrays)), tuple(outputs))
        return outputs
