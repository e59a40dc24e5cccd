"""Checks of arguments; each error names the argument, the joint or env, the value and the remedy.

Every function takes the argument's name and its value, returns the value in its canonical form, and
raises :class:`batchpid.InvalidArgumentError` where the value is invalid.
"""

from __future__ import annotations

import difflib
import math
import os
import sys
import unicodedata
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.errors import InvalidArgumentError

S = TypeVar("S", bound=str)
T = TypeVar("T")
LONGEST_STEP = 1.0
"""Longest time step of a loop [s]; a larger number is refused as a rate in Hz."""
AxisKind = Literal["joint", "entry"]


def integer(
    argument: str,
    value: object,
    low: int,
    high: int,
) -> int:
    """Return ``value`` as an int within [low, high]."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise InvalidArgumentError(
            argument, "must be a whole number", value=value, remedy="pass an int"
        )
    if not low <= value <= high:
        raise InvalidArgumentError(
            argument, "out of range", value=int(value), remedy=f"use a number from {low} to {high}"
        )
    return int(value)


def number(
    argument: str,
    value: object,
    low: float,
    high: float,
    unit: str,
) -> float:
    """Return ``value`` as a finite float within [low, high]; an infinite bound does not limit."""
    value = _scalar(argument, value, unit)
    if not low <= value <= high or math.isinf(value):  # NaN is in no range
        remedy = f"use a number from {low:g} to {high:g} ({unit})"
        raise InvalidArgumentError(argument, "out of range", value=value, remedy=remedy)
    return value


def positive(argument: str, value: object, unit: str) -> float:
    """Return ``value`` as a finite float above 0."""
    value = _scalar(argument, value, unit)
    if not 0 < value < math.inf:
        problem = "must be positive and finite"
        remedy = f"use a number > 0 ({unit})"
        raise InvalidArgumentError(argument, problem, value=value, remedy=remedy)
    return value


def time_step(argument: str, value: object) -> float:
    """Return ``value`` as a time step [s]; a value above :data:`LONGEST_STEP` is refused as a rate
    in Hz.
    """
    value = positive(argument, value, "s")
    if value > LONGEST_STEP:
        problem = f"is longer than {LONGEST_STEP:g} s, and looks like a rate in Hz"
        raise InvalidArgumentError(
            argument, problem, value=value, remedy=f"give {argument} in seconds, 1/{value:g}"
        )
    return value


def check_time_step(dt: object) -> None:
    """Check a time step that is not an array; the values of arrays are not read."""
    # It is called at every sim step: most of them do without the cost of the checks.
    if isinstance(dt, float) and 0.0 < dt <= LONGEST_STEP:
        return
    if isinstance(dt, np.generic) or not hasattr(dt, "__array_namespace__"):
        time_step("dt", dt)


def choice(argument: str, value: object, known: Collection[S]) -> S:
    """Return ``value`` if it is one of ``known``."""
    for option in known:
        if isinstance(value, str) and option == value:
            return option
    remedy = f"use one of {', '.join(map(repr, known))}"
    near = difflib.get_close_matches(str(value), known, 1)
    if near:
        remedy = f"did you mean {near[0]!r}? Else {remedy}"
    raise InvalidArgumentError(argument, "unknown option", value=value, remedy=remedy)


def flag(argument: str, value: object) -> bool:
    """Return ``value`` as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise InvalidArgumentError(
            argument, "must be True or False", value=value, remedy="pass a bool"
        )
    return bool(value)


def instance(
    argument: str,
    value: object,
    kind: type[T],
    remedy: str,
) -> T:
    """Return ``value`` if it is a ``kind``."""
    if not isinstance(value, kind):
        problem = f"must be of type {kind.__name__}"
        raise InvalidArgumentError(argument, problem, value=value, remedy=remedy)
    return value


def is_name(text: str) -> bool:
    """Return whether ``text`` can be a name: without control characters, line breaks and halves of
    surrogate pairs.

    Robots of others have any names. In a file, a message or a picture these characters would end
    the line, or cannot be written.
    """
    categories = {unicodedata.category(character) for character in text}
    return categories.isdisjoint({"Cc", "Cs", "Zl", "Zp"})


