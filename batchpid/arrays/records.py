"""Records of arrays: named tuples whose fields are declared once, their constructors, and their
representations.

A record inherits from a ``NamedTuple``: ``class Guard(Record, GuardFields)``. So it is a pytree
that JAX knows without registration. A leaf is an array (1 | envs, joints), None (off), or a choice
without a number (:mod:`batchpid.arrays.array_types`). Unit, bounds and neutral value of a field stand
in its annotation, a :class:`batchpid.arrays.field_tables.Field`; checks, files, randomizations and
the tables of the guides come from there.

Inside jax.jit, jax.grad and jax.vmap the entries of an array are not known. Of such a traced array
the shape is checked alone, and it stays a leaf even where it might turn out to be off.
"""

from __future__ import annotations

import inspect
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from typing import Any, ClassVar, ParamSpec, TypeVar

import numpy as np

from batchpid.arrays.array_types import Array, Document, DType, Rows
from batchpid.arrays.elementwise import namespace
from batchpid.arrays.field_tables import Field
from batchpid.arrays.trees import mapped, parts
from batchpid.checks import (
    AxisKind,
    check_keywords,
    entries,
    integer,
    is_traced,
    names,
    read_array,
)
from batchpid.errors import InvalidArgumentError

P = ParamSpec("P")
R = TypeVar("R", bound="Record")
T = TypeVar("T")
MOST_JOINTS = 100_000
ANY_NUMBER = Field(neutral=math.inf, low=-math.inf)
"""Field of any number but NaN."""
LINE_WIDTH = 130
"""Longest line of a representation."""
Ends = tuple[Array, Array]
"""A lower and an upper limit, each None for none."""


class Record(tuple[Any, ...]):
    """Mixin for a named tuple of leaves: its parts, sizes, checks and representation."""

    __slots__ = ()
    NAME: ClassVar[str] = ""
    """Name of a record in errors, as in "params"."""
    FIELDS: ClassVar[Mapping[str, Field]] = {}
    """Declared fields of numbers, by name."""
    WHOLE: ClassVar[tuple[str, ...]] = ()
    """Leaves with one value for all joints."""

    def options(self) -> Document:
        """Return the options that are on, as arguments of the constructor that build this record
        again.
        """
        return self.leaves()

    def leaves(self) -> Document:
        """Return the arrays by name."""
        return {
            name: leaf for name, leaf in parts(self).items() if not isinstance(leaf, tuple | None)
        }

    @property
    def num_joints(self) -> int:
        """Number of joints; 0 where all fields are off."""
        shapes = [leaf.shape for name, leaf in self.leaves().items() if name not in self.WHOLE]
        if shapes:
            return int(shapes[0][-1])
        return 0

    @property
    def num_envs(self) -> int:
        """Number of envs with separate values; 1 where all envs share them."""
        return max((leaf.shape[0] for leaf in self.leaves().values() if leaf.ndim > 1), default=1)

    @property
    def dtype(self) -> DType:
        """Dtype of the arrays."""
        dtype: DType = next(leaf.dtype for leaf in self.leaves().values())
        return dtype

    def for_envs(self: R, envs: slice | Rows | Sequence[int]) -> R:
        """Return the part of some envs (a slice or an index array); shared rows stay shared."""
        part: R = mapped(lambda leaf: leaf if leaf.shape[0] == 1 else leaf[envs], self)
        return part

    def for_rank(self: R, ndim: int) -> R:
        """Return the record for arrays of ``ndim`` axes: for one robot's (joints,), such as under
        jax.vmap, shared rows (1, joints) lose their axis of envs.
        """
        if ndim != 1:
            return self
        part: R = mapped(
            lambda leaf: leaf[0] if leaf.ndim == 2 and leaf.shape[0] == 1 else leaf, self
        )
        return part

    def for_joints(self: R, joints: Rows | Sequence[int] | slice) -> R:
        """Return the part of some joints (an index array, a mask or a slice)."""
        whole = {name: leaf for name, leaf in self.leaves().items() if name in self.WHOLE}
        part: Any = mapped(lambda leaf: leaf[:, joints], self)
        chosen: R = part._replace(**whole)
        return chosen

    def matched_to(self: R, fresh: R) -> R:
        """Return this state with exactly the leaves of ``fresh``: missing ones from there, the
        others dropped.
        """
        both = zip(self, fresh, strict=True)
        return type(self)(*(new if new is None or old is None else old for old, new in both))

    def check(self, num_envs: int, joint_names: Sequence[str] | None = None) -> None:
        """Raise InvalidArgumentError unless every leaf is right for (num_envs, joints): for edits
        by hand.

        A leaf without a declared field may hold any numbers.
        """
        joints = self.num_joints if joint_names is None else len(joint_names)
        for name, leaf in self.leaves().items():
            if name in self.WHOLE:
                continue
            argument = f"{self.NAME}.{name}"
            if leaf.dtype != self.dtype or leaf.shape not in ((1, joints), (num_envs, joints)):
                problem = f"is {leaf.dtype} {leaf.shape}, not {self.dtype} ({num_envs}, {joints})"
                remedy = "give one row, or one row per env, of one dtype"
                raise InvalidArgumentError(argument, problem, remedy=remedy)
            if not is_traced(leaf):
                field = self.FIELDS.get(name, ANY_NUMBER)
                field.checked(argument, np.asarray(leaf), joint_names)

    def __repr__(self) -> str:
        return array_summary(self)


