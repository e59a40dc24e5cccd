"""Solver presets."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Physics:
    """Solver of a PhysX scene, "TGS" or "PGS" (temporal or projected Gauss-Seidel), and its iterations per sim step."""

    solver: str
    position_iterations: int
    velocity_iterations: int = 1


PHYSICS = {
    # SAPIEN's own settings.
    "accurate": Physics("TGS", 10),
    # At 2 kHz PGS keeps its error with 4 iterations, which TGS does not; see docs/performance.md.
    "fast": Physics("PGS", 4),
    # Without contact there are joint limits alone to iterate on.
    "free": Physics("PGS", 1),
}
