"""Search for gains of joints by CMA-ES from the designed gains (:mod:`batchpid.sim.tuning.evolution`).

Each env runs one move of one candidate, as a step or as a smooth motion of the setpoint, so the gains found are good at
both.

Good gains for robots that differ from the model, by actuators or a randomization, are farther from the designed ones.
For such robots the first generation consists of designs for the loop's delay (:mod:`batchpid.sim.tuning.candidates`),
and CMA-ES starts from the best of them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document
from batchpid.arrays.digest import digest
from batchpid.errors import InvalidArgumentError
from batchpid.sim.options import RunnerOptions
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.ray_options import Ray
from batchpid.sim.robot.parts import DISSIPATION
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tuning.candidates import Candidates, first_gains, loop_delay
from batchpid.sim.tuning.cost import HEADROOM, Weights
from batchpid.sim.tuning.evaluation import SUBSTEPS
from batchpid.sim.tuning.evolution import FINAL_SEED, SEARCH_PHYSICS, Search
from batchpid.sim.tuning.moves import Moves, random_moves, search_moves, tutorial_move
from batchpid.sim.tuning.randomization_presets import reseeded

VARIED_MOVES, DRAWN_MOVES = 20, 8
"""Number of random moves in the search for robots that differ from the model, and with drawn motors."""
FINAL_MOVES = 24
"""Number of moves of the final round."""


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
    ranked_params: bp.PIDParams
    """Gains of all candidates, a row each, those of the lowest cost in the search first."""
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
        "effort" or "mass_matrix": :mod:`batchpid.law.computed_torque`.
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
    if motors is not None and runner_options.get("actuators") is not None:
        remedy = "leave it out; the control knows the actuators of the robot: Robot.load(..., actuators=...)"
        raise InvalidArgumentError("actuators", "is given with motors", remedy=remedy)
    weights = Weights() if weights is None else weights
    search = Search(
        robot, runner_options, seed, generations, population, seconds, weights, time_limit, history, progress
    )
    search.refuse(("params", "discretization"), "leave it out; bp.design_gains makes implicit gains")
    unseen = random_moves(robot, FINAL_MOVES, search.seed + FINAL_SEED) if moves is None else None
    is_varied = randomization is not None or robot.actuators is not None or motors is not None
    if moves is None and is_varied:
        moves = tutorial_move(robot) + random_moves(robot, VARIED_MOVES if motors is None else DRAWN_MOVES, search.seed)
    moves = search_moves(robot, search.seed) if moves is None else moves
    own = unseen is not None and robot.fixed_base and runner_options.get("build") is None
    # Physics "free", with one iteration, is enough if the loop computes friction, and not the solver.
    is_free = own and DISSIPATION[robot.dissipation].modelled and runner_options.get("control", "pid") != "drive"
    settings = search.settings(
        moves,
        gain_units=gain_units,
        per_joint=per_joint,
        moves=list(moves.names),
        randomization=None if randomization is None else randomization.to_dict(),
        search_physics=SEARCH_PHYSICS if is_free else None,
        **({} if motors is None else {"motors": digest(motors)}),
    )

    def candidates(moves: Moves, headroom: float, step: int) -> Candidates:
        varied = is_varied and motors is None
        known: Document = {"headroom": headroom, "varied": varied, "motors": motors, "step": step}
        return Candidates(robot, gain_units, per_joint, moves, search.seconds, weights, **known)

    searched = candidates(moves, 1.0 if is_varied else HEADROOM, 1)
    start, designs = searched.params(np.zeros((1, searched.dimension))), None
    if is_varied:
        dt = float(runner_options.get("timestep", RunnerOptions.timestep))
        delay = loop_delay(robot, randomization, dt + float(np.max(start.derivative_filter_time)), motors)
        designs = searched.points(first_gains(delay))
    options: Document = {"params": start, "substeps": SUBSTEPS, "workers": workers, "cluster": cluster} | runner_options
    drawn, others = (reseeded(randomization, each) for each in (search.seed, search.seed + FINAL_SEED))
    first = (searched, options | {"randomization": drawn} | ({"ground": None, **SEARCH_PHYSICS} if is_free else {}))
    final = None if unseen is None else (candidates(unseen, 1.0, -1), options | {"randomization": others})
    found = search.run(settings, first, final, designs)
    return Tuning(
        params=searched.params(found.point[None]),
        cost=found.cost,
        start_params=start,
        start_cost=found.costs[0][0],
        history=found.costs,
        ranked_params=searched.params(found.ranked),
        settings={**settings, "generations": len(found.costs)},
        rejected=found.rejected,
    )
