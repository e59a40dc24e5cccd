"""Leaves of params and actuators, from the options of their constructors: checked, broadcast and
read-only.

Inside jax.jit, jax.grad and jax.vmap the entries of an array are not known. Of such a traced array
the shape is checked alone, and it stays a leaf even where it might turn out to be off.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from batchpid.arrays.array_types import Array, DType
from batchpid.arrays.choices import CHOICES
from batchpid.arrays.elementwise import namespace
from batchpid.arrays.field_tables import Field
from batchpid.checks.validate import choice, entries, integer, is_traced, names, read_array
from batchpid.errors import InvalidArgumentError

ANTI_WINDUP = ("none", "clamp", "conditional", "back_calculation")
MOST_JOINTS = 100_000
Ends = tuple[Array, Array]
"""A lower and an upper limit, each None for none."""
Leaves = TypeVar("Leaves", bound=tuple[Any, ...])


def frozen(leaves: Leaves) -> Leaves:
    """Return a named tuple with read-only NumPy arrays, which later writes by the caller do not
    change.

    Writeable arrays and views are copied. If all arrays are read-only, ``leaves`` itself is
    returned.
    """
    kept = [_read_only(np.array(leaf)) if _can_be_written(leaf) else leaf for leaf in leaves]
    return leaves if all(map(operator.is_, kept, leaves)) else type(leaves)(*kept)


class LeafBuilder:
    """Builder of the leaves of one :class:`batchpid.PIDParams` or the like, which agree in joints,
    envs and dtype.
    """

    def __init__(
        self, joints: int, joint_names: Sequence[str] | None, dtype: DType, values: Iterable[Any]
    ) -> None:
        """Without a ``dtype``, use the dtype of the traced arrays among ``values``, else
        float64.
        """
        self.joints, self.num_envs = integer("joints", joints, 1, MOST_JOINTS), 1
        self.names = None if joint_names is None else names("joint_names", joint_names, self.joints)
        if dtype is None:
            traced = [value for value in values if is_traced(value)]
            floats = [value for value in traced if value.dtype.kind == "f"]
            xp = namespace(*traced)
            dtype = xp.result_type(*floats) if floats else xp.asarray(0.0).dtype
        try:
            self.dtype: DType = np.dtype(dtype)
        except TypeError:
            self.dtype = np.dtype(object)
        if self.dtype not in (np.float32, np.float64):
            raise InvalidArgumentError(
                "dtype", "unknown dtype", value=str(dtype), remedy="use float32 or float64"
            )

    def array(self, name: str, value: Array, field: Field) -> Array:
        """Return ``value`` as (1 | envs, joints) with every entry within the bounds of ``field``;
        None stays.
        """
        if value is None:
            return None
        with np.errstate(over="ignore"):
            array = read_array(name, value, traced=True).astype(self.dtype)
        return field.checked(name, self._by_env_and_joint(name, array), self.names)

    def option(self, name: str, value: Array, field: Field) -> Array:
        """Return an option's leaf: None where it is neutral on every joint of every env."""
        array = self.array(name, value, field)
        return None if _is_everywhere(array, field.neutral) else self.freeze(array)

    def limits(self, **given: Array) -> Ends:
        """Return the leaves of a lower and an upper limit, each None where it is infinite
        everywhere.

        ``given`` are the size of both, the lower and the upper end, by the names of their
        arguments.
        """
        end = Field(neutral=math.inf, low=-math.inf)
        size, *ends = given
        read = {size: self.array(size, given[size], Field(neutral=math.inf))}
        read |= {name: self.array(name, given[name], end) for name in ends}
        lower, upper = checked_ends(read, self.names)
        lower = None if _is_everywhere(lower, -math.inf) else lower
        upper = None if _is_everywhere(upper, math.inf) else upper
        return lower, upper

    def mask(self, name: str, value: Array) -> Array:
        """Return a mask of 1.0 and 0.0, None where it is False everywhere."""
        if value is None:
            return None
        array = self._by_env_and_joint(name, read_array(name, value, "b", traced=True))
        return None if _is_everywhere(array, False) else self.freeze(array.astype(self.dtype))

    def strategies(self, value: Any) -> tuple[Any, Any, Any]:
        """Return the masks of clamp, conditional and back-calculation, each None where no joint has
        it.
        """
        remedy = f"use one of {', '.join(map(repr, ANTI_WINDUP))}"
        try:
            array = np.asarray(value, dtype=object)
        except (TypeError, ValueError, RuntimeError) as error:
            raise InvalidArgumentError(
                "anti_windup", f"cannot be read as an array: {error}", remedy=remedy
            ) from None
        array = self._by_env_and_joint("anti_windup", array)
        known = np.vectorize(
            lambda one: isinstance(one, str) and one in ANTI_WINDUP, otypes=[bool]
        )(array)
        entries("anti_windup", array, known, "unknown option", self.names, remedy=remedy)
        masks = (array == strategy for strategy in ANTI_WINDUP[1:])
        clamp, conditional, back = (mask if mask.any() else None for mask in masks)
        return clamp, conditional, back

    def clamped(self, clamp: Array, integral: Ends, effort: Ends) -> Ends:
        """Return the integral's limits: for the strategy ``clamp`` without limits, the effort
        limits.
        """
        if clamp is None or any(end is not None for end in integral):
            return integral
        if all(end is None for end in effort):
            raise InvalidArgumentError(
                "anti_windup",
                "'clamp' has no limit to clamp the integral to",
                remedy="give integral_limit or effort_limit",
            )
        low, high = (
            None if end is None else namespace(end).where(clamp, end, without)
            for end, without in zip(effort, (-math.inf, math.inf), strict=True)
        )
        return low, high

    def tracking_time(self, value: Array, back: Array, kp: Array, ki: Array, kd: Array) -> Array:
        """Return the leaf of back-calculation's time constant, inf where a joint is not
        ``back``.
        """
        if back is None:
            if value is not None:
                raise InvalidArgumentError(
                    "tracking_time",
                    "is given, but no joint has anti_windup 'back_calculation'",
                    remedy="choose that strategy or leave tracking_time out",
                )
            return None
        time = self.array("tracking_time", value, Field("s", math.inf))
        time = _rule_of_thumb(kp, ki, kd) if time is None else time
        time = namespace(time).where(back, time, math.inf)
        return None if _is_everywhere(time, math.inf) else self.freeze(time)

    def choice(self, name: str, chosen: Any) -> Any:
        """Return the params entry of a named choice."""
        return CHOICES[name][choice(name, chosen, CHOICES[name])]

    def freeze(self, array: Array) -> Array:
        """Return the leaf in the params' dtype and read-only: params are replaced, not edited."""
        if array is None or is_traced(array):
            return array
        return _read_only(np.array(array, dtype=self.dtype))

    def _by_env_and_joint(self, name: str, array: Array) -> Array:
        """Return a scalar, (joints,) or (envs, joints) as (1 | envs, joints)."""
        expected = f"(), ({self.joints},) or (envs, {self.joints})"
        rows = array[None] if array.ndim == 1 else array
        if (
            array.ndim <= 2
            and array.size
            and (array.ndim == 0 or rows.shape[1] in (1, self.joints))
        ):
            envs = rows.shape[0] if rows.ndim else 1
            if envs == 1 or self.num_envs in (1, envs):
                self.num_envs = max(self.num_envs, envs)
                return namespace(array).broadcast_to(rows, (envs, self.joints)).copy()
            expected = f"({self.num_envs}, {self.joints}), as another option has it"
        raise InvalidArgumentError(
            name,
            f"has shape {array.shape}, not {expected}",
            remedy="give one value, one per joint, or one per env and joint",
        )


