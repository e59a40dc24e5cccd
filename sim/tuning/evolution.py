"""Search for gains by simulation: CMA-ES from known gains, in log space, and a final round.

The same search finds gains of joints (:func:`batchpid.sim.tuning.search.tune`) and gains of a tool
(:func:`batchpid.sim.tuning.tool_search.tune_tool`). Each env runs one move of one candidate, so a generation is one
rollout. The moves are free of contact, so the robots have no collision shapes in the search. A share of the effort
limits is a reserve for harder moves. :mod:`batchpid.sim.tuning.cost` defines the cost. The search itself is the package
``cmaes`` (N. Hansen, "The CMA evolution strategy: a tutorial", arXiv:1604.00772).

Gains that are best on the few moves of the search need not be best on others. So the candidates that beat the gains at
the start run a final round with these on more moves, with collisions, with the caller's solver, at the full effort
limits. The gains with the lowest cost there are the result.

The result of a search depends on its seed and not on the number of workers. To resume, a new search with the same seed
takes the costs of known generations from the history, and continues as if it had never stopped.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from batchpid.arrays.array_types import Document, Float64
from batchpid.arrays.digest import digest
from batchpid.checks.validate import integer, number
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner import Runner
from batchpid.sim.tuning.cost import HEADROOM, Trial, Weights
from batchpid.sim.tuning.history import HistoryFile, plain_options
from batchpid.sim.workers.contact_log import MissedContactWarning

INITIAL_SPREAD = 0.12
"""First standard deviation of the search, in log space."""
FINALISTS = 3
"""Largest number of candidates in the final round, besides the gains at the start."""
FINAL_SEED = 1_000_003
"""Difference between the seed of the final round and the seed of the search."""
SEARCH_PHYSICS = {"collisions": False, "physics": "free"}
"""Options of the runner in a search on moves that are free of contact."""


class GainCandidates(Protocol):
    """Candidates of a search: points in log space. Each candidate runs the same moves, one per env."""

    start: str
    """Name of the gains at the point 0, where the search starts."""
    dimension: int

    @property
    def envs(self) -> int:
        """Number of envs of a candidate."""

    def options(self, count: int) -> Document:
        """Return the options of a runner for ``count`` candidates."""

    def trial(self, runner: Runner, points: Float64) -> Trial:
        """Run each of ``points`` (n, dimension) on ``runner``."""


Round = tuple[GainCandidates, Document]
"""Candidates on their moves, and the options of the runner that runs them."""


class Found(NamedTuple):
    """Result of a search: the best candidate, or the gains at the start if they were better."""

    point: Float64
    """Point in log space (dimension,)."""
    cost: float
    """Cost in the search."""
    ranked: Float64
    """Points of all candidates (n, dimension), those of the lowest cost in the search first."""
    costs: tuple[tuple[float, ...], ...]
    """Costs of the candidates, by generation."""
    rejected: str | None
    final: Trial | None
    """Final round: the gains at the start, then the candidates."""
    place: int
    """Index of the best candidate in the final round."""


@dataclass
class Search:
    """Search of ``generations`` of ``population`` candidates; the fields are arguments as for
    :func:`batchpid.sim.tuning.search.tune`.

    Raises InvalidArgumentError if one is out of range, and MissingDependencyError without the package ``cmaes``.
    """

    robot: Robot
    runner_options: Document
    seed: int
    generations: int
    population: int
    seconds: float
    weights: Weights
    time_limit: float | None
    history: Path | str | None
    progress: Callable[[Any], Any] | None

    def __post_init__(self) -> None:
        try:
            import cmaes  # noqa: F401
        except ImportError:
            raise MissingDependencyError("cmaes", "tuning", "tune") from None
        self.seed = integer("seed", self.seed, 0, 2**31 - 1)
        self.generations = integer("generations", self.generations, 1, 100_000)
        self.population = integer("population", self.population, 4, 1000)
        self.seconds = number("seconds", self.seconds, 0.05, 600.0, "seconds")

    def refuse(self, names: Sequence[str], remedy: str) -> None:
        """Raise InvalidArgumentError if the caller gave an option among ``names``, which the search chooses itself."""
        for name in names:
            if name in self.runner_options:
                raise InvalidArgumentError(name, "is chosen by the search, which is for explicit gains", remedy=remedy)

    def settings(self, moves: Any, /, **own: Any) -> Document:
        """Return all inputs on which the costs of this search depend, with the inputs ``own`` of its kind."""
        actuators = self.robot.actuators
        return {
            **self.robot.describe(),
            "seed": self.seed,
            "population": self.population,
            "robot_actuators": None if actuators is None else digest(actuators),
            "moves_digest": digest(moves),
            "seconds": self.seconds,
            "weights": asdict(self.weights),
            "headroom": HEADROOM,
            **own,
            **plain_options(self.runner_options, self.history is not None),
        }

    def run(self, settings: Document, first: Round, final: Round | None, designs: Float64 | None = None) -> Found:
        """Run the generations, then the ``final`` round of the candidates that beat the gains at the start.

        With ``designs`` (n, dimension) these are candidates of the first generation too, and CMA-ES starts again from
        the best of it.
        """
        record = HistoryFile(self.history, "search", settings)
        candidates, options = first
        options = options | candidates.options(self.population)
        with Runner(self.robot, self.population * candidates.envs, **options) as runner:
            points, costs = self._evolve(candidates, runner, record, designs)
        every, start = np.concatenate([np.ravel(row) for row in costs]), candidates.start
        ranked = np.argsort(every, kind="stable")
        ranking = [int(index) for index in ranked[:FINALISTS]]
        better = ranking[: ranking.index(0)] if 0 in ranking else ranking
        finalists, place, trial, rejected = [0, *better], min(1, len(better)), None, None
        if not better:
            rejected = f"cost in the search: best candidate {every[1:].min():.4f}, {start} {every[0]:.4f}"
        if final is not None:
            judge, options = final
            options = options | judge.options(len(finalists))
            with Runner(self.robot, len(finalists) * judge.envs, **options) as runner:
                trial = judge.trial(runner, points[finalists])
            place = int(np.argmin(trial.costs))
            if better and not place:
                rejected = f"cost in the final: best candidate {min(trial.costs[1:]):.4f}, {start} {trial.costs[0]:.4f}"
        best = finalists[place]
        return Found(points[best], float(every[best]), points[ranked], costs, rejected, trial, place)

    def _evolve(
        self, candidates: GainCandidates, runner: Runner, record: HistoryFile, designs: Float64 | None
    ) -> tuple[Float64, tuple[tuple[float, ...], ...]]:
        """Return all points (n, dimension) and the costs of each generation; ``record`` keeps the costs."""
        from cmaes import CMA

        def optimizer_at(mean: Float64) -> CMA:
            return CMA(mean=mean, sigma=INITIAL_SPREAD, seed=self.seed, population_size=self.population)

        known, start = record.state(self._known_costs) or [], np.zeros(candidates.dimension)
        firsts = [start] if designs is None else [start, *designs][: self.population]
        optimizer, points, costs = optimizer_at(start), list[Float64](), list[tuple[float, ...]]()
        began = time.monotonic()
        bar = (self.progress or (lambda items: items))(range(self.generations))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissedContactWarning)  # bad gains may leave the way of a move
            for generation in bar:
                points += [optimizer.ask() for _ in range(self.population)]
                if generation == 0:
                    points[: len(firsts)] = firsts
                asked = points[-self.population :]
                if generation == len(known):
                    known.append(candidates.trial(runner, np.array(asked)).costs)
                    record.write(known)
                if generation == 0 and designs is not None:
                    optimizer = optimizer_at(points[int(np.argmin(known[0]))])
                else:
                    optimizer.tell(list(zip(asked, known[generation], strict=True)))
                costs = known[: generation + 1]
                if hasattr(bar, "set_postfix"):
                    bar.set_postfix(cost=f"{np.min(costs):.4f}", start=f"{costs[0][0]:.4f}")
                if self.time_limit is not None and time.monotonic() - began > self.time_limit:
                    break
        return np.array(points), tuple(costs)

    def _known_costs(self, rows: Any) -> list[tuple[float, ...]]:
        """Return the costs of the generations in a history."""
        costs = [tuple(float(cost) for cost in row) for row in rows]
        if any(len(row) != self.population or np.isnan(row).any() for row in costs):
            raise ValueError(f"its generations do not have {self.population} costs each")
        return costs