def names(argument: str, value: Sequence[str], count: int | None = None) -> list[str]:
    """Return ``value`` as a list of different names, ``count`` of them if given."""
    # A string is a sequence of names, too, and never meant.
    sequence = isinstance(value, Sequence) and not isinstance(value, str)
    if not sequence or not all(isinstance(name, str) for name in value):
        raise InvalidArgumentError(
            argument, "must be a list of names", value=value, remedy="pass a list of strings"
        )
    if count is not None and len(value) != count:
        problem = f"must hold {count} names"
        raise InvalidArgumentError(argument, problem, value=value, remedy="pass that many")
    for name in value:
        if not is_name(name):
            problem = "has a name with a control character or a line break"
            remedy = "use printable characters"
            raise InvalidArgumentError(argument, problem, value=name, remedy=remedy)
    if len(set(value)) != len(value):
        remedy = "name each once"
        raise InvalidArgumentError(argument, "repeats a name", value=value, remedy=remedy)
    return list(value)


def file_path(argument: str, value: object, suffixes: Collection[str] = ()) -> Path:
    """Return ``value`` as a path that ends in one of ``suffixes``, if any are given."""
    if not isinstance(value, str | os.PathLike) or "\0" in os.fspath(value):
        raise InvalidArgumentError(
            argument, "must be a path", value=value, remedy="pass the file's name"
        )
    # Whether the file is there is for the operating system to say.
    path = Path(value)
    if suffixes and path.suffix.lower() not in suffixes:
        raise InvalidArgumentError(
            argument,
            "unknown file format",
            value=str(path),
            remedy=f"end it in {' or '.join(suffixes)}",
        )
    return path


def is_traced(value: object) -> bool:
    """Return whether ``value`` is an array inside jax.jit, jax.grad or jax.vmap, whose entries
    cannot be checked.
    """
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(value, jax.core.Tracer)


def read_array(
    argument: str,
    value: ArrayLike,
    kinds: str = "iuf",
    *,
    traced: bool = False,
) -> NDArray[Any]:
    """Return ``value`` as an array, of any shape, of a dtype whose kind is one of ``kinds``.

    With ``traced`` an array that JAX traces is returned as it came.
    """
    try:
        if isinstance(value, np.ma.MaskedArray):
            raise TypeError("it is masked")
        result: NDArray[Any] = value if traced and is_traced(value) else np.asarray(value)  # type: ignore[assignment]
        if result.dtype.kind not in kinds:
            raise TypeError(f"its dtype is {result.dtype}")
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        what = "bools" if kinds == "b" else "numbers"
        raise InvalidArgumentError(
            argument,
            f"cannot be read as an array of {what}: {error}",
            remedy=f"pass an array of {what}",
        ) from None
    return result


def broadcast(
    argument: str,
    value: ArrayLike,
    shape: tuple[int, ...],
    remedy: str = "give one value, one per joint, or one per env and joint",
) -> NDArray[np.float64]:
    """Return ``value`` as float64, broadcast to ``shape``."""
    if type(value) is np.ndarray and value.dtype == np.float64:  # nearly always in a tick
        result = value
    else:
        result = read_array(argument, value).astype(np.float64, copy=False)
    if result.shape == shape:
        return result
    try:
        # A small copy is faster to make, and to read, than a view.
        if len(shape) == 2 and result.ndim <= 2:
            rows = np.empty(shape)
            rows[...] = result
            return rows
        return np.broadcast_to(result, shape)
    except ValueError:
        problem = f"has shape {result.shape}, which does not broadcast to {shape}"
        raise InvalidArgumentError(argument, problem, remedy=remedy) from None


def array(
    argument: str,
    value: ArrayLike,
    shape: tuple[int, ...],
    names: Sequence[str],
    *,
    finite: bool = True,
    kind: AxisKind = "joint",
) -> NDArray[np.float64]:
    """Return ``value`` as float64, broadcast to ``shape`` (..., envs, dof) where its trailing axes
    allow.

    A scalar applies to all joints, (dof,) to all envs. All entries must be finite, unless
    ``finite`` is False. ``names`` holds the name of each column. ``kind`` is the type of a column:
    a joint, or an entry of a command.
    """
    is_read = type(value) is np.ndarray and value.dtype == np.float64  # nearly always
    result: NDArray[Any] = value if is_read else read_array(argument, value)  # type: ignore[assignment]
    flat = result.reshape(-1)
    if not is_read or result.shape != shape:
        columns = "joints" if kind == "joint" else "entries"
        remedy = f"the last axis counts the {columns} {', '.join(names)}"
        # One number for all joints is a scalar, not an array of one.
        if result.ndim and result.shape[-1] != shape[-1]:
            raise InvalidArgumentError(
                argument, f"has shape {result.shape}, not {shape} or {shape[-1:]}", remedy=remedy
            )
        result = broadcast(argument, result, shape, remedy)
    # The sum of squares costs a third, and is finite for most; BLAS uses threads for a longer one.
    is_sound = flat.size < 10_000 and math.isfinite(flat.dot(flat))
    if finite and not is_sound and not (good := np.isfinite(result)).all():
        entries(
            argument,
            result,
            good,
            "is not finite",
            names,
            kind=kind,
            remedy="pass finite numbers",
        )
    return result


