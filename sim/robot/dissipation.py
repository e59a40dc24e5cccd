"""Sources of joint friction and damping."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Dissipation:
    """Friction of every joint and damping of every link.

    ``joint_friction`` is PhysX's dimensionless joint friction coefficient, None for the URDF's value;
    ``link_damping`` the linear and angular velocity damping of every link [1/s].
    """

    joint_friction: float | None
    link_damping: float


DISSIPATION = {
    "urdf": Dissipation(joint_friction=None, link_damping=0.0),
    "sapien": Dissipation(joint_friction=0.05, link_damping=0.05),  # SAPIEN 3's defaults, which ignore the URDF
}
"""Values of the option ``dissipation`` of :meth:`sim.Robot.load`."""
