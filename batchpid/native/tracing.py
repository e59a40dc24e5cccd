"""Traces of array functions: a call with symbols in place of arrays records the operations of the
function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from itertools import groupby
from typing import Any, NamedTuple, NoReturn

import numpy as np

from batchpid.arrays.array_types import Array, DType, Pytree
from batchpid.arrays.trees import filled, leaves, structure
from batchpid.native.extensions import MASKS, MOST_OPERANDS, OPERATIONS, ROW_WISE

_OTHER_NAMES = {
    "abs": "absolute",
    "logical_and": "and",
    "logical_or": "or",
    "logical_not": "not",
}
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


_Operation = tuple[str, tuple[Symbol, ...], Symbol]


class Segment(NamedTuple):
    """Consecutive elementwise operations of a trace, as one function of their operands."""

    first: int
    """Index of the first operation."""
    length: int
    code: bytes
    """Numbers of operands and results; then of each operation its code and three operands; then the
    values that are results. A value is an operand of the segment, or numbered after these.
    """
    operands: bytes
    """Register of each operand."""
    results: bytes
    """Register of each result."""


class Trace(NamedTuple):
    """Operations of a function, for the extension."""

    operations: bytes
    results: bytes
    """Register of each result."""
    segments: tuple[Segment, ...]
    masks: tuple[bool, ...]
    """Whether each result is a mask."""
    registers: int
    literals: tuple[float, ...]
    """Literal numbers: further constants, after the given ones."""
    prelude: Trace | None
    """Trace of the operations on constants and literals only; its results are further constants."""


def trace(
    function: Callable[..., Iterable[Array]],
    constants: int,
    inputs: int,
    dtype: DType = np.float64,
) -> Trace:
    """Return the trace of a function with this number of ``constants`` and ``inputs``, which
    returns a list of arrays.

    The constants are its first arguments.

    Raises
    ------
    AttributeError, AssertionError, TypeError
        The function uses an operation that programs do not have.
    """
    namespace = Namespace(dtype)
    entries = [Symbol(namespace) for _ in range(constants + inputs)]
    results = [namespace.symbol(result) for result in function(*entries)]
    operations = _needed(namespace.noted, results)
    needed = {*results, *(operand for _, operands, _ in operations for operand in operands)}
    literals = {
        symbol: number for number, symbol in namespace.literals.values() if symbol in needed
    }
    first = [*entries[:constants], *literals]
    # Operations on constants alone run once, when the program is made.
    fixed = set(first)
    early = list[_Operation]()
    late = list[_Operation]()
    for entry in operations:
        is_early = fixed.issuperset(entry[1])
        (early if is_early else late).append(entry)
        fixed.update([entry[2]] * is_early)
    used = {*results, *(operand for _, operands, _ in late for operand in operands)}
    shared = [result for _, _, result in early if result in used]
    if shared:
        prelude = _assembled(early, first, shared, ())
    else:
        prelude = None
    return _assembled(
        late, [*first, *shared, *entries[constants:]], results, tuple(literals.values()), prelude
    )


def trace_trees(
    function: Callable[..., Iterable[Array]], *structures: Pytree, dtype: DType = np.float64
) -> Trace:
    """Return the trace of a function of nested tuples, as :func:`trace` does.

    ``structures`` (:func:`batchpid.arrays.trees.structure`) describe its arguments; the first one
    has the constants.
    """

    def flat(*symbols: Symbol) -> list[Any]:
        entries = iter(symbols)
        return list(function(*(filled(entry, entries) for entry in structures)))

    first, *rest = [len(leaves(entry)) for entry in structures]
    return trace(flat, first, sum(rest), dtype)


class Change(NamedTuple):
    """Trace of a function that changes a state."""

    program: Trace
    after: Pytree
    """Structure of state, results and others after it."""
    places: tuple[int, ...]
    """Index of each of their arrays: inputs first, then results of the program."""


@lru_cache(maxsize=256)
def trace_change(
    function: Callable[[Any, Any, Any], tuple[Pytree, Pytree, Pytree]],
    histories: tuple[bool, ...],
    constants: Pytree,
    state: Pytree,
    inputs: Pytree,
    dtype: DType = np.float64,
) -> Change:
    """Return the trace of ``function(constants, state, inputs)``, which returns state, results and
    others.

    The arguments are structures; ``histories`` says which arrays of the state are histories, which
    a program changes in place. Each result is a new array; an input may be among the others.
    """
    count = len(leaves((state, inputs)))
    parts: list[Any] = []

    def changed(constants: Any, state: Any, inputs: Any) -> list[Any]:
        numbers = {symbol: number for number, symbol in enumerate(leaves((state, inputs)))}
        after = function(constants, state, inputs)
        result_ids = set(map(id, leaves(after[1])))
        results, places = list[Any](), list[int]()
        for at, leaf in enumerate(leaves(after)):
            is_state = at < len(histories)
            number = numbers.get(leaf)
            if is_state and (number == at or histories[at]):
                places.append(at)
            # A result that is an input is copied, since the next call changes the input.
            elif number is not None and not is_state and id(leaf) not in result_ids:
                places.append(number)
            else:
                places.append(count + len(results))
                results.append(leaf)
        parts[:] = structure(after), tuple(places)
        return results

    program = trace_trees(changed, constants, state, inputs, dtype=dtype)
    return Change(program, *parts)


def _needed(noted: Iterable[_Operation], results: list[Symbol]) -> list[_Operation]:
    """Return the operations that ``results`` depend on."""
    needed = set(results)
    operations = list[_Operation]()
    # Backwards: a result is known to be needed before its operands are looked at.
    for name, operands, result in reversed([*noted]):
        if result in needed:
            needed.update(operands)
            operations.insert(0, (name, operands, result))
    return operations


def _assembled(
    operations: list[_Operation],
    order: list[Symbol],
    results: list[Symbol],
    literals: tuple[float, ...],
    prelude: Trace | None = None,
) -> Trace:
    """Return a trace of ``operations`` on the symbols ``order``.

    A register is reused after the last use of its value. Each result has a separate register, and
    may be made in place. A history keeps its register.
    """
    places = {symbol: place for place, symbol in enumerate(order)}
    last_use = {
        operand: at for at, (_, operands, _) in enumerate(operations) for operand in operands
    }
    registers = len(order)
    free = list[int]()
    rows = list[list[int]]()
    lasting = {*order, *results}
    for at, (name, operands, result) in enumerate(operations):
        # A history is changed in place; other results take a free register.
        if name == "push":
            places[result] = places[operands[0]]
            lasting.add(result)
        else:
            if not free or result in lasting:
                free.append(registers)
                registers += 1
            places[result] = free.pop()
        numbers = [places[operand] for operand in operands]
        rows.append([OPERATIONS.index(name), places[result], *numbers, *(2 * numbers[:1])][:5])
        # Freed last: a result must not use the register of an operand.
        free += {places[one] for one in operands if last_use[one] == at and one not in lasting}
    masks = tuple(result.is_mask for result in results)
    segments = tuple(_segments(operations, places, results))
    ends = _packed(places[result] for result in results)
    return Trace(
        _packed(rows),
        ends,
        segments,
        masks,
        registers,
        literals,
        prelude,
    )


def _segments(
    operations: list[_Operation], places: Mapping[Symbol, int], results: list[Symbol]
) -> Iterator[Segment]:
    """Yield the longest runs of at least two elementwise operations."""
    last_use = {
        operand: at for at, (_, operands, _) in enumerate(operations) for operand in operands
    }
    last_use |= dict.fromkeys(results, len(operations))
    for is_elementwise, run in groupby(
        enumerate(operations), lambda entry: entry[1][0] not in ROW_WISE
    ):
        if not is_elementwise:
            continue
        numbered = list(run)
        first, end = numbered[0][0], numbered[-1][0] + 1
        inside = [operation for _, operation in numbered]
        made = dict.fromkeys(result for _, _, result in inside)
        read = dict.fromkeys(
            operand for _, operands, _ in inside for operand in operands if operand not in made
        )
        numbers = {symbol: number for number, symbol in enumerate([*read, *made])}
        results = [symbol for symbol in made if last_use.get(symbol, -1) >= end]
        if len(inside) < 2 or len(read) > MOST_OPERANDS or len(results) > MOST_OPERANDS:
            continue
        code = [len(read), len(results)]
        for name, operands, _ in inside:
            entries = [numbers[operand] for operand in operands]
            code += [OPERATIONS.index(name), *entries, *(2 * entries[:1])][:4]
        code += [numbers[symbol] for symbol in results]
        yield Segment(
            first,
            end - first,
            _packed(code),
            _packed(places[symbol] for symbol in read),
            _packed(places[symbol] for symbol in results),
        )


def _packed(numbers: Iterable[Any]) -> bytes:
    """Return numbers as bytes of int32."""
    return np.array(list(numbers), np.int32).tobytes()
