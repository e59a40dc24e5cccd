"""Strategies of anti-windup, as options of :func:`batchpid.make_params` and as leaves of params."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from batchpid.arrays.array_types import Array, Bool, Rows
from batchpid.arrays.choices import Everywhere, NamedChoice
from batchpid.arrays.elementwise import namespace
from batchpid.arrays.field_tables import Field
from batchpid.arrays.records import Ends, LeafBuilder, is_everywhere
from batchpid.checks.validate import entries
from batchpid.errors import InvalidArgumentError

ANTI_WINDUP = ("none", "clamp", "conditional", "back_calculation")


def masks(build: LeafBuilder, names: str | Sequence[object]) -> list[Bool | None]:
    """Return the masks of clamp, conditional and back-calculation, each None where no joint has
    it.

    Raises InvalidArgumentError for names that are not among ANTI_WINDUP, or of a wrong shape.
    """
    remedy = f"use one of {', '.join(map(repr, ANTI_WINDUP))}"
    try:
        array = np.asarray(names, dtype=object)
    except (TypeError, ValueError, RuntimeError) as error:
        problem = f"cannot be read as an array: {error}"
        raise InvalidArgumentError("anti_windup", problem, remedy=remedy) from None
    array = build.rows("anti_windup", array)
    good = np.array([isinstance(name, str) and name in ANTI_WINDUP for name in array.flat], bool)
    good = good.reshape(array.shape)
    entries("anti_windup", array, good, "unknown option", build.names, remedy=remedy)
    # "none" needs no mask: it is where the others are not.
    joints = [array == strategy for strategy in ANTI_WINDUP[1:]]
    return [mask if mask.any() else None for mask in joints]


def named(joints: int, tracking_time: Array, conditional: Array | NamedChoice | None) -> Rows:
    """Return the strategies (1 | envs, joints) by name, from the leaves of params."""
    # A joint has one strategy, so later marks cannot meet earlier ones.
    names: Rows = np.full((1, joints), "none", dtype=object)
    if tracking_time is not None:
        names = np.where(np.isfinite(tracking_time), "back_calculation", names)
    if conditional is not None:
        chosen = isinstance(conditional, Everywhere) or np.asarray(conditional) > 0
        names = np.where(chosen, "conditional", names)
    return names


def clamped(clamp: Bool, effort: Ends) -> Ends:
    """Return the limits of an integral without limits of its own: the effort limits on the joints
    of the mask ``clamp``.
    """
    if all(end is None for end in effort):
        problem = "'clamp' has no limit to clamp the integral to"
        remedy = "give integral_limit or effort_limit"
        raise InvalidArgumentError("anti_windup", problem, remedy=remedy)
    low, high = effort
    if low is not None:
        low = namespace(low).where(clamp, low, -math.inf)
    if high is not None:
        high = namespace(high).where(clamp, high, math.inf)
    return low, high


def tracking_time(
    build: LeafBuilder,
    value: Array,
    back: Bool | None,
    kp: Array,
    ki: Array,
    kd: Array,
) -> Array:
    """Return the leaf of back-calculation's time constant, inf where a joint is not ``back``."""
    if back is None:
        if value is not None:
            problem = "is given, but no joint has anti_windup 'back_calculation'"
            remedy = "choose that strategy or leave tracking_time out"
            raise InvalidArgumentError("tracking_time", problem, remedy=remedy)
        return None
    time = build.array("tracking_time", value, Field("s", math.inf))
    time = _rule_of_thumb(kp, ki, kd) if time is None else time
    time = namespace(time).where(back, time, math.inf)
    if is_everywhere(time, math.inf):
        return None
    return build.freeze(time)


def _rule_of_thumb(kp: Array, ki: Array, kd: Array) -> Array:
    """Return Tt = sqrt(Ti Td) = sqrt(kd/ki), or Ti = kp/ki without kd; inf, no correction, where ki
    is 0.
    """
    xp = namespace(kp, ki, kd)
    if ki is None:
        return xp.full_like(kp, math.inf)
    kp, ki, kd = xp.broadcast_arrays(kp, ki, xp.zeros_like(kp) if kd is None else kd)
    # Where ki is 0 the quotient is not used, but must be finite.
    safe = xp.where(ki > 0, ki, 1.0)
    # The inner where keeps the gradient of the square root finite where kd is 0.
    times = xp.where(
        kd > 0,
        xp.sqrt(xp.where(kd > 0, kd, 1.0) / safe),
        kp / safe,
    )
    return xp.where(ki > 0, times, math.inf)
