"""Traces of array functions: a call with symbols in place of arrays records the operations of the function."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, NoReturn

import numpy as np

from batchpid.native.operations import MASKS, OPERATIONS

_NAMES = {"abs": "absolute", "logical_and": "and", "logical_or": "or", "logical_not": "not"}
"""Operations that have another name in NumPy."""


class Namespace:
    """Array namespace of symbols; it records the operations on them in order."""

    inf = np.inf

    def __init__(self, dtype: Any = np.float64) -> None:
        self.dtype = np.dtype(dtype)
        self.noted: list[tuple[str, tuple[Symbol, ...], Symbol]] = []
        self.literals: dict[str, tuple[float, Symbol]] = {}
        """Numbers and their symbols, by ``repr``, which distinguishes -0.0 from 0.0."""

    def symbol(self, value: Any) -> Symbol:
        """Return the symbol of a number; a symbol is returned unchanged.

        A number is rounded to the arrays' dtype. A scalar of a wider dtype is a TypeError, because
        NumPy would promote the arrays instead.
        """
        if isinstance(value, Symbol):
            return value
        if isinstance(value, np.generic) and np.result_type(value, self.dtype) != self.dtype:
            raise TypeError(f"a program of {self.dtype} cannot hold a scalar of {value.dtype}")
        return self.literals.setdefault(repr(float(value)), (float(value), Symbol(self)))[1]

    def apply(self, name: str, *values: Any) -> Any:
        """Record an operation; return its result. Stacks take part entry by entry."""
        if stacks := [value for value in values if isinstance(value, Stack)]:
            size = max(map(len, stacks))
            each = (value if isinstance(value, Stack) else Stack([value]) for value in values)
            spread = [stack * size if len(stack) == 1 else stack for stack in map(tuple, each)]
            return Stack(self.apply(name, *entries) for entries in zip(*spread, strict=True))
        result = Symbol(self, name in MASKS)
        self.noted.append((name, tuple(map(self.symbol, values)), result))
        return result

    def __getattr__(self, name: str) -> Callable[..., Symbol]:
        name = _NAMES.get(name, name)
        if name not in OPERATIONS:
            raise AttributeError(f"programs have no operation {name!r}")
        return lambda *values: self.apply(name, *values)

    def concatenate(self, arrays: tuple[Any, Any], axis: int) -> Any:
        """Return positions and velocities side by side, or a history with a later sample in front."""
        assert axis == 1
        first, second = arrays
        if isinstance(first, _AsRows) and isinstance(second, _WithoutOldest):
            samples = first.vector if isinstance(first.vector, _Pair) else (first.vector,)
            return self.apply("push", second.history, *samples)
        return _Pair(first, second)

    def atleast_2d(self, value: Any) -> Any:
        """Return ``value``, which already has rows and columns."""
        return value

    def zeros_like(self, _: Any) -> Symbol:
        """Return the number 0."""
        return self.symbol(0.0)

    def ones_like(self, _: Any) -> Symbol:
        """Return the number 1."""
        return self.symbol(1.0)


class Stack(tuple[Any, ...]):
    """Array (n, rows, columns) in a trace, as n symbols."""

    __slots__ = ()

    def __mul__(self, other: Any) -> Any:
        return self[0].__array_namespace__().apply("multiply", self, other)

    def sum(self, axis: int) -> Symbol:
        """Return 0 plus all entries in order, as NumPy sums them."""
        assert axis == 0
        total = self[0].__array_namespace__().symbol(0.0)
        for entry in self:
            total = total + entry
        return total


class Symbol:
    """Array (rows, columns) in a trace; a mask holds 1.0 and 0.0.

    It may also stand for a matrix in each row, or for a history of samples. A program changes a history in place.
    """

    def __init__(self, namespace: Namespace, is_mask: bool = False) -> None:
        self._namespace = namespace
        self.is_mask = is_mask

    def __array_namespace__(self) -> Namespace:
        return self._namespace

    @property
    def dtype(self) -> np.dtype[Any]:
        """Dtype of the array: bool for a mask, else the dtype of the trace."""
        return np.dtype(bool) if self.is_mask else self._namespace.dtype

    def astype(self, dtype: Any) -> Symbol:
        """Return a mask as numbers; return numbers unchanged."""
        assert np.dtype(dtype) == self._namespace.dtype
        return self._namespace.apply("add", self, -0.0) if self.is_mask else self

    def copy(self) -> Symbol:
        """Return the same symbol: the results of a program are new arrays."""
        return self

    def min(self, axis: int, keepdims: bool) -> Symbol:
        """Return the minimum of each row, repeated in all columns."""
        assert (axis, keepdims) == (-1, True)
        return self._namespace.apply("row_minimum", self)

    def __bool__(self) -> NoReturn:
        raise TypeError("a function that is traced cannot depend on the entries of an array")

    def take(self, places: Stack) -> Stack:
        """Return the numbers of a history at places in the whole of it, which are constants."""
        return Stack(self._namespace.apply("take", self, each) for each in places)

    def __getitem__(self, index: Any) -> Any:
        if index is None:
            return Stack([self])
        if index == (slice(None), slice(None, -1)):
            return _WithoutOldest(self)
        return _as_rows(self, index)

    def __abs__(self) -> Symbol:
        return self._namespace.apply("absolute", self)

    def __neg__(self) -> Symbol:
        return self._namespace.apply("negative", self)

    def __invert__(self) -> Symbol:
        return self._namespace.apply("not", self)

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

    def __rtruediv__(self, other: Any) -> Symbol:
        return self._namespace.apply("divide", other, self)

    def __gt__(self, other: Any) -> Symbol:
        return self._apply("greater", other)

    def __ge__(self, other: Any) -> Symbol:
        return self._apply("greater_equal", other)

    def __lt__(self, other: Any) -> Symbol:
        return self._apply("less", other)

    def __le__(self, other: Any) -> Symbol:
        return self._apply("less_equal", other)

    def __and__(self, other: Any) -> Symbol:
        return self._apply("and", other)

    def __or__(self, other: Any) -> Symbol:
        return self._apply("or", other)

    def __eq__(self, other: object) -> Symbol:  # type: ignore[override]
        return self._apply("equal", other)

    def __ne__(self, other: object) -> Symbol:  # type: ignore[override]
        return self._apply("not_equal", other)

    __hash__ = object.__hash__
    __rmul__, __radd__ = __mul__, __add__

    def _apply(self, name: str, other: Any) -> Symbol:
        return self._namespace.apply(name, self, other)


class _AsRows(NamedTuple):
    """vector[:, None, :]"""

    vector: Any


class _WithoutOldest(NamedTuple):
    """history[:, :-1]"""

    history: Symbol


class _Pair:
    """concatenate((first, second), axis=1)"""

    def __init__(self, *both: Symbol) -> None:
        self._both = both

    def __iter__(self) -> Iterator[Symbol]:
        return iter(self._both)

    def __getitem__(self, index: Any) -> _AsRows:
        return _as_rows(self, index)


def _as_rows(vector: Any, index: Any) -> _AsRows:
    assert index in ((slice(None), None), (slice(None), None, slice(None)))
    return _AsRows(vector)


class _Products(NamedTuple):
    """matrix * vector[:, None, :]"""

    matrix: Symbol
    vector: Symbol

    def sum(self, axis: int) -> Symbol:
        assert axis == -1
        return self.matrix.__array_namespace__().apply("matrix_vector", self.matrix, self.vector)


_Operation = tuple[str, tuple[Symbol, ...], Symbol]


class Trace(NamedTuple):
    """Operations of a function, for the extension."""

    operations: bytes
    results: bytes
    """Register of each result."""
    masks: tuple[bool, ...]
    """Whether each result is a mask."""
    registers: int
    literals: tuple[float, ...]
    """Literal numbers: further constants, after the given ones."""
    prelude: Trace | None
    """Trace of the operations on constants and literals only; its results are further constants."""


def trace(function: Callable[..., Any], constants: int, inputs: int, dtype: Any = np.float64) -> Trace:
    """Return the trace of a function with this number of ``constants`` and ``inputs``, which returns a list of arrays.

    The constants are its first arguments.

    Raises
    ------
    AttributeError, AssertionError, TypeError
        The function uses an operation that programs do not have.
    """
    namespace = Namespace(dtype)
    given = [Symbol(namespace) for _ in range(constants + inputs)]
    results = [namespace.symbol(result) for result in function(*given)]
    operations = _needed(namespace.noted, results)
    needed = {*results, *(operand for _, operands, _ in operations for operand in operands)}
    literals = {symbol: number for number, symbol in namespace.literals.values() if symbol in needed}
    first = [*given[:constants], *literals]
    fixed, early, late = set(first), list[_Operation](), list[_Operation]()
    for each in operations:
        is_early = fixed.issuperset(each[1])
        (early if is_early else late).append(each)
        fixed.update([each[2]] * is_early)
    late = _fused(late, results)
    used = {*results, *(operand for _, operands, _ in late for operand in operands)}
    shared = [result for _, _, result in early if result in used]
    prelude = _assembled(early, first, shared, ()) if shared else None
    return _assembled(late, [*first, *shared, *given[constants:]], results, tuple(literals.values()), prelude)


def _needed(noted: Iterable[_Operation], results: list[Symbol]) -> list[_Operation]:
    """Return the operations that ``results`` depend on."""
    needed, operations = set(results), list[_Operation]()
    for name, operands, result in reversed([*noted]):
        if result in needed:
            needed.update(operands)
            operations.insert(0, (name, operands, result))
    return operations


_PAIRS = {
    ("multiply", "add"): "multiply_add",
    ("add", "subtract"): "add_subtract",
    ("subtract", "multiply"): "subtract_multiply",
    ("maximum", "minimum"): "clip",
}
"""Pairs of operations that are fused, each still rounded, for fewer passes over a block."""


def _fused(operations: list[_Operation], results: list[Symbol]) -> list[_Operation]:
    """Return the operations with pairs fused, where the result of the first is used only by the second."""
    uses = Counter(operand for _, operands, _ in operations for operand in operands) + Counter(results)
    found: dict[Symbol, _Operation] = {}
    for name, operands, result in operations:
        found[result] = (name, operands, result)
        for at in range(2 if name in ("add", "multiply") else 1):
            before = found.get(operands[at])
            pair = None if before is None or uses[operands[at]] > 1 else _PAIRS.get((before[0], name))
            if before is not None and pair is not None:
                del found[operands[at]]
                found[result] = (pair, (*before[1], operands[1 - at]), result)
                break
    return list(found.values())


def _assembled(
    operations: list[_Operation],
    order: list[Symbol],
    results: list[Symbol],
    literals: tuple[float, ...],
    prelude: Trace | None = None,
) -> Trace:
    """Return a trace of ``operations`` on the symbols ``order``.

    A register is reused after the last use of its value. Each result has a separate register, and may be made in place.
    A history keeps its register.
    """
    places = {symbol: place for place, symbol in enumerate(order)}
    last_use = {operand: at for at, (_, operands, _) in enumerate(operations) for operand in operands}
    registers, free, rows, kept = len(order), list[int](), list[list[int]](), {*order, *results}
    for at, (name, operands, result) in enumerate(operations):
        if name == "push":
            places[result] = places[operands[0]]
            kept.add(result)
        else:
            if not free or result in kept:
                free.append(registers)
                registers += 1
            places[result] = free.pop()
        numbers = [places[operand] for operand in operands]
        rows.append([OPERATIONS.index(name), places[result], *numbers, *(2 * numbers[:1])][:5])
        free += {places[one] for one in operands if last_use[one] == at and one not in kept}
    table, ends = np.array(rows, np.int32), np.array([places[result] for result in results], np.int32)
    masks = tuple(result.is_mask for result in results)
    return Trace(table.tobytes(), ends.tobytes(), masks, registers, literals, prelude)
