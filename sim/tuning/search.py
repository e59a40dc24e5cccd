"""Search for gains of joints by CMA-ES from the designed gains, in log space, and a final round.

Each env runs one move of one candidate, as a step or as a smooth motion of the setpoint, so a
generation is one rollout. The moves are free of contact, so the robots have no collision shapes in
the search. A share of the effort limits is a reserve for harder moves. The search itself is the
package ``cmaes`` (N. Hansen, "The CMA evolution strategy: a tutorial", arXiv:1604.00772).

Gains that are best on the few moves of the search need not be best on others. So the candidates
that beat the designed gains run a final round with these on more moves, with collisions, with the
caller's solver, at the full effort limits. The gains with the lowest cost there are the result.

Good gains for robots that differ from the model, by actuators or a randomization, are farther from
the designed ones. For such robots the first generation consists of other designs
(:mod:`batchpid.sim.tuning.candidates`), and CMA-ES starts from the best of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64, Progress
from batchpid.checks import integer, number
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.io.files import package_versions
from batchpid.sim.options.groups import DEFAULT_ENGINE, EngineName
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_options import describe
from batchpid.sim.tuning.candidates import FACTORS, GainCandidates
from batchpid.sim.tuning.evaluation import EVALUATION_SUBSTEPS, Comparison, compare, reseeded
from batchpid.sim.tuning.gain_sets import GainSet, gain_table
from batchpid.sim.tuning.moves import Moves, random_moves, seeded_moves

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INITIAL_SPREAD = 0.12
"""First standard deviation of the search, in log space."""
HEADROOM = 0.9
"""Share of the effort limits that candidates may use."""
POPULATION = 8
"""Candidates of a population, evaluated at once."""
SEARCH_MOVES = 12
"""Number of random moves of the search, besides the tutorial's."""
FINAL_MOVES = 24
"""Number of moves of the final round."""
FINALISTS = 3
"""Largest number of candidates in the final round, besides the designed gains."""
FINAL_SEED = 1_000_003
"""Difference between the seed of the final round and the seed of the search."""
SEARCH_SCENE: Document = {"collisions": False, "physics": "fast", "ground": None}
"""Options of the runner in a search on moves that are free of contact."""


@dataclass(frozen=True, eq=False)
class Tuning:
    """Result of a search."""

    robot: Robot
    params: bp.PIDParams
    """Best gains; the designed ones where they beat all candidates."""
    cost: float
    """Cost in the search."""
    start_params: bp.PIDParams
    """Designed gains that the search began with."""
    start_cost: float
    history: tuple[tuple[float, ...], ...]
    """Costs of every candidate of every generation."""
    settings: Document
    """Seed, moves, options and versions, for the record."""
    rejected: str | None
    """Why the designed gains are the result; None if a candidate was best."""
    scene: Document
    """Options of the comparison with the designed gains, and its progress."""

    @cached_property
    def comparison(self) -> Comparison:
        """Comparison of the designed and the tuned gains, on moves that the search did not see."""
        name = "tuned" if self.rejected is None else "result"
        sets = [GainSet("designed", self.start_params), GainSet(name, self.params)]
        return compare(self.robot, sets, seed=self.settings["seed"], **self.scene)

    def report(self) -> str:
        """Return the costs, and the table of the :attr:`comparison`."""
        lines = [
            f"cost of the designed gains {self.start_cost:.4f}, of the tuned gains {self.cost:.4f}\n"
        ]
        if self.rejected is not None:
            lines.append(f"The designed gains are the result: {self.rejected}.")
        lines += [self.comparison.report(), "", gain_table(self.robot, self.params)]
        return "\n".join(lines)

    def save(self, path: str | Path) -> None:
        """Write the params and the settings of the search."""
        about: Document = {"cost": self.cost, "start_cost": self.start_cost, "gains": "tuned"}
        if self.rejected is not None:
            about |= {"gains": "designed", "rejected": self.rejected}
        bp.save_params(path, self.params, self.robot.joint_names, self.settings | about)

    def figure(self) -> Figure:
        """Draw the tuned gains beside the designed ones on the first move."""
        return self.comparison.figure()


