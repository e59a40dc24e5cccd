"""Operations on rows of the law, for NumPy and JAX arrays and for the symbols of a trace; read-only
views; and the precision of JAX in programs of batchpid. All other settings of JAX are the caller's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import cache, wraps
from importlib.util import find_spec
from types import NoneType
from typing import Any, TypeVar

import numpy as np

from batchpid.arrays.array_types import CHOICE_TYPES, Array, ArrayModule, DType
from batchpid.arrays.trees import flatten, walked
from batchpid.errors import MissingDependencyError

T = TypeVar("T")
V = TypeVar("V")
TURN = 2 * math.pi
_NUMPY_OR_NEUTRAL = frozenset({np.ndarray, NoneType, float, int, *CHOICE_TYPES})


def namespace(*leaves: Array) -> ArrayModule:
    """Return the array namespace in which all these leaves can be used: NumPy's, unless one belongs
    to another.
    """
    if not _NUMPY_OR_NEUTRAL.issuperset(map(type, leaves)):
        for leaf in leaves:
            if not isinstance(leaf, np.ndarray) and hasattr(leaf, "__array_namespace__"):
                module: ArrayModule = leaf.__array_namespace__()
                return module
    return np


def in_dtype_of(params: Iterable[Array], *arrays: Array) -> list[Array]:
    """Return ``arrays`` in the dtype of the floats in ``params``, a named tuple; None stays
    None.
    """
    like = next(
        (leaf.dtype for leaf in params if getattr(leaf, "dtype", np.dtype(bool)).kind == "f"), None
    )
    return [
        x if x is None or like is None or x.dtype == like else _as_dtype(x, like) for x in arrays
    ]


def _as_dtype(x: Array, dtype: DType) -> Array:
    xp = namespace(x)
    # In JAX float32 instead of float64, unless that is enabled.
    return x.astype(xp.result_type(np.zeros((), dtype)))


def clip(
    x: Array,
    low: Array,
    high: Array,
    xp: ArrayModule,
) -> Array:
    """Return x within [low, high], either of which may be None; NaN stays NaN."""
    x = x if low is None else xp.maximum(x, low)
    if high is None:
        return x
    return xp.minimum(x, high)


def _recorded(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator: a trace (:mod:`batchpid.native.tracing`) records a call as the operation
    ``name``.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(*arrays: Array) -> Array:
            record = getattr(arrays[0], "record", None)
            if record is None:
                return function(*arrays)
            return record(name, *arrays)

        return call

    return decorate


@_recorded("matrix_vector")
def matrix_vector(matrix: Array, vector: Array) -> Array:
    """Return matrix @ vector for each env, with sums in one order for any number of envs."""
    return (matrix * vector[:, None, :]).sum(-1)


@_recorded("row_minimum")
def row_minimum(rows: Array) -> Array:
    """Return the minimum of each row (envs, 1)."""
    return rows.min(-1, keepdims=True)


@_recorded("gather")
def take_columns(rows: Array, columns: Array) -> Array:
    """Return the columns of ``rows`` (..., joints) at the indices ``columns`` (joints,)."""
    return namespace(rows).take(rows, columns, axis=-1)


@_recorded("push")
def push_history(history: Array, value: Array) -> Array:
    """Return ``history`` (..., samples, joints) with ``value`` (..., joints) as latest sample."""
    xp = namespace(history, value)
    return xp.concatenate((value[..., None, :], history[..., :-1, :]), axis=-2)


@_recorded("take_row")
def take_rows(table: Array, rows: Array) -> Array:
    """Return the numbers of ``table`` (..., rows, joints) in row ``rows`` (..., joints) of each
    joint, or in several (..., n, joints); the numbers of the rows are floats.
    """
    xp = namespace(table, rows)
    # Robot by robot, so devices that share the envs do not communicate.
    if rows.ndim == table.ndim:
        return xp.take_along_axis(table, rows.astype(int), -2)
    return xp.take_along_axis(table, rows[..., None, :].astype(int), -2)[..., 0, :]


def replace_envs(state: T, fresh: T, mask: Array) -> T:
    """Return ``state``, a tree of arrays (envs, ...), with the envs of ``mask`` (envs,) bool as in
    ``fresh``, which has the same structure.
    """
    new = flatten(fresh, read=lambda leaf: leaf)  # by name: JAX sorts the keys of a mapping

    def chosen(name: str, old: Array) -> Array:
        xp = namespace(old, new[name], mask)
        rows = xp.asarray(mask)
        return xp.where(rows.reshape(*rows.shape, *[1] * (old.ndim - rows.ndim)), new[name], old)

    replaced: T = walked(chosen, state)
    return replaced


def wrap(angle: Array, turns_per_rad: Array, xp: ArrayModule) -> Array:
    """Return an angle, or a difference of angles, wrapped to half a turn on either side of 0; where
    ``turns_per_rad`` is 0 it is unchanged.
    """
    if turns_per_rad is None:
        return angle
    return angle - TURN * xp.rint(angle * turns_per_rad)


def nearest_turn(
    angle: Array,
    near: Array,
    turns_per_rad: Array,
    xp: ArrayModule,
) -> Array:
    """Return ``angle`` plus the whole turns that bring it within half a turn of ``near``; other
    arguments as in :func:`wrap`.
    """
    if turns_per_rad is None:
        return angle
    return angle - TURN * xp.rint((angle - near) * turns_per_rad)


def flush(x: Array, tiny: Array) -> Array:
    """Return x rounded to a multiple of the last bit of ``tiny``, which leaves larger numbers
    unchanged.

    A decaying filter ends in denormal numbers, whose arithmetic is ten times slower. Adding and
    subtracting a tiny number costs two additions and no branch.
    """
    return (x + tiny) - tiny


@cache
def tiny_of(dtype: DType) -> float:
    """Return the square root of the smallest normal number of ``dtype``.

    Its last bit is far above the denormals, and the number itself far below the last bit of any
    relevant number.
    """
    return float(np.sqrt(np.finfo(dtype).tiny))


def read_only(array: V) -> V:
    """Return a read-only view of a NumPy array; return any other object unchanged."""
    if not isinstance(array, np.ndarray):
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def require_jax() -> None:
    """Raise MissingDependencyError if JAX is not installed. It is not imported."""
    if find_spec("jax") is None:
        raise MissingDependencyError("jax", "backend='jax'", "jax")


def precision(dtype: DType) -> AbstractContextManager[None]:
    """Return a context in which JAX has arrays of ``dtype``, "float64" or "float32"; None: as the
    caller has set it.
    """
    import jax

    config: Any = jax.config
    is_wide = dtype == "float64"
    # To enter a context takes longer than a small program.
    if dtype is None or config.jax_enable_x64 == is_wide:
        return nullcontext()
    # Before JAX 0.8 it is in another module.
    home: Any = jax if hasattr(jax, "enable_x64") else jax.experimental
    context: AbstractContextManager[None] = home.enable_x64(is_wide)
    return context
