"""Whether native programs are used: built from the present files, not switched off, and equal to NumPy's results."""

from __future__ import annotations

import os
import warnings
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.elementwise import matrix_vector, push_history, read_history, row_minimum, take_columns
from batchpid.native.array_program import ArrayProgram, interpreter
from batchpid.native.extensions import StaleExtensionError, load_all
from batchpid.native.operations import PROGRAM
from batchpid.native.tracing import trace

SWITCH = "BATCHPID_NATIVE"
"""Environment variable: "0" switches native code off."""


class ProgramStatus(NamedTuple):
    """State of native programs: used or not, and the reason if not."""

    active: bool
    reason: str = ""
    warning: str = ""
    """Text of a warning, if the reason is a fault of the installation."""


def program_status() -> ProgramStatus:
    """Return whether native programs are used; a faulty installation gives one RuntimeWarning per process."""
    if os.environ.get(SWITCH) == "0":
        return ProgramStatus(False, f"native programs are switched off by {SWITCH}=0")
    return _judged()


@cache
def _judged() -> ProgramStatus:
    try:
        load_all([PROGRAM])
        interpreter()
    except StaleExtensionError as error:
        status = ProgramStatus(False, str(error), f"the native extension is not used, only NumPy: {error}")
    except ModuleNotFoundError as error:
        return ProgramStatus(False, str(error))
    else:
        if (problem := first_difference()) is None:
            return ProgramStatus(True)
        status = ProgramStatus(False, problem, f"the native extension is not used, only NumPy: {problem}")
    warnings.warn(status.warning, RuntimeWarning, stacklevel=3)
    return status


def every_operation(a: Any, b: Any, c: Any, matrix: Any) -> list[Any]:
    """Apply all operations of programs to arrays (rows, columns) and a matrix for each row; return the results."""
    xp = a.__array_namespace__()
    masks = a > b, a >= b, a < b, a <= b, a == b, a != b, xp.isfinite(a)
    some = (a > b) & (b < c), (a > b) | (b < c), ~(a > b)
    numbers = a + b, a - b, a * b, a / b, -a, abs(a), xp.rint(a), xp.ceil(a), xp.floor(a), xp.sqrt(a), xp.sign(a)
    pairs = a * b + c, a + b * c, a + b - c, (a - b) * c, xp.minimum(xp.maximum(a, b), c)
    ends = xp.maximum(a, b), xp.minimum(a, b), xp.maximum(b, a), xp.minimum(b, a)
    across = xp.zeros_like(a) + row_minimum(a), matrix_vector(matrix, b)
    return [*numbers, *pairs, *ends, xp.where(a > b, b, c), *across, *masks, *some]


def history_operations(places: Any, history: Any, a: Any, b: Any) -> list[Any]:
    """Push ``a`` and ``b``, side by side, to ``history``; return its numbers at ``places`` (rows, columns)."""
    return [read_history(push_history(history, a, b), places)]


def columns_of(columns: Any, a: Any, b: Any) -> list[Any]:
    """Return the columns ``columns`` (columns,) of ``a``, and of a mask."""
    return [take_columns(a, columns), take_columns(a > b, columns)]


def first_difference() -> str | None:
    """Return the first difference between native and NumPy's results of all operations, or None: takes 1 ms.

    Some inputs are zero, infinite or NaN.
    """
    rng, shape = np.random.default_rng(0), (5, 9)
    for dtype in (np.float64, np.float32):
        a, b, c = (10.0 * rng.normal(size=(3, *shape))).astype(dtype)
        special = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 2.5], dtype)
        a.flat[:36], b.flat[:36] = np.repeat(special, 6), np.tile(special, 6)
        inputs = a, b, c, rng.normal(size=(*shape, shape[1])).astype(dtype)
        with np.errstate(all="ignore"):
            expected = every_operation(*inputs)
        found = ArrayProgram(trace(every_operation, 0, 4, dtype), (), 4, shape, dtype)(*inputs)
        for number, pair in enumerate(zip(found, expected, strict=True)):
            if _bits(pair[0]) != _bits(pair[1]):
                return f"result {number} of a native program of {np.dtype(dtype)} is not NumPy's"
    a, b, history = *rng.normal(size=(2, *shape)), rng.normal(size=(shape[0], 4, 2 * shape[1]))
    places = rng.integers(history.size, size=shape)
    (numbers,) = history_operations(places, history, a, b)
    if _bits(ArrayProgram(trace(history_operations, 1, 3), [places], 3, shape)(history, a, b)[0]) != _bits(numbers):
        return "the history of a native program is not NumPy's"
    columns = rng.integers(shape[1], size=shape[1])
    found = ArrayProgram(trace(columns_of, 1, 2), [columns], 2, shape)(a, b)
    if any(_bits(one) != _bits(other) for one, other in zip(found, columns_of(columns, a, b), strict=True)):
        return "the columns of a native program are not NumPy's"
    return None


def _bits(array: Any) -> tuple[Any, bytes]:
    """Return dtype and bytes of an array, with one value for all NaN, since their sign has no meaning."""
    return array.dtype, np.where(np.isnan(array), np.nan, array).tobytes()
