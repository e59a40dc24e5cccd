r"""Efforts that a motor can deliver, at a speed and a position.

With the stall effort S, the no-load speed v0 and the effort limit L, at the velocity v::

    high = min(max(S (1 - v / v0), -L), L)
    low  = min(max(S (-1 - v / v0), -L), L)

That is the line of a DC motor at full voltage, in all four quadrants, and the limit of its current. It is DCMotor of
Isaac Lab (isaaclab/actuators/actuator_pd.py), whose clip of the speed at v0 (1 + L / S) says the same, and
ClampingDCMotor of Newton (newton/actuators) up to that speed, beyond which Newton's effort goes on falling below -L.

A limit that depends on the position q, as of a linkage, is given at points x_k, linear between them and constant
outside, as in RemotizedPDActuator of Isaac Lab and ClampingPositionBased of Newton::

    L(q) = L_0 + sum_k (L_{k+1} - L_k) / (x_{k+1} - x_k) (min(max(q, x_k), x_{k+1}) - x_k)
"""

from __future__ import annotations

from typing import Any, NamedTuple

from batchpid.actuators.model import Actuators
from batchpid.elementwise import clip, namespace


class Envelope(NamedTuple):
    """Envelope in the symbols above; None is off."""

    stall: Any = None
    """S."""
    reverse: Any = None
    """-S."""
    slope: Any = None
    """S / v0."""
    limit: Any = None
    """L."""
    offset: Any = None
    """Part of L(q) that is the same at every q (1 | envs, joints)."""
    left: Any = None
    """x_k (segments, 1 | envs, joints)."""
    right: Any = None
    """x_{k+1}."""
    rise: Any = None
    """(L_{k+1} - L_k) / (x_{k+1} - x_k)."""


def envelope(actuators: Actuators) -> Envelope:
    """Return the envelope of ``actuators``."""
    xp = namespace(*actuators)
    stall, points, efforts = actuators.saturation_effort, actuators.limit_positions, actuators.limit_efforts
    slope = None
    if stall is not None:
        finite = xp.isfinite(stall)
        slope = xp.where(finite, xp.where(finite, stall, 0.0) / actuators.no_load_speed, 0.0)
    if points is None:
        return Envelope(stall, None if stall is None else -stall, slope, actuators.effort_limit)
    points, efforts = (xp.moveaxis(table, 2, 0) for table in (points, efforts))
    width, finite = points[1:] - points[:-1], xp.isfinite(efforts[1:])
    rise = xp.where(finite, efforts[1:], 0.0) - xp.where(finite, efforts[:-1], 0.0)
    rise = xp.where(width > 0, rise / xp.where(width > 0, width, 1.0), 0.0)
    reverse = None if stall is None else -stall
    offset = efforts[0] - (rise * points[:-1]).sum(0)
    return Envelope(stall, reverse, slope, actuators.effort_limit, offset, points[:-1], points[1:], rise)


def limits(k: Envelope, qpos: Any, velocity: Any) -> tuple[Any, Any]:
    """Return the least and the largest effort at ``qpos`` and ``velocity`` (envs, joints), None for none."""
    xp = namespace(qpos, velocity)
    limit = k.limit
    if k.offset is not None:
        limit = k.offset + (k.rise * xp.minimum(xp.maximum(qpos[None], k.left), k.right)).sum(0)
        limit = limit if k.limit is None else xp.minimum(limit, k.limit)
    least = None if limit is None else -limit
    if k.stall is None:
        return least, limit
    lost = k.slope * velocity
    return clip(k.reverse - lost, least, limit, xp), clip(k.stall - lost, least, limit, xp)