def checked_ends(given: Mapping[str, Array], joint_names: Sequence[str] | None) -> Ends:
    """Return the lower and the upper end of limits, None for no limit.

    ``given`` are the size of both, the lower and the upper end, by the names of their arguments.

    Raises InvalidArgumentError if the size is given with an end, or the lower end exceeds the upper
    one.
    """
    (name, size), (low_name, low), (high_name, high) = given.items()
    if size is not None:
        if low is not None or high is not None:
            problem = f"is given together with {low_name} or {high_name}"
            raise InvalidArgumentError(
                name, problem, remedy="give the symmetric limit, or the two ends"
            )
        return -size, size
    if low is not None and high is not None and not (is_traced(low) or is_traced(high)):
        ends = np.broadcast_arrays(low, high)
        entries(low_name, ends[0], ends[0] <= ends[1], f"exceeds {high_name}", joint_names)
    return low, high


def _can_be_written(leaf: Array) -> bool:
    return isinstance(leaf, np.ndarray) and (leaf.flags.writeable or not leaf.flags.owndata)


def _read_only(array: Array) -> Array:
    array.setflags(write=False)
    return array


def _is_everywhere(array: Array, value: float) -> bool:
    """Return whether an array is left out, or known to be ``value`` in all entries."""
    return array is None or (not is_traced(array) and bool((array == value).all()))


def _rule_of_thumb(kp: Array, ki: Array, kd: Array) -> Array:
    """Return Tt = sqrt(Ti Td) = sqrt(kd/ki), or Ti = kp/ki without kd; inf, no correction, where ki
    is 0.
    """
    xp = namespace(kp, ki, kd)
    if ki is None:
        return xp.full_like(kp, math.inf)
    kp, ki, kd = xp.broadcast_arrays(kp, ki, xp.zeros_like(kp) if kd is None else kd)
    safe = xp.where(ki > 0, ki, 1.0)
    # The inner where keeps the gradient of the square root finite where kd is 0.
    times = xp.where(kd > 0, xp.sqrt(xp.where(kd > 0, kd, 1.0) / safe), kp / safe)
    return xp.where(ki > 0, times, math.inf)
