"""The law of the control "pid" as a program of an optional extension, which makes all its operations in one call.

At a few envs a call of NumPy costs a hundred times what it computes, and the law makes some thirty of them in a sim
step. There is one definition of the law all the same: :meth:`sim.loop.pid_law.PIDLaw.advance` is traced, called once
with symbols in place of arrays, and the operations on them are the program. Each is rounded as NumPy's, so that results
are bit-identical.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.coefficients import Coefficients
from sim.engine import native
from sim.loop.pid_law import PIDLaw

extension: Any
try:
    extension = importlib.import_module("sim.loop._law_program")
except ImportError:
    extension = None

MAX_JOINTS = 128
"""Joints up to which the extension sums in NumPy's order."""
OPERATIONS = (  # in the order of Code in law_program.cpp
    *("add", "subtract", "multiply", "divide", "maximum", "minimum", "greater", "less", "not_equal", "and"),
    *("negative", "absolute", "rint", "isfinite", "where", "row_minimum", "matrix_vector"),
)


class Namespace:
    """Array namespace of symbols; it notes the operations on them in order."""

    inf = np.inf

    def __init__(self) -> None:
        self.noted: list[tuple[str, tuple[Symbol, ...], Symbol]] = []
        self.literals: dict[float, Symbol] = {}

    def symbol(self, value: Any) -> Symbol:
        """Return ``value`` as a symbol: itself, or that of a number."""
        if isinstance(value, Symbol):
            return value
        return self.literals.setdefault(float(value), Symbol(self))

    def apply(self, name: str, *values: Any) -> Symbol:
        """Note an operation; return its result."""
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
        """Return it: masks are 1.0 and 0.0."""
        return self

    def copy(self) -> Symbol:
        """Return it: the results of a program are new arrays."""
        return self

    def min(self, axis: int, keepdims: bool) -> Symbol:
        """Return the least number of each row, in all its columns."""
        assert (axis, keepdims) == (-1, True)
        return self._namespace.apply("row_minimum", self)

    def __getitem__(self, index: Any) -> _AsRows:
        assert index == (slice(None), None, slice(None))
        return _AsRows(self)

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
    """Numbers, constants after those that were given."""


def trace(function: Callable[..., Any], constants: int, inputs: int) -> Trace:
    """Return the operations of a function of so many constants and inputs, that returns a list of arrays."""
    namespace = Namespace()
    given = [Symbol(namespace) for _ in range(constants + inputs)]
    results = [namespace.symbol(result) for result in function(*given)]
    needed, operations = set(results), list[tuple[str, tuple[Symbol, ...], Symbol]]()
    for name, operands, result in reversed(namespace.noted):
        if result in needed:
            needed.update(operands)
            operations.insert(0, (name, operands, result))
    literals = {symbol: number for number, symbol in namespace.literals.items() if symbol in needed}
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


@lru_cache(maxsize=256)
def _trace_law(law: PIDLaw, structures: tuple[tuple[Any, ...], ...], terms: bool) -> tuple[Trace, list[int]]:
    """Return the law's trace, and the leaves of the new state that it returns, before effort and saturation.

    ``structures`` are those of coefficients, state and other inputs: ... for an array, and what is none as it is.
    """
    returned: list[int] = []

    def function(*symbols: Symbol) -> list[Any]:
        rest = iter(symbols)
        k, state, inputs = ([next(rest) if one is ... else one for one in leaves] for leaves in structures)
        setpoint, rate, *others = inputs
        new, effort, *shown = partial(law.advance, terms=terms)(
            Coefficients(*k), bp.PIDState(*state), (setpoint, rate), *others
        )
        returned[:] = [at for at, leaf in enumerate(new) if leaf is not None]
        return [*(new[at] for at in returned), effort, *(each.saturated for each in shown)]

    counts = [leaves.count(...) for leaves in structures]
    return trace(function, counts[0], counts[1] + counts[2]), returned


class LawProgram:
    """:meth:`sim.loop.pid_law.PIDLaw.advance` for given coefficients ``k`` (envs, joints), of float64."""

    def __init__(self, law: PIDLaw, k: Coefficients) -> None:
        self._law = law
        self._k = _structure(k)
        self._constants = [leaf for leaf in k if isinstance(leaf, np.ndarray)]
        self._shape = k.kp.shape
        self._programs: dict[Any, tuple[Any, list[int]]] = {}

    @staticmethod
    def available(k: Coefficients) -> bool:
        """Return whether there is an extension that runs the law with such coefficients."""
        fits = k.kp.dtype == np.float64 and k.kp.shape[1] <= MAX_JOINTS
        return extension is not None and fits and native.status().active

    def advance(
        self,
        state: bp.PIDState,
        command: tuple[Any, Any],
        qpos: NDArray[np.float64],
        qvel: NDArray[np.float64] | None,
        *others: NDArray[np.float64] | None,
        terms: bool = False,
    ) -> tuple[Any, ...]:
        """Return the new state and the effort, and with ``terms`` the mask of their saturation.

        Arguments as those of :meth:`sim.loop.pid_law.PIDLaw.advance`.
        """
        inputs = (*command, qpos, qvel if self._law.measures_rate else None, *others)
        leaves = (*state, *inputs)
        key = (terms, *[leaf is None for leaf in leaves])
        if key not in self._programs:
            structures = (self._k, _structure(state), _structure(inputs))
            operations, returned = _trace_law(self._law, structures, terms)
            literals = [np.array(number) for number in operations.literals]
            count = len(leaves) - sum(key[1:])
            self._programs[key] = (
                extension.program(*operations[:3], count, (*self._constants, *literals), *self._shape),
                returned,
            )
        program, returned = self._programs[key]
        new: list[Any] = [None] * len(state)
        outputs = []
        for at in returned:
            new[at] = leaf = np.empty(self._shape)
            outputs.append(leaf)
        outputs.append(np.empty(self._shape))
        if terms:
            outputs.append(np.empty(self._shape, bool))
        arrays = tuple([leaf for leaf in leaves if leaf is not None])
        try:
            extension.run(program, arrays, tuple(outputs))
        except ValueError:  # one is not contiguous
            extension.run(program, tuple(map(np.ascontiguousarray, arrays)), tuple(outputs))
        return (bp.PIDState._make(new), *outputs[len(returned) :])


def _structure(leaves: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple([... if isinstance(leaf, np.ndarray) else leaf for leaf in leaves])
