"""Array functions as programs of the native extension, which executes all their operations in one
call.

With few envs, the overhead of a NumPy call is a hundred times its computation; with many, each call
moves whole arrays to and from memory. A function is traced (:mod:`batchpid.native.tracing`), and
the recorded operations are the program. The program processes the rows in blocks that stay in the
cache. Each operation is rounded as in NumPy, so results are bit-identical, except for the sign of a
NaN, which has no meaning. Programs give no floating-point warnings.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import cache, partial
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import DType, Pytree, Rows
from batchpid.arrays.trees import filled, leaves, structure
from batchpid.errors import warn
from batchpid.native.extensions import PROGRAM, TASK_SPACE, Extension, load
from batchpid.native.tracing import Trace, trace_change

NUMBERS_PER_THREAD = 2**17
"""Least share of an array, in numbers, for which another thread is worth its start (50 us)."""


@cache
def interpreter() -> ModuleType:
    """Return the extension, initialised with NumPy's array type; errors as in
    :func:`extensions.load`.
    """
    native = load(PROGRAM)
    native.use(np.ndarray, np.empty)
    # The extension reads the fields of arrays in memory, whose layout is NumPy's.
    entry = np.empty((4, 3), np.float32)
    if native.look(entry) != (entry.ctypes.data, *entry.shape, entry.dtype.num, True):
        raise ImportError(f"cannot read the arrays of NumPy {np.__version__}")
    return native


def threads_for(numbers: int) -> int:
    """Return the number of threads for arrays of ``numbers`` numbers: at most the cores available."""
    most = numbers // NUMBERS_PER_THREAD
    if most < 2:
        return 1
    # The process may be bound to fewer cores than the machine has.
    if hasattr(os, "sched_getaffinity"):
        return min(most, len(os.sched_getaffinity(0)))
    return min(most, os.cpu_count() or 1)


class ArrayProgram:
    """A trace with its first inputs fixed to ``constants``, for arrays (rows, columns) = ``shape``
    of one dtype.

    A constant is an array (rows, columns) or (1, columns), or a number. ``inputs`` is the number of
    other inputs. The result does not depend on the number of threads.
    """

    def __init__(
        self,
        trace: Trace,
        constants: Sequence[ArrayLike],
        inputs: int,
        shape: tuple[int, int],
        dtype: DType = np.float64,
    ) -> None:
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self.masks = trace.masks
        prepared = [np.ascontiguousarray(entry, dtype) for entry in (*constants, *trace.literals)]
        # What depends on constants alone is computed once, not at every call.
        if trace.prelude is not None:
            rows = max((entry.shape[0] for entry in prepared if entry.ndim == 2), default=1)
            result = ArrayProgram(trace.prelude, (), len(prepared), (rows, shape[1]), dtype)(
                *prepared
            )
            prepared += [entry.astype(dtype) for entry in result]
        # One row in place of equal rows stays in the cache. Bits are compared: -0.0 is another number.
        bits = partial(np.ndarray.view, dtype=f"u{np.dtype(dtype).itemsize}")
        prepared = [
            entry[:1] if entry.ndim == 2 and (bits(entry) == bits(entry[:1])).all() else entry
            for entry in prepared
        ]
        tables = trace.operations, trace.results, trace.segments, trace.registers
        self.arguments = (*tables, inputs, tuple(prepared), *shape, self.dtype == np.float32)
        """Arguments of ``make_program`` in make_program.h."""
        self._program = interpreter().program(*self.arguments)
        self._run = interpreter().run
        self._threads = threads_for(shape[0] * shape[1])

    def __call__(self, *arrays: Rows, out: Sequence[Rows] | None = None) -> Sequence[Rows]:
        """Return the results for the other inputs, in new arrays or in ``out``.

        An input is (rows, columns), (1, columns), (rows, 1) or (1, 1), or (rows, columns, columns)
        for products of matrices and vectors. An array of ``out`` is (rows, columns), of dtype bool
        for masks. It may be an input of that shape, and must not overlap any other array. Raises
        ValueError if an array has a wrong shape or dtype, or one of ``out`` overlaps.
        """
        if out is None:
            out = [np.empty(self.shape, bool if is_mask else self.dtype) for is_mask in self.masks]
        try:
            self._run(self._program, self.shape[0], arrays, tuple(out), self._threads)
        except ValueError:  # the extension takes plain ndarrays only, contiguous and aligned
            plain = tuple(
                [np.asarray(np.require(entry, requirements=["C", "A"])) for entry in arrays]
            )
            self._run(
                self._program, self.shape[0], plain, tuple(map(np.asarray, out)), self._threads
            )
        return out

    def bind(
        self,
        inputs: Sequence[Rows],
        outputs: Sequence[Rows],
        given: int,
        full: int,
    ) -> Callable[..., Rows]:
        """Return a fast function with the first inputs, and all outputs but the last, fixed to
        these arrays.

        Its arguments are ``out`` and the further inputs, each an array or None. It returns ``out``
        or a new array. If an array needs a check or conversion in Python, it does nothing and
        returns NotImplemented.

        Parameters
        ----------
        given
            Bit mask of the further inputs that are arrays (not None).
        full
            Bit mask of the further inputs that must be (rows, columns).
        """
        # The result of a step is a new array where the caller gives none.
        native = interpreter()
        new = (self.shape, self.dtype)
        fixed = self._program, self.shape[0], tuple(inputs), tuple(outputs)
        return partial(native.call, native.bind(*fixed, given, full, new, self._threads))


class Bound(NamedTuple):
    """Arrays of a :class:`TreeProgram`."""

    program: ArrayProgram
    inputs: list[Rows]
    outputs: list[Rows]
    after: Any
    """State, results and others after the program."""


class TreeProgram:
    """Program of a pure function of trees: ``function(constants, state, inputs)`` returns state,
    results and others, as for :func:`.trace_change`.

    ``state`` and ``inputs`` are arrays like those to :meth:`bind`; other arguments as for
    :class:`ArrayProgram`.

    Raises
    ------
    AttributeError, AssertionError, TypeError
        The function uses an operation that programs do not have.
    """

    def __init__(
        self,
        function: Callable[[Any, Any, Any], tuple[Pytree, Pytree, Pytree]],
        constants: Pytree,
        state: Pytree,
        inputs: Pytree,
        shape: tuple[int, int],
        dtype: DType = np.float64,
    ) -> None:
        histories = tuple([array.ndim == 3 for array in leaves(state)])
        trees = map(structure, (constants, state, inputs))
        self._change = trace_change(function, histories, *trees, dtype=np.dtype(dtype))
        count = len(leaves((state, inputs)))
        trace = self._change.program
        self.program = ArrayProgram(
            trace,
            leaves(constants),
            count,
            shape,
            dtype,
        )

    def bind(self, state: Pytree, inputs: Pytree, last: Rows | None = None) -> Bound:
        """Return arrays for the program: it changes the state's arrays in place, and writes results
        to new arrays, the last one to ``last``.
        """
        program = self.program
        read = leaves((state, inputs))
        written = [
            np.zeros(program.shape, bool if is_mask else program.dtype) for is_mask in program.masks
        ]
        if last is not None:
            written[-1] = last
        # The state comes first.
        for array, place in zip(leaves(state), self._change.places, strict=False):
            if place >= len(read):
                written[place - len(read)] = array
        arrays = iter([[*read, *written][place] for place in self._change.places])
        return Bound(program, read, written, filled(self._change.after, arrays))


SWITCH = "BATCHPID_NATIVE"
"""Environment variable: "0" switches native code off."""


def obstacle(*extensions: Extension) -> str:
    """Return why native code is not used, "" if it is; a faulty installation gives one
    RuntimeWarning per process.

    ``extensions`` are needed besides the extensions of this package.
    """
    if os.environ.get(SWITCH) == "0":
        return f"native code is switched off by {SWITCH}=0"
    return _fault((PROGRAM, TASK_SPACE)) or _fault(extensions)


@cache
def _fault(extensions: tuple[Extension, ...]) -> str:
    try:
        for extension in extensions:
            load(extension)
        interpreter()
    except ModuleNotFoundError as error:
        return str(error)
    except ImportError as error:
        warn(f"native code is not used, only Python: {error}", RuntimeWarning)
        return str(error)
    return ""
