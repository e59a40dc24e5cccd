"""Sources of joint friction and damping."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Dissipation:
    """Friction and damping of every joint and link; None leaves the URDF's figure in force.

    ``joint_friction`` is PhysX's dimensionless joint friction coefficient; ``link_damping`` the linear and
    angular velocity damping of every link [1/s].
    """

    joint_friction: float | None
    link_damping: float


DISSIPATION = {
    "urdf": Dissipation(joint_friction=None, link_damping=0.0),
    # What SAPIEN 3 gives every joint and link unasked, whatever the URDF says.
    "sapien": Dissipation(joint_friction=0.05, link_damping=0.05),
}
