"""Start of a fit: regressions at the delay, the payload and the stopping time under which the robot moves as logged.

Filtered efforts hardly show a short delay, but the simulated motion does. The motion is simulated for a grid of delays,
and then for the candidates of a search over the unknowns that all joints share, by CMA-ES (N. Hansen, "The CMA
evolution strategy: a tutorial", arXiv:1604.00772). Each candidate has the motors that the regression gives for it.
"""

from __future__ import annotations

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.regression import DELAYS, STRONG, WEAK, Regression
from batchpid.sim.identification.unknowns import KINDS, Motors

GRID = DELAYS[::4]
"""Delays that are tried first [s]."""
GENERATIONS, POPULATION = 4, 8
SPREAD = np.array([5e-4, 0.3, 0.05])
"""Standard deviations of the first candidates: delay [s], logarithm of the stopping time, payload [kg]."""


def begin(problem: Problem, regression: Regression, ideal: Motors, seed: int) -> Float64:
    """Return the point (unknowns,) at which a fit begins: the candidate with the highest likelihood."""
    from cmaes import CMA

    unknowns = problem.unknowns

    def costs(candidates: list[Motors]) -> Float64:
        points = np.array([unknowns.clip(unknowns.point(motors)) for motors in candidates])
        return problem.costs(problem.sizes(problem.residuals(points)))

    # Each joint has its prior: the strong one where the log hardly shows the strength.
    kg, priors = regression.best.motors["payload"][0, 0], np.array([WEAK, STRONG])
    grid = costs([regression.at(delay, kg, prior).motors for prior in priors for delay in GRID])
    both = grid.reshape(len(priors), len(GRID), -1)
    late = both.min(0).sum(1).argmin()
    prior = priors[both[:, late].argmin(0)]

    yields = KINDS["stopping"]

    def candidate(x: Float64) -> Motors:
        delay, stopping, kg = x * SPREAD
        stopping = np.clip(np.exp(stopping), yields.low, yields.high)
        return regression.at(delay, kg, prior).motors | {"stopping": np.array([[stopping]])}

    first = regression.at(GRID[late], kg, prior).motors
    mean = np.array([GRID[late], np.log(yields.start), kg]) / SPREAD
    bounds = np.array([[0.0, DELAYS[-1]], np.log([yields.low, yields.high]), [0.0, np.inf]]) / SPREAD[:, None]
    bounds = bounds if ("payload", None) in unknowns.names else bounds[:2]
    optimizer = CMA(mean[: len(bounds)], 1.0, bounds=bounds, seed=seed, population_size=POPULATION)
    tried = [first, ideal]
    lowest = [*costs(tried).sum(1)]
    for _ in range(GENERATIONS):
        asked = [optimizer.ask() for _ in range(POPULATION)]
        candidates = [candidate(np.append(x, mean[len(x) :])) for x in asked]
        found = costs(candidates).sum(1)
        optimizer.tell(list(zip(asked, found, strict=True)))
        tried, lowest = [*tried, *candidates], [*lowest, *found]
    return unknowns.clip(unknowns.point(tried[int(np.argmin(lowest))]))
