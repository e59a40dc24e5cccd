r"""Efforts that a motor can deliver, at a speed and a position.

With the stall effort S, the no-load speed v0 and the effort limit L, at the velocity v::

    high = min(max(S (1 - v / v0), -L), L)
    low  = min(max(S (-1 - v / v0), -L), L)

That is the line of a DC motor at full voltage, in all four quadrants, and the limit of its current.
It is DCMotor of Isaac Lab (isaaclab/actuators/actuator_pd.py), whose clip of the speed at v0 (1 + L
/ S) says the same, and ClampingDCMotor of Newton (newton/actuators) up to that speed, beyond which
Newton's effort goes on falling below -L.

A limit that depends on the position q, as of a linkage, is given at points x_k, linear between them
and constant outside, as in RemotizedPDActuator of Isaac Lab and ClampingPositionBased of Newton::

    L(q) = L_0 + sum_k (L_{k+1} - L_k) / (x_{k+1} - x_k) (min(max(q, x_k), x_{k+1}) - x_k)
"""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import NamedTuple

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import clip, namespace, tiny_of
from batchpid.motors.actuators import Actuators


class Envelope(NamedTuple):
    """Envelope in the symbols above; None is off."""

    stall: Array = None
    """S."""
    reverse: Array = None
    """-S."""
    slope: Array = None
    """S / v0."""
    limit: Array = None
    """L."""
    least: Array = None
    """-L."""
    offset: Array = None
    """Part of L(q) that is the same at every q (1 | envs, joints)."""
    least_offset: Array = None
    """That of -L(q)."""
    left: Array = None
    """x_k (segments, 1 | envs, joints)."""
    right: Array = None
    """x_{k+1}."""
    rise: Array = None
    """(L_{k+1} - L_k) / (x_{k+1} - x_k)."""


def envelope(actuators: Actuators) -> Envelope:
    """Return the envelope of the efforts that the motors of ``actuators`` deliver."""
    xp = namespace(*actuators)
    stall = actuators.saturation_effort
    points = actuators.limit_positions
    efforts = actuators.limit_efforts
    k = Envelope(limit=actuators.effort_limit)
    if k.limit is not None:
        k = k._replace(least=-k.limit)
    if stall is not None:
        finite = xp.isfinite(stall)
        slope = xp.where(finite, xp.where(finite, stall, 0.0) / actuators.no_load_speed, 0.0)
        k = k._replace(stall=stall, reverse=-stall, slope=slope)
    if points is None:
        return k
    points, efforts = (xp.moveaxis(table, 2, 0) for table in (points, efforts))
    width, finite = points[1:] - points[:-1], xp.isfinite(efforts[1:])
    rise = xp.where(finite, efforts[1:], 0.0) - xp.where(finite, efforts[:-1], 0.0)
    rise = xp.where(width > 0, rise / xp.where(width > 0, width, 1.0), 0.0)
    offset = efforts[0] - (rise * points[:-1]).sum(0)
    return k._replace(
        offset=offset, least_offset=-offset, left=points[:-1], right=points[1:], rise=rise
    )


def command_envelope(actuators: Actuators) -> Envelope:
    """Return the envelope of the commands u of motors that deliver s u + b: each end e of the
    other's is (e - b) / s.

    Where s = 0 it is wide: no command matters.
    """
    k = envelope(actuators)
    strength = actuators.strength
    bias = actuators.bias
    if strength is None and bias is None:
        return k
    divisor: Array = (
        1.0 if strength is None else namespace(strength).maximum(strength, tiny_of(strength.dtype))
    )
    shift = 0.0 if bias is None else bias
    ends = {
        name: getattr(k, name)
        for name in ("stall", "reverse", "limit", "least", "offset", "least_offset")
    }
    ends = {name: (end - shift) / divisor for name, end in ends.items() if end is not None}
    slope = None if k.slope is None else k.slope / divisor
    rise = None if k.rise is None else k.rise / (divisor if strength is None else divisor[None])
    return k._replace(**ends, slope=slope, rise=rise)


def limits(k: Envelope, qpos: Array, velocity: Array) -> tuple[Array, Array]:
    """Return the least and the largest effort, or command, at ``qpos`` and ``velocity`` (envs,
    joints), None for none.

    Both are None, or none is.
    """
    xp = namespace(qpos, velocity)
    low, high = k.least, k.limit
    if k.offset is not None:
        parts = (
            rise * clip(qpos, left, right, xp)
            for rise, left, right in zip(k.rise, k.left, k.right, strict=True)
        )
        change = reduce(add, parts)
        low, high = (
            clip(k.least_offset - change, low, None, xp),
            clip(k.offset + change, None, high, xp),
        )
    if k.stall is None:
        return low, high
    lost = k.slope * velocity
    return clip(k.reverse - lost, low, high, xp), clip(k.stall - lost, low, high, xp)
