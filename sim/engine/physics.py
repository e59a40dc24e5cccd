"""Settings of the engines' solvers, and their presets."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Physics:
    """Solver of a PhysX scene, "TGS" or "PGS" (temporal or projected Gauss-Seidel), and its
    iterations per sim step.
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
class MujocoSolver:
    """Settings of MuJoCo's constraint solver, which acts on contacts and joint limits, and on
    constraints of a file.

    The integrator is always semi-implicit Euler, as PhysX's is. See "Computation" in MuJoCo's
    documentation.
    """

    iterations: int = 100
    """Largest number of iterations of Newton's method per sim step."""
    tolerance: float = 1e-8
    """Relative improvement of the cost at which it ends."""
    elliptic: bool = True
    """Whether friction cones are elliptic, not pyramids, which are faster and slip a little."""
    limit_time: float = 0.0
    """Time constant of joint limits [s]; at least two sim steps, which are the hardest limits that
    MuJoCo simulates. An MJCF file gives its own time constants, for contacts too.
    """
    contact_time: float = 0.005
    """Time constant of contacts [s], at least two sim steps."""


SOLVERS = {
    "accurate": MujocoSolver(),
    "fast": MujocoSolver(
        iterations=20,
        tolerance=1e-6,
        elliptic=False,
    ),
}
"""Presets, by the names of the option ``physics``."""
