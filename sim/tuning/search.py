r"""Black-box search for gains by simulation: CMA-ES from the designed gains, in log space.

Each env runs one move of one candidate, as a step or as a smooth motion of the setpoint, so a generation is one rollout
and the gains found are good at both. The moves are free of contact, so the robots have no collision shapes in the
search. A share of the effort limits is a reserve for harder moves. :mod:`batchpid.sim.tuning.candidates` defines the
cost and the weight of each. The search itself is the package ``cmaes`` (N. Hansen, "The CMA
evolution strategy: a tutorial", arXiv:1604.00772).

Good gains for robots that differ from the model, by actuators or a randomization, are farther from the designed ones.
For such robots the first generation consists of the designs of :mod:`batchpid.sim.tuning.first_candidates`, and CMA-ES
starts from the best of them.

Gains that are best on the few moves of the search need not be best on others. So the best candidates and the designed
gains run a final round on more moves, with contacts, with the caller's solver, at the full effort limits. The gains
with the lowest cost there are the result.

The result of a search depends on its seed and not on the number of workers. To resume, a new search with the same seed
takes the costs of known generations from the history, and continues as if it had never stopped.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.arrays.digest import digest
from batchpid.checks.validate import integer, number
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.sim.options import RunnerOptions
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.ray_options import Ray
from batchpid.sim.robot.parts import DISSIPATION
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner import Runner
from batchpid.sim.tuning.candidates import HEADROOM, Candidates
from batchpid.sim.tuning.evaluation import SUBSTEPS
from batchpid.sim.tuning.first_candidates import first_gains, loop_delay
from batchpid.sim.tuning.history import HistoryFile, plain_options
from batchpid.sim.tuning.moves import Moves, random_moves, search_moves, tutorial_move
from batchpid.sim.tuning.randomization_presets import reseeded
from batchpid.sim.tuning.weights import Weights
from batchpid.sim.workers.contact_log import MissedContactWarning

INITIAL_SPREAD = 0.12
"""First standard deviation of the search, in log space."""
VARIED_MOVES, DRAWN_MOVES = 20, 8
"""Number of random moves in the search for robots that differ from the model, and with drawn motors."""
FINALISTS, FINAL_MOVES = 3, 24
"""Number of candidates in the final round, besides the designed gains, and of its moves."""
SEARCH_PHYSICS = {"collisions": False, "physics": "free"}
"""Options of the runner in the search, unless moves are given: the default moves are free of contact."""
_FINAL_SEED = 1_000_003
"""Difference between the seed of the final round and the seed of the search."""


class Tuning(NamedTuple):
    """Result of a search."""

    params: bp.PIDParams
    cost: float
    """Cost in the search."""
    start_params: bp.PIDParams
    """Designed gains that the search began with."""
    start_cost: float
    history: tuple[tuple[float, ...], ...]
    """Costs of every candidate of every generation."""
    settings: Document
    """Seed, moves, options and versions, for the record."""
    rejected: str | None = None
    """Criterion by which the designed gains beat all candidates, with both figures; None if a candidate was best."""


def tune(
    robot: Robot,
    *,
    seed: int = 0,
    generations: int = 10,
    population: int = 8,
    seconds: float = 1.5,
    gain_units: str = "mass_matrix",
    per_joint: bool = False,
    weights: Weights | None = None,
    moves: Moves | None = None,
    randomization: Randomization | None = None,
    motors: bp.Actuators | None = None,
    workers: int | None = None,
    cluster: Literal["ray"] | Ray | None = None,
    time_limit: float | None = None,
    history: Path | str | None = None,
    progress: Callable[[Any], Any] | None = None,
    **runner_options: Any,
) -> Tuning:
    """Search for gains of ``robot``.

    Parameters
    ----------
    seed
        Seed of the search, of the moves and, together with the randomization's seed, of the draws.
    generations, population
        Number of generations, and of candidates in each.
    seconds
        Simulated time of each move [s].
    gain_units
        "effort", "inertia" or "mass_matrix": :mod:`batchpid.law.computed_torque`.
    per_joint
        Search for a factor of each joint's gains too, which needs more generations.
    weights
        Of the terms of the cost. Default: 1 for a second of a step's settling time and 1 for the logarithm of the
        following error.
    moves
        Default: :func:`batchpid.sim.tuning.moves.search_moves`, and FINAL_MOVES random ones in the final round. For
        robots with actuators or a randomization, the search uses the tutorial's move and VARIED_MOVES random ones
        (with drawn ``motors`` DRAWN_MOVES),
        because the hardest moves within the effort limits of the model are too hard for such robots. Given moves
        replace them, with contacts, since they may touch something. There is then no final round.
    randomization
        The robot of each move is drawn from it, the same for all candidates. None: the robot as described.
    motors
        Actuators of which one is the true one, a row each: every move is made with another row, the same for all
        candidates, and the worst move counts as much as the mean. The controller knows the robot's own actuators.
    workers, cluster
        Number of processes, or a cluster: as for :class:`batchpid.sim.Runner`. The result does not depend on them.
    time_limit
        Stop after the generation in which this many seconds have passed; None: run all generations.
    history
        JSON file, written after each generation. If it exists the search resumes from it.
    progress
        Wraps the range of generations, e.g. ``tqdm.tqdm``; it may have ``set_postfix``.
    runner_options
        More options of :class:`batchpid.sim.Runner`, e.g. ``physics="fast"``, for the final round. They also apply to
        the search if there is a ``build`` or a floating base, or if the solver computes drives or SAPIEN's friction.

    Raises
    ------
    InvalidArgumentError
        An option is out of range or chosen by the search, such as ``params``, or the history is of another search.
    MissingDependencyError
        The package ``cmaes`` is missing.
    """
    refuse_searched(runner_options, ("params", "discretization"), "leave it out; bp.design_gains makes implicit gains")
    if motors is not None and runner_options.get("actuators") is not None:
        remedy = "leave it out; the control knows the actuators of the robot: Robot.load(..., actuators=...)"
        raise InvalidArgumentError("actuators", "is given with motors", remedy=remedy)
    seed, generations, population, seconds = checked_effort(seed, generations, population, seconds)
    weights = Weights() if weights is None else weights
    final = random_moves(robot, FINAL_MOVES, seed + _FINAL_SEED) if moves is None else None
    is_varied = randomization is not None or robot.actuators is not None or motors is not None
    of_mean = is_varied and motors is None
    if moves is None and is_varied:
        moves = tutorial_move(robot) + random_moves(robot, VARIED_MOVES if motors is None else DRAWN_MOVES, seed)
    moves = search_moves(robot, seed) if moves is None else moves
    own = final is not None and robot.fixed_base and runner_options.get("build") is None
    # Physics "free", with one iteration, is enough if the loop computes friction, and not the solver.
    is_free = own and DISSIPATION[robot.dissipation].modelled and runner_options.get("control", "pid") != "drive"
    settings: Document = {
        **robot.describe(),
        "seed": seed,
        "population": population,
        "robot_actuators": None if robot.actuators is None else digest(robot.actuators),
        "gain_units": gain_units,
        "per_joint": per_joint,
        "moves": list(moves.names),
        "moves_digest": digest(moves),
        "seconds": seconds,
        "weights": dataclasses.asdict(weights),
        "headroom": HEADROOM,
        "randomization": None if randomization is None else randomization.to_dict(),
        **({} if motors is None else {"motors": digest(motors)}),
        **plain_options(runner_options, history is not None),
        "search_physics": SEARCH_PHYSICS if is_free else None,
    }
    record = HistoryFile(history, "search", settings)
    search = Candidates(
        robot, gain_units, per_joint, moves, seconds, weights, headroom=1.0 if is_varied else HEADROOM, varied=of_mean
    )

    start = search.params(np.zeros((1, search.dimension)))
    firsts = [np.zeros(search.dimension)]  # the designed gains
    if is_varied:
        dt = float(runner_options.get("timestep", RunnerOptions.timestep))
        delay = loop_delay(robot, randomization, dt + float(np.max(start.derivative_filter_time)), motors)
        firsts += [*search.points(first_gains(delay))][: population - 1]
    where = {"workers": workers, "cluster": cluster, "randomization": reseeded(randomization, seed)}
    options: Document = {"params": start, "substeps": SUBSTEPS, **where} | runner_options
    search_options = options | {"ground": None, **SEARCH_PHYSICS} if is_free else options
    with Runner(robot, population * search.envs, **search_options | search.drawn(motors, population)) as runner:
        points, costs = evolve(
            lambda points: search.costs(runner, points),
            firsts,
            seed=seed,
            generations=generations,
            population=population,
            record=record,
            restart=is_varied,
            time_limit=time_limit,
            progress=progress,
        )
    every = np.concatenate([np.ravel(row) for row in costs])
    best, rejected = int(np.argmin(every)), None
    if not best:
        rejected = f"cost in the search: best candidate {every[1:].min():.4f}, designed {every[0]:.4f}"
    if final is not None and best:
        ranking = [int(index) for index in np.argsort(every, kind="stable")[:FINALISTS] if index]
        finalists = [*dict.fromkeys([*ranking, 0])]  # 0: the designed gains
        judge = Candidates(robot, gain_units, per_joint, final, seconds, weights, headroom=1.0, varied=of_mean)
        options["randomization"] = reseeded(randomization, seed + _FINAL_SEED)
        with Runner(robot, judge.envs * len(finalists), **options | judge.drawn(motors, len(finalists), -1)) as runner:
            finals = judge.costs(runner, points[finalists])
        best = finalists[int(np.argmin(finals))]
        if not best:
            rejected = f"cost in the final: best candidate {min(finals[:-1]):.4f}, designed {finals[-1]:.4f}"
    return Tuning(
        params=search.params(points[best][None]),
        cost=float(every[best]),
        start_params=start,
        start_cost=costs[0][0],
        history=costs,
        settings={**settings, "generations": len(costs)},
        rejected=rejected,
    )


def checked_effort(seed: int, generations: int, population: int, seconds: float) -> tuple[int, int, int, float]:
    """Return the arguments of a search if they are in range.

    Raises InvalidArgumentError if one is not, and MissingDependencyError without the package ``cmaes``.
    """
    try:
        import cmaes  # noqa: F401
    except ImportError:
        raise MissingDependencyError("cmaes", "tuning", "tune") from None
    return (
        integer("seed", seed, 0, 2**31 - 1),
        integer("generations", generations, 1, 100_000),
        integer("population", population, 4, 1000),
        number("seconds", seconds, 0.05, 600.0, "seconds"),
    )


def refuse_searched(runner_options: Mapping[str, Any], names: Sequence[str], remedy: str) -> None:
    """Raise InvalidArgumentError for options ``names``, which a search for explicit gains chooses itself."""
    for name in names:
        if name in runner_options:
            raise InvalidArgumentError(name, "is chosen by the search, which is for explicit gains", remedy=remedy)


def evolve(
    evaluate: Callable[[Float64], tuple[float, ...]],
    firsts: Sequence[Float64],
    *,
    seed: int,
    generations: int,
    population: int,
    record: HistoryFile,
    restart: bool = False,
    time_limit: float | None = None,
    progress: Callable[[Any], Any] | None = None,
) -> tuple[Float64, tuple[tuple[float, ...], ...]]:
    """Search by CMA-ES from ``firsts[0]``; return all points (n, dimension) and the costs of each generation.

    ``evaluate`` returns the costs of points (population, dimension). ``firsts`` replace the first points of the first
    generation. With ``restart`` CMA-ES starts again from the best point of that generation. Costs of known generations
    are read from ``record``, which is written after each new one.
    """
    from cmaes import CMA

    def optimizer_at(mean: Float64) -> CMA:
        return CMA(mean=mean, sigma=INITIAL_SPREAD, seed=seed, population_size=population)

    optimizer, known, points = optimizer_at(firsts[0]), _known_costs(record, population), list[Float64]()
    costs: list[tuple[float, ...]] = []
    began = time.monotonic()
    bar = (progress or (lambda items: items))(range(generations))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MissedContactWarning)  # a bad candidate may leave the line of its move
        for generation in bar:
            points += [optimizer.ask() for _ in range(population)]
            if generation == 0:
                points[: len(firsts)] = firsts
            if generation == len(known):
                known.append(evaluate(np.array(points[-population:])))
                record.write(known)
            if generation == 0 and restart:
                optimizer = optimizer_at(points[int(np.argmin(known[0]))])
            else:
                optimizer.tell(list(zip(points[-population:], known[generation], strict=True)))
            costs = known[: generation + 1]
            if hasattr(bar, "set_postfix"):
                bar.set_postfix(cost=f"{np.min(costs):.4f}", start=f"{costs[0][0]:.4f}")
            if time_limit is not None and time.monotonic() - began > time_limit:
                break
    return np.array(points), tuple(costs)


def _known_costs(record: HistoryFile, population: int) -> list[tuple[float, ...]]:
    """Return the costs of the generations in a history."""
    rows = record.read() or []
    try:
        costs = [tuple(float(cost) for cost in row) for row in rows]
    except (ValueError, TypeError, OverflowError) as error:
        raise record.damaged(str(error)) from None
    if any(len(row) != population or np.isnan(row).any() for row in costs):
        raise record.damaged(f"its generations do not have {population} costs each")
    return costs