def tune(
    robot: Robot,
    *,
    generations: int = 10,
    seed: int = 0,
    seconds: float = 1.5,
    gain_units: Literal["mass_matrix", "effort"] = "mass_matrix",
    randomization: Randomization | None = None,
    engine: EngineName = DEFAULT_ENGINE,
    workers: int | None = None,
    progress: Progress[Any] | None = None,
    **runner_options: Any,
) -> Tuning:
    """Tune the gains of any robot: design them from its inertia, then search by CMA-ES on simulated
    moves.

    The report is a table of the gains before and after, on moves that the search did not see. The
    result depends on the seed and not on the number of workers.

    Parameters
    ----------
    generations
        Number of populations, of POPULATION candidates each, that the search evaluates.
    seed
        Seed of the search, of its moves and of the draws.
    seconds
        Simulated time of each move of the search [s].
    gain_units
        Gains per mass matrix (all joints respond equally fast), or as efforts (for any controller).
    randomization
        Draw the robot of each move, the same for all candidates: a YAML file
        (docs/randomization.md), e.g. `payload: {uniform: [0, 0.5]}`.
    engine
        Physics engine.
    workers
        Processes that step the scenes; 0: this one. Default: one per available core.
    progress
        Wraps the range of generations, and the sets of the comparison, e.g. ``tqdm.tqdm``.
    runner_options
        More options of :class:`batchpid.sim.Runner`, e.g. ``physics="fast"``, for the final round.
        In the search, robots with a fixed base and without a ``build`` have no collision shapes and
        "fast" physics.

    Raises
    ------
    InvalidArgumentError
        An option is out of range or chosen by the search, such as ``params``.
    MissingDependencyError
        The package ``cmaes`` is missing.
    """
    if find_spec("cmaes") is None:
        raise MissingDependencyError("cmaes", "tuning", "tune")
    seed = integer("seed", seed, 0, 2**31 - 1)
    generations = integer("generations", generations, 1, 100_000)
    seconds = number("seconds", seconds, 0.05, 600.0, "seconds")
    for name in {"params", "discretization"} & runner_options.keys():
        problem = "is chosen by the search, which is for explicit gains"
        remedy = "bp.design_gains makes implicit gains"
        raise InvalidArgumentError(name, problem, remedy=remedy)
    # Options of all rollouts; the search adds fast ones where moves are free of contact.
    scene: Document = {"engine": engine, "workers": workers, **runner_options}
    options: Document = {"substeps": EVALUATION_SUBSTEPS, **scene}

    differs = randomization is not None or robot.actuators is not None
    moves = seeded_moves(robot, SEARCH_MOVES, seed)
    unseen = random_moves(robot, FINAL_MOVES, seed + FINAL_SEED)
    fast = Document()
    if robot.fixed_base and runner_options.get("build") is None:
        fast = SEARCH_SCENE

    def candidates(moves: Moves, headroom: float) -> GainCandidates:
        return GainCandidates(
            robot,
            gain_units,
            moves,
            seconds,
            headroom=headroom,
            drawn=differs,
        )

    # The designed gains are the first candidate, so that every cost has a reference.
    searched = candidates(moves, 1.0 if differs else HEADROOM)
    first = np.zeros((1, len(FACTORS)))
    start = searched.params(first)
    if differs:
        first = np.vstack([first, searched.designs()])[:POPULATION]
    options["params"] = start
    options["randomization"] = reseeded(randomization, seed)
    with searched.runner(POPULATION, options | fast) as runner:
        evaluate = partial(searched.costs, runner)
        points, history = _evolve(
            evaluate,
            first,
            generations,
            seed,
            progress,
        )

    # Final round, on other moves: the designed gains against the candidates that beat them.
    costs = np.concatenate(history)
    ranking = np.argsort(costs, kind="stable")[:FINALISTS]
    finalists = np.append(ranking[costs[ranking] < costs[0]], 0)
    stage = "search"
    final_costs = costs[finalists]
    if len(finalists) > 1:
        stage = "final round"
        final = candidates(unseen, 1.0)
        options["randomization"] = reseeded(randomization, seed + FINAL_SEED)
        with final.runner(len(finalists), options) as runner:
            final_costs = final.costs(runner, points[finalists])
    best = int(finalists[np.argmin(final_costs)])

    settings: Document = {
        **describe(robot),
        "seed": seed,
        "generations": len(history),
        "population": POPULATION,
        "seconds": seconds,
        "gain_units": gain_units,
        "moves": list(moves.names),
        "randomization": _plain(randomization),
        "engine": engine,
        **{name: _plain(value) for name, value in runner_options.items()},
        "versions": package_versions(("batchpid", engine, "numpy", "cmaes")),
    }
    return Tuning(
        robot=robot,
        params=searched.params(points[[best]]),
        cost=float(costs[best]),
        start_params=start,
        start_cost=history[0][0],
        history=history,
        settings=settings,
        rejected=f"no candidate beats the designed gains in the {stage}" if best == 0 else None,
        scene=scene | {"engine": (engine,), "randomization": randomization, "progress": progress},
    )


def _evolve(
    evaluate: Callable[[Float64], Float64],
    first: Float64,
    generations: int,
    seed: int,
    progress: Progress[int] | None,
) -> tuple[Float64, tuple[tuple[float, ...], ...]]:
    """Return all points (n, factors) and their costs by generation.

    The search begins at ``first[0]``. Other points ``first`` (n, factors) are candidates of the
    first generation too.
    """
    from cmaes import CMA

    make = partial(
        CMA,
        sigma=INITIAL_SPREAD,
        seed=seed,
        population_size=POPULATION,
    )
    optimizer = make(mean=first[0])
    points = []
    history = []
    numbers = range(generations)
    for generation in numbers if progress is None else progress(numbers):
        samples = np.array([optimizer.ask() for _ in range(POPULATION)])
        if generation == 0:
            samples[: len(first)] = first
        costs = evaluate(samples)
        if generation == 0 and len(first) > 1:
            # Points far outside its spread would upset CMA-ES: it starts anew at the best one.
            optimizer = make(mean=samples[int(np.argmin(costs))])
        else:
            optimizer.tell(list(zip(samples, costs.tolist(), strict=True)))
        points.append(samples)
        history.append(tuple(costs.tolist()))
    return np.concatenate(points), tuple(history)


def _plain(value: Any) -> Any:
    """Return an option of the runner as a plain value, or as text."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return repr(value)
