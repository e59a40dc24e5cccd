"""Traces of array functions: a call with symbols in place of arrays records the operations of the
function.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, DType, Pytree
from batchpid.arrays.trees import filled, leaves
from batchpid.native.extensions import OPERATIONS
from batchpid.native.symbols import Namespace, Symbol

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
    # Pairs are fused after that: a constant part needs no speed.
    late = _fused(late, results)
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


_PAIRS = {
    ("multiply", "add"): "multiply_add",
    ("add", "subtract"): "add_subtract",
    ("subtract", "multiply"): "subtract_multiply",
    ("maximum", "minimum"): "clip",
}
"""Pairs of operations that are fused, each still rounded, for fewer passes over a block."""


def _fused(operations: list[_Operation], results: list[Symbol]) -> list[_Operation]:
    """Return the operations with pairs fused, where the result of the first is used only by the
    second.
    """
    uses = Counter(operand for _, operands, _ in operations for operand in operands) + Counter(
        results
    )
    fused: dict[Symbol, _Operation] = {}
    for name, operands, result in operations:
        fused[result] = (name, operands, result)
        # Operands of sums and products may be exchanged, others not.
        for at in range(2 if name in ("add", "multiply") else 1):
            before = fused.get(operands[at])
            if before is None or uses[operands[at]] > 1:
                pair = None
            else:
                pair = _PAIRS.get((before[0], name))
            if before is not None and pair is not None:
                del fused[operands[at]]
                fused[result] = (pair, (*before[1], operands[1 - at]), result)
                break
    return list(fused.values())


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
    table = np.array(rows, np.int32)
    ends = np.array([places[result] for result in results], np.int32)
    masks = tuple(result.is_mask for result in results)
    return Trace(table.tobytes(), ends.tobytes(), masks, registers, literals, prelude)
