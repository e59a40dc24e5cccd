"""Checks of arguments; each error names the argument, the joint or env, the value and the remedy."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.errors import InvalidArgumentError

T = TypeVar("T")


def integer(argument: str, value: Any, low: int, high: int) -> int:
    """``value`` as an int within [low, high]."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise InvalidArgumentError(argument, "must be a whole number", value=value, remedy="pass an int")
    if not low <= value <= high:
        raise InvalidArgumentError(
            argument, "out of range", value=int(value), remedy=f"use a number from {low} to {high}"
        )
    return int(value)


def number(argument: str, value: Any, low: float, high: float, unit: str) -> float:
    """``value`` as a finite float within [low, high]."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.number):
        raise InvalidArgumentError(argument, "must be a number", value=value, remedy=f"pass a float ({unit})")
    if not low <= value <= high:  # NaN is in no range
        raise InvalidArgumentError(
            argument,
            "out of range",
            value=value,
            remedy=f"use a number from {low:g} to {high:g} ({unit})",
        )
    return float(value)


def choice(argument: str, value: Any, known: Collection[str]) -> str:
    """``value`` if it is one of ``known``."""
    if not isinstance(value, str) or value not in known:
        raise InvalidArgumentError(
            argument, "unknown option", value=value, remedy=f"use one of {', '.join(map(repr, known))}"
        )
    return value


def flag(argument: str, value: Any) -> bool:
    """``value`` as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise InvalidArgumentError(argument, "must be True or False", value=value, remedy="pass a bool")
    return bool(value)


def instance(argument: str, value: Any, kind: type[T], remedy: str) -> T:
    """Return ``value`` if it is a ``kind``."""
    if not isinstance(value, kind):
        raise InvalidArgumentError(argument, f"must be a {kind.__name__}", value=value, remedy=remedy)
    return value


def file_path(argument: str, value: Any, suffixes: Collection[str] = ()) -> Path:
    """Return ``value`` as a path that ends in one of ``suffixes``, if any are given."""
    if not isinstance(value, str | os.PathLike) or "\0" in os.fspath(value):
        raise InvalidArgumentError(argument, "must be a path", value=value, remedy="pass the file's name")
    path = Path(value)
    if suffixes and path.suffix.lower() not in suffixes:
        raise InvalidArgumentError(
            argument, "unknown file format", value=str(path), remedy=f"end it in {' or '.join(suffixes)}"
        )
    return path


def read_array(argument: str, value: ArrayLike, kinds: str = "iuf") -> NDArray[Any]:
    """``value`` as an array of a dtype whose kind is one of ``kinds``, of any shape."""
    try:
        result = np.asarray(value)
        if result.dtype.kind not in kinds:
            raise TypeError(f"its dtype is {result.dtype}")
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        what = "bools" if kinds == "b" else "numbers"
        raise InvalidArgumentError(
            argument, f"cannot be read as an array of {what}: {error}", remedy=f"pass an array of {what}"
        ) from None
    return result


def array(
    argument: str,
    value: ArrayLike,
    shape: tuple[int, ...],
    joint_names: Sequence[str],
    *,
    finite: bool = True,
) -> NDArray[np.float64]:
    """``value`` as float64, broadcast to ``shape`` (..., envs, dof) where its trailing axes allow.

    A scalar stands for all joints, (dof,) for all envs. All entries must be finite, unless ``finite`` is False.
    """
    result = read_array(argument, value).astype(np.float64, copy=False)
    try:
        if result.ndim and result.shape[-1] != shape[-1]:
            raise ValueError  # one number for all joints is a scalar, and not an array of one
        result = result if result.shape == shape else np.broadcast_to(result, shape)
    except ValueError:
        raise InvalidArgumentError(
            argument,
            f"has shape {result.shape}, needs {shape} or ({shape[-1]},)",
            remedy=f"the last axis counts the joints {', '.join(joint_names)}",
        ) from None
    if finite and not np.isfinite(result).all():
        *_, env, joint = (int(index) for index in np.argwhere(~np.isfinite(result))[0])
        raise InvalidArgumentError(
            argument,
            "is not finite",
            joint=joint_names[joint],
            env=env,
            value=float(result[~np.isfinite(result)][0]),
            remedy="pass finite numbers",
        )
    return result


def within(argument: str, rows: NDArray[np.float64], far: float, joint_names: Sequence[str]) -> NDArray[np.float64]:
    """``rows`` (..., envs, dof) if no entry is beyond +-``far``; NaN counts as near."""
    beyond = np.abs(rows) > far
    if beyond.any():
        *_, env, joint = (int(index) for index in np.argwhere(beyond)[0])
        raise InvalidArgumentError(
            argument,
            f"is beyond +-{far:g}",
            joint=joint_names[joint],
            env=env,
            value=float(rows[beyond][0]),
            remedy="give what a robot can have",
        )
    return rows


def joint_speeds(argument: str, value: ArrayLike, joint_names: Sequence[str]) -> NDArray[np.float64]:
    """``value`` as one positive number per joint (dof,)."""
    speeds = array(argument, value, (1, len(joint_names)), joint_names)[0]
    if (speeds <= 0).any():
        index = int(np.argmax(speeds <= 0))
        raise InvalidArgumentError(
            argument,
            "must be > 0",
            joint=joint_names[index],
            value=float(speeds[index]),
            remedy="leave it out for none",
        )
    return speeds


def env_mask(argument: str, value: ArrayLike, num_envs: int) -> NDArray[np.bool_]:
    """``value`` as bools, one for each env (envs,)."""
    mask = read_array(argument, value, "b")
    if mask.shape != (num_envs,):
        raise InvalidArgumentError(
            argument,
            f"has shape {mask.shape}, needs ({num_envs},)",
            remedy="use e.g. mask = ~obs.ok",
        )
    return mask
