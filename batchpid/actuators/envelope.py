r"""Torque-speed envelope of a motor: the efforts that it can deliver at a speed.

With the stall effort S, the no-load speed v0 and the effort limit L, at the velocity v::

    high = min(max(S (1 - v / v0), -L), L)
    low  = min(max(S (-1 - v / v0), -L), L)

The line of a DC motor at full voltage, in all four quadrants, and the limit of its current. It is DCMotor of Isaac Lab
(isaaclab/actuators/actuator_pd.py), whose clip of the speed at v0 (1 + L / S) says the same, and ClampingDCMotor of
Newton (newton/actuators) up to that speed, beyond which Newton's effort goes on falling below -L.
"""

from __future__ import annotations

from typing import Any

from batchpid.elementwise import clip


def narrow(effort: Any, stall: Any, slope: Any, limit: Any, velocity: Any, xp: Any) -> Any:
    """Return ``effort`` within the envelope at ``velocity``; ``slope`` is S / v0, and what is None is not there."""
    if stall is not None:
        lost = slope * velocity
        effort = xp.minimum(xp.maximum(effort, -stall - lost), stall - lost)
    return effort if limit is None else clip(effort, -limit, limit, xp)
