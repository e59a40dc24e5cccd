"""What PhysX is asked to do: solver presets, and where friction and damping come from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Physics:
    """Solver settings of a PhysX scene.

    ``solver`` is ``"TGS"`` (temporal Gauss-Seidel) or ``"PGS"`` (projected Gauss-Seidel);
    ``position_iterations`` and ``velocity_iterations`` are counted per sim step.
    """

    solver: str
    position_iterations: int
    velocity_iterations: int = 1


PHYSICS = {
    # SAPIEN's own settings.
    "accurate": Physics("TGS", 10),
    # At 2 kHz PGS keeps its error with 4 iterations, which TGS does not; see docs/performance.md.
    "fast": Physics("PGS", 4),
}


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
