r"""Efforts that a motor can deliver, at a speed.

With the stall effort S, the no-load speed v0 and the effort limit L, at the velocity v::

    high = min(max(S (1 - v / v0), -L), L)
    low  = min(max(S (-1 - v / v0), -L), L)

That is the line of a DC motor at full voltage, in all four quadrants, and the limit of its current.
It is DCMotor of Isaac Lab (isaaclab/actuators/actuator_pd.py), whose clip of the speed at v0 (1 + L
/ S) says the same, and ClampingDCMotor of Newton (newton/actuators) up to that speed, beyond which
Newton's effort goes on falling below -L.
"""

from __future__ import annotations

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


def envelope(actuators: Actuators) -> Envelope:
    """Return the envelope of the efforts that the motors of ``actuators`` deliver."""
    xp = namespace(*actuators)
    stall = actuators.saturation_effort
    limit = actuators.effort_limit
    k = Envelope(limit=limit, least=None if limit is None else -limit)
    if stall is None:
        return k
    # A motor without a stall effort has no line, so its slope is 0.
    finite = xp.isfinite(stall)
    slope = xp.where(finite, xp.where(finite, stall, 0.0) / actuators.no_load_speed, 0.0)
    return k._replace(stall=stall, reverse=-stall, slope=slope)


def command_envelope(actuators: Actuators) -> Envelope:
    """Return the envelope of the commands u of motors that deliver s u + b: each bound e of the
    efforts becomes (e - b) / s.

    Where s = 0 it is wide: no command matters.
    """
    k = envelope(actuators)
    strength = actuators.strength
    if strength is None and actuators.bias is None:
        return k
    divisor: Array = 1.0
    if strength is not None:
        divisor = namespace(strength).maximum(strength, tiny_of(strength.dtype))
    shift = 0.0 if actuators.bias is None else actuators.bias

    def command(end: Array) -> Array:
        if end is None:
            return None
        return (end - shift) / divisor

    slope = None if k.slope is None else k.slope / divisor
    return Envelope(
        stall=command(k.stall),
        reverse=command(k.reverse),
        slope=slope,
        limit=command(k.limit),
        least=command(k.least),
    )


def limits(k: Envelope, velocity: Array) -> tuple[Array, Array]:
    """Return the least and the largest effort, or command, at ``velocity`` (envs, joints), None for
    none.

    Both are None, or none is.
    """
    if k.stall is None:
        return k.least, k.limit
    xp = namespace(velocity)
    lost = k.slope * velocity
    return clip(k.reverse - lost, k.least, k.limit, xp), clip(k.stall - lost, k.least, k.limit, xp)