def entries(
    argument: str,
    values: NDArray[Any],
    good: ArrayLike,
    problem: str,
    names: Sequence[str] | None = None,
    *,
    kind: AxisKind = "joint",
    remedy: str = "correct that entry",
) -> None:
    """Raise for the first entry of ``values`` (..., envs, joints), or (joints,), that is not
    ``good``.

    The error names the joint, and the env where there are several; an entry of a scalar has
    neither. ``names`` and ``kind`` as for :func:`array`.
    """
    if np.all(good):
        return
    # The first bad entry is enough to find the cause.
    index = tuple(int(n) for n in np.argwhere(~np.asarray(good))[0])
    place = index[-1] if index else None
    value = values[index]
    where: dict[str, Any] = {kind: place if place is None or names is None else names[place]}
    raise InvalidArgumentError(
        argument,
        problem,
        **where,
        env=index[-2] if len(index) > 1 and values.shape[-2] > 1 else None,
        value=value.item() if isinstance(value, np.generic) else value,
        remedy=remedy,
    )


def at_least(
    argument: str,
    values: NDArray[Any],
    low: float,
    joint_names: Sequence[str] | None = None,
    *,
    above: bool = False,
    infinite: bool = False,
    kind: AxisKind = "joint",
) -> NDArray[Any]:
    """Return ``values`` (..., envs, joints) if every entry is >= ``low``, or > it, and finite
    unless ``infinite``.
    """
    good = ((values > low) if above else (values >= low)) & (infinite | np.isfinite(values))
    bounds = ["finite"] * (not infinite) + [f"{'>' if above else '>='} {low:g}"] * math.isfinite(
        low
    )
    problem = f"must be {' and '.join(bounds) or 'a number'}"
    entries(
        argument,
        values,
        good,
        problem,
        joint_names,
        kind=kind,
    )
    return values


def within(
    argument: str,
    rows: NDArray[np.float64],
    far: float,
    joint_names: Sequence[str],
) -> NDArray[np.float64]:
    """Return ``rows`` (..., envs, dof) if no entry is beyond +-``far``; NaN passes."""
    near = ~(np.abs(rows) > far)
    entries(
        argument,
        rows,
        near,
        f"is beyond +-{far:g}",
        joint_names,
        remedy="check the unit",
    )
    return rows


def env_mask(argument: str, value: ArrayLike, num_envs: int) -> NDArray[np.bool_]:
    """Return ``value`` as one bool per env (envs,), a copy."""
    mask = read_array(argument, value, "b").copy()
    if mask.shape != (num_envs,):
        problem = f"has shape {mask.shape}, needs ({num_envs},)"
        raise InvalidArgumentError(argument, problem, remedy="use e.g. mask = ~obs.ok")
    return mask


def check_keywords(owner: str, given: Collection[str], known: Collection[str]) -> None:
    """Raise InvalidArgumentError for the first name in ``given`` that is not among the ``known``
    ones of ``owner``.
    """
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            if near:
                remedy = f"did you mean {near[0]!r}?"
            else:
                remedy = f"use one of {', '.join(known)}"
            raise InvalidArgumentError(name, f"is not an argument of {owner}", remedy=remedy)


def _scalar(argument: str, value: object, unit: str) -> float:
    if isinstance(value, bool | np.bool_) or not isinstance(
        value, int | float | np.integer | np.floating
    ):
        raise InvalidArgumentError(
            argument, "must be a number", value=value, remedy=f"pass a float ({unit})"
        )
    try:
        return float(value)
    except OverflowError:  # an int beyond all floats
        return math.inf
