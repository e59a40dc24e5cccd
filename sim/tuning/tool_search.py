"""Search for gains of operational-space control on moves of a tool (:mod:`batchpid.sim.tuning.evolution`)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from batchpid.arrays.array_types import Document
from batchpid.metrics import StepMetrics
from batchpid.sim.robot.findings import Findings
from batchpid.sim.robot.loop_stability import StabilityWarning
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tool_space.osc_controller import default_tool
from batchpid.sim.tuning.cost import HEADROOM, Weights
from batchpid.sim.tuning.evaluation import SUBSTEPS
from batchpid.sim.tuning.evolution import FINAL_SEED, SEARCH_PHYSICS, Search
from batchpid.sim.tuning.tool_candidates import SearchedSpace, ToolCandidates, osc_options, tool_moves

MOVES, FINAL_MOVES = 16, 16
"""Number of moves of the search and of its final round."""


class ToolTuning(NamedTuple):
    """Result of a search."""

    options: Document
    """Options of :func:`batchpid.task_space.make_osc_params`; the defaults if they were better."""
    costs: tuple[float, float]
    """Costs in the final round: of the default gains, and of the result."""
    metrics: tuple[StepMetrics, StepMetrics]
    """Metrics of the six axes on the moves of the final round (moves, 6): of the default gains, and of the result."""
    settings: Document
    """Seed, moves, options and versions, for the record."""
    findings: Findings
    """Causes for which moves of the final round do not settle under the result."""
    rejected: str | None = None
    """Criterion by which the default gains beat all candidates, with both figures; None if a candidate was best."""


def tune_tool(
    robot: Robot,
    tool: str | None = None,
    *,
    seed: int = 0,
    generations: int = 10,
    population: int = 8,
    seconds: float = 1.5,
    weights: Weights | None = None,
    workers: int | None = None,
    time_limit: float | None = None,
    history: Path | str | None = None,
    progress: Callable[[Any], Any] | None = None,
    **runner_options: Any,
) -> ToolTuning:
    """Search for gains of operational-space control of the link ``tool``, by default the robot's last link.

    The other arguments are as for :func:`batchpid.sim.tuning.search.tune`.

    Raises
    ------
    InvalidArgumentError
        An option is out of range or chosen by the search, the history is of another search, or no moves were found
        within the joint limits.
    MissingDependencyError
        The package ``cmaes`` is missing.
    RobotError
        The robot has no kinematic tree, for example because its base floats.
    """
    weights = Weights() if weights is None else weights
    search = Search(
        robot, runner_options, seed, generations, population, seconds, weights, time_limit, history, progress
    )
    remedy = "leave it out; discretization='implicit' may be added to the options found"
    search.refuse(("params", "control", "discretization"), remedy)
    tool = default_tool(robot) if tool is None else tool
    posture = robot.start if robot.settings is None else robot.settings.target
    full = SearchedSpace(robot, tool, posture=posture)
    limited = SearchedSpace(robot, tool, posture=posture, effort_limit=HEADROOM * robot.effort_limit)
    moves, unseen = (
        tool_moves(robot, full, count, search.seed + more) for count, more in ((MOVES, 0), (FINAL_MOVES, FINAL_SEED))
    )
    searched, judge = (
        ToolCandidates(robot, control, each, search.seconds, weights)
        for control, each in ((limited, moves), (full, unseen))
    )
    settings, options = search.settings(moves, tool=tool), {"substeps": SUBSTEPS, "workers": workers, **runner_options}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StabilityWarning)  # a candidate beyond the bound gets a penalty
        first, final = (searched, options | {"ground": None} | SEARCH_PHYSICS), (judge, options)
        found = search.run(settings, first, final)
    trial, place = found.final, found.place
    assert trial is not None
    costs = trial.costs[0], trial.costs[place]
    before, after = (StepMetrics(*(figure[each] for figure in trial.metrics)) for each in (0, place))
    envs = slice(place * judge.envs, (place + 1) * judge.envs)
    return ToolTuning(
        osc_options(judge.gains(found.point[None])[0]),
        costs,
        (before, after),
        {**settings, "generations": len(found.costs), "costs": [*costs]},
        trial.rollout.for_envs(envs).findings(robot),
        found.rejected,
    )
