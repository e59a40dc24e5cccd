"""Declared fields: unit, bounds and neutral value of an option, in its annotation.

Params, actuators, guards, params of operational-space control, randomizations and options of a
runner declare each option once. The checks of options and leaves, the keys of files, the neutral
values, the bounds of a randomization and the tables of the guides (docs/tables.py) come from these
annotations::

    rate: Annotated[Array, Field("rad/s or m/s", math.inf, above=True)] = None
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import NoneType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

from batchpid.arrays.array_types import Array, Kind
from batchpid.checks import (
    AxisKind,
    at_least,
    choice,
    entries,
    flag,
    integer,
    is_traced,
    number,
)

T = TypeVar("T")


class Field(NamedTuple):
    """Declaration of an option: a number, or a value of the type of ``neutral``."""

    unit: str = ""
    neutral: Any = 0.0
    """Value without effect. If it is infinite, infinite values are allowed."""
    low: float = 0.0
    """Smallest value."""
    above: bool = False
    """Whether values must be greater than ``low``."""
    high: float = math.inf
    """Largest value."""
    group: str = ""
    """Name of the group of fields to which it belongs, such as "motor"; see :func:`in_group`."""
    default: object = None
    """Default of the option."""

    def checked(
        self,
        name: str,
        values: Array,
        joint_names: Sequence[str] | None,
        kind: AxisKind = "joint",
    ) -> Array:
        """Return ``values`` (..., envs, joints) after a check of the bounds; values that JAX traces
        are not checked.

        Raises InvalidArgumentError if an entry is out of bounds, or infinite where ``neutral`` is
        not.
        """
        if not is_traced(values):
            at_least(
                name,
                values,
                self.low,
                joint_names,
                above=self.above,
                infinite=math.isinf(self.neutral),
                kind=kind,
            )
            remedy = f"use a number from {self.low:g} to {self.high:g} ({self.unit})"
            entries(
                name,
                values,
                values <= self.high,
                "out of range",
                joint_names,
                kind=kind,
                remedy=remedy,
            )
        return values


def declared(owner: Callable[..., object], kind: type[T]) -> dict[str, T]:
    """Return the metadata of type ``kind``, such as Field, in the annotations of a constructor or
    class, by name.
    """
    hints = get_type_hints(owner, include_extras=True).items()
    metadata = ((name, one) for name, hint in hints for one in getattr(hint, "__metadata__", ()))
    return {name: one for name, one in metadata if isinstance(one, kind)}


def in_group(fields: Mapping[str, Field], group: str) -> dict[str, Field]:
    """Return the fields that belong to ``group``."""
    return {name: field for name, field in fields.items() if field.group == group}


def plain(name: str, kind: Kind, value: Any) -> Any:
    """Return ``value`` as a bool, number or choice, if its declared type is one of these, or one of
    these and None.

    A value of another declared type is returned unchanged and unchecked.

    Raises InvalidArgumentError if a number is out of the bounds of its :class:`Field`, or the value
    has another type.
    """
    if get_origin(kind) is Annotated:
        kind, *metadata = get_args(kind)
    else:
        kind, *metadata = (kind,)
    bounds = next((one for one in metadata if isinstance(one, Field)), Field(low=-math.inf))
    # None is allowed where the type says so; a union of more is checked elsewhere.
    if NoneType in get_args(kind):
        kinds = [one for one in get_args(kind) if one is not NoneType]
        if value is None or len(kinds) > 1:
            return value
        (kind,) = kinds
    if get_origin(kind) is Literal:
        return choice(name, value, get_args(kind))
    if kind is bool:
        return flag(name, value)
    if kind is int:
        return integer(name, value, int(bounds.low), int(bounds.high))
    if kind is float:
        return number(name, value, bounds.low, bounds.high, bounds.unit)
    return value
