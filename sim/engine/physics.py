"""Solver presets."""

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