def with_fields(*fields: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorate a constructor that takes the declared ``fields`` as ``**options``, besides its own
    arguments: other keywords are refused, with the nearest name.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        declared = inspect.getfullargspec(function)
        arguments = [*declared.args, *declared.kwonlyargs, *fields]

        @wraps(function)
        def build(*args: P.args, **options: P.kwargs) -> T:
            check_keywords(function.__name__, options, arguments)
            return function(*args, **options)

        return build

    return decorate


class LeafBuilder:
    """Builder of the leaves of a record, which agree in joints, envs and dtype."""

    def __init__(
        self,
        joints: int,
        joint_names: Sequence[str] | None,
        dtype: DType = None,
        values: Iterable[object] = (),
        kind: AxisKind = "joint",
    ) -> None:
        """Without a ``dtype``, use the dtype of the traced arrays among ``values``, else
        float64. ``kind``: whether the names are joints or entries of a command.
        """
        self.kind: AxisKind = kind
        self.joints = integer("joints", joints, 1, MOST_JOINTS)
        self.num_envs = 1
        if joint_names is None:
            self.names = None
        else:
            self.names = names("joint_names", joint_names, self.joints)
        if dtype is None:
            traced: list[Array] = [value for value in values if is_traced(value)]
            floats = [value for value in traced if value.dtype.kind == "f"]
            xp = namespace(*traced)
            if floats:
                dtype = xp.result_type(*floats)
            else:
                dtype = xp.asarray(0.0).dtype
        try:
            self.dtype: DType = np.dtype(dtype)
        except TypeError:
            self.dtype = np.dtype(object)
        if self.dtype not in (np.float32, np.float64):
            remedy = "use float32 or float64"
            raise InvalidArgumentError("dtype", "unknown dtype", value=str(dtype), remedy=remedy)

    def array(self, name: str, value: Array, field: Field) -> Array:
        """Return ``value`` as (1 | envs, joints) with every entry within the bounds of ``field``;
        None stays.
        """
        if value is None:
            return None
        # A number beyond float32 becomes infinite, and is judged by the bounds.
        with np.errstate(over="ignore"):
            array = read_array(name, value, traced=True).astype(self.dtype)
        return field.checked(name, self.rows(name, array), self.names, kind=self.kind)

    def option(self, name: str, value: Array, field: Field) -> Array:
        """Return an option's leaf: None where it is neutral on every joint of every env."""
        array = self.array(name, value, field)
        if is_everywhere(array, field.neutral):
            return None
        return self.freeze(array)

    def options(self, fields: Mapping[str, Field], values: Mapping[str, Array]) -> Document:
        """Return the leaves of all ``fields``."""
        return {name: self.option(name, values.get(name), field) for name, field in fields.items()}

    def limits(
        self,
        size: str,
        low: str,
        high: str,
        values: Mapping[str, Array],
    ) -> Ends:
        """Return the leaves of a lower and an upper limit, each None where it is infinite
        everywhere.

        ``size``, ``low`` and ``high`` name the options of both ends, the lower and the upper one.
        """
        extent = self.array(size, values.get(size), ANY_NUMBER._replace(low=0.0))
        least, most = (self.array(name, values.get(name), ANY_NUMBER) for name in (low, high))
        # Either the size or its ends.
        if extent is not None:
            if least is not None or most is not None:
                problem = f"is given together with {low} or {high}"
                remedy = "give the symmetric limit, or the two ends"
                raise InvalidArgumentError(size, problem, remedy=remedy)
            least, most = -extent, extent
        elif not (least is None or most is None or is_traced(least) or is_traced(most)):
            entries(low, least, least <= most, f"exceeds {high}", self.names)
        least = None if is_everywhere(least, -math.inf) else least
        return least, None if is_everywhere(most, math.inf) else most

    def mask(self, name: str, value: Array) -> Array:
        """Return a mask of 1.0 and 0.0, None where it is False everywhere."""
        if value is None:
            return None
        array = self.rows(name, read_array(name, value, "b", traced=True))
        if is_everywhere(array, False):
            return None
        return self.freeze(array.astype(self.dtype))

    def freeze(self, array: Array) -> Array:
        """Return the leaf in the record's dtype and read-only: records are replaced, not edited."""
        if array is None or is_traced(array):
            return array
        return frozen_array(array, self.dtype)

    def rows(self, name: str, array: Array) -> Array:
        """Return a scalar, (joints,) or (envs, joints) as (1 | envs, joints)."""
        # The first option with several envs sets their number for the others.
        expected = f"(), ({self.joints},) or (envs, {self.joints})"
        rows = array[None] if array.ndim == 1 else array
        fits = array.ndim == 0 or rows.shape[1:] in ((1,), (self.joints,))
        if fits and array.size:
            envs = rows.shape[0] if rows.ndim else 1
            if envs == 1 or self.num_envs in (1, envs):
                self.num_envs = max(self.num_envs, envs)
                return namespace(array).broadcast_to(rows, (envs, self.joints)).copy()
            expected = f"({self.num_envs}, {self.joints}), like another option"
        problem = f"has shape {array.shape}, not {expected}"
        remedy = "give one value, one per joint, or one per env and joint"
        raise InvalidArgumentError(name, problem, remedy=remedy)


def frozen(record: R) -> R:
    """Return a record with read-only NumPy arrays, which later writes by the caller do not
    change.
    """
    copied: R = mapped(
        lambda leaf: frozen_array(leaf) if isinstance(leaf, np.ndarray) else leaf, record
    )
    return copied


def frozen_array(array: Array, dtype: DType = None) -> Array:
    """Return a read-only copy, in ``dtype`` unless that is None."""
    copy = np.array(array, dtype=dtype)
    copy.setflags(write=False)
    return copy


def is_everywhere(array: Array, value: float | bool | str) -> bool:
    """Return whether an array is left out, or known to be ``value`` in all entries."""
    return array is None or (not is_traced(array) and bool((array == value).all()))


def summary(name: str, parts: Iterable[str]) -> str:
    """Return ``name(part, part, ...)``, on as many lines as needed."""
    return "\n".join(
        textwrap.wrap(
            f"{name}({', '.join(parts)})",
            LINE_WIDTH,
            subsequent_indent="    ",
            break_on_hyphens=False,
        )
    )


def array_summary(arrays: Any) -> str:
    """Return the type of a named tuple, and the shapes of its arrays by name."""
    leaves = {name: leaf for name, leaf in arrays._asdict().items() if leaf is not None}
    shapes = [
        f"{name} {getattr(leaf, 'shape', type(leaf).__name__)}" for name, leaf in leaves.items()
    ]
    return summary(type(arrays).__name__, shapes)
