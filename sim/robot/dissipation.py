"""Choices of the dissipation in the engine, and the friction of its contacts."""

from __future__ import annotations

from typing import NamedTuple

CONTACT_FRICTION = 0.3
"""Coefficient of sliding friction of every shape and of the ground: SAPIEN's default material."""


class Dissipation(NamedTuple):
    """Friction and damping in the engine.

    ``joint_friction``: PhysX's dimensionless coefficient of every joint; ``link_damping``: damping of every link [1/s];
    ``modelled``: whether :mod:`batchpid.motors.friction` computes the joints' friction and damping, in the URDF's
    units, instead of the engine.
    """

    joint_friction: float
    link_damping: float
    modelled: bool


DISSIPATION = {
    "urdf": Dissipation(joint_friction=0.0, link_damping=0.0, modelled=True),
    "sapien": Dissipation(joint_friction=0.05, link_damping=0.05, modelled=False),  # SAPIEN 3's defaults
}
"""Values of the option ``dissipation`` of :meth:`batchpid.sim.Robot.load`."""
