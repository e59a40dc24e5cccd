"""Search for gains of operational-space control on simulated moves of a tool, by CMA-ES from the default gains.

The robots have no collision shapes in the search, and candidates may use only a share of the effort limits. The best
candidates and the default gains then run a final round on other moves, with contacts, at the full limits. The gains
with the lowest cost there are the result.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Document
from batchpid.arrays.digest import digest
from batchpid.metrics import StepMetrics
from batchpid.sim.robot.findings import Findings
from batchpid.sim.robot.loop_stability import StabilityWarning
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner import Runner
from batchpid.sim.tool_space.osc_controller import default_tool
from batchpid.sim.tuning.candidates import HEADROOM
from batchpid.sim.tuning.evaluation import SUBSTEPS
from batchpid.sim.tuning.history import HistoryFile, plain_options
from batchpid.sim.tuning.search import FINALISTS, SEARCH_PHYSICS, checked_effort, evolve, refuse_searched
from batchpid.sim.tuning.tool_candidates import GAINS, SearchedSpace, ToolCandidates, osc_options, tool_moves
from batchpid.sim.tuning.weights import Weights
from batchpid.sim.workers.contact_log import MissedContactWarning

MOVES, FINAL_MOVES = 16, 16
"""Number of moves of the search and of its final round."""
_FINAL_SEED = 1_000_003


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
    remedy = "leave it out; discretization='implicit' may be added to the options found"
    refuse_searched(runner_options, ("params", "control", "discretization"), remedy)
    seed, generations, population, seconds = checked_effort(seed, generations, population, seconds)
    weights, tool = Weights() if weights is None else weights, default_tool(robot) if tool is None else tool
    posture = robot.start if robot.settings is None else robot.settings.target
    full = SearchedSpace(robot, tool, posture=posture)
    limited = SearchedSpace(robot, tool, posture=posture, effort_limit=HEADROOM * robot.effort_limit)
    moves, unseen = (tool_moves(robot, full, *each) for each in ((MOVES, seed), (FINAL_MOVES, seed + _FINAL_SEED)))
    search = ToolCandidates(robot, limited, moves, seconds, weights)
    judge = ToolCandidates(robot, full, unseen, seconds, weights)
    settings: Document = {
        **robot.describe(),
        "robot_actuators": None if robot.actuators is None else digest(robot.actuators),
        "tool": tool,
        "seed": seed,
        "population": population,
        "moves_digest": digest(moves),
        "seconds": seconds,
        "weights": dataclasses.asdict(weights),
        "headroom": HEADROOM,
        **plain_options(runner_options, history is not None),
    }
    options: Document = {"substeps": SUBSTEPS, "workers": workers, **runner_options}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StabilityWarning)
        warnings.simplefilter("ignore", MissedContactWarning)
        with Runner(
            robot, population * MOVES, control=limited, **options | {"ground": None} | SEARCH_PHYSICS
        ) as runner:
            points, costs = evolve(
                lambda points: search.evaluate(runner, search.gains(points))[0],
                [np.zeros(len(GAINS))],
                seed=seed,
                generations=generations,
                population=population,
                record=HistoryFile(history, "search", settings),
                time_limit=time_limit,
                progress=progress,
            )
        ranking = np.argsort(np.concatenate([np.ravel(row) for row in costs]), kind="stable")
        finalists = points[[0, *[index for index in ranking if index][:FINALISTS]]]
        with Runner(robot, len(finalists) * FINAL_MOVES, control=full, **options) as runner:
            gains = judge.gains(finalists)
            finals, metrics, rollout = judge.evaluate(runner, gains)
            best = int(np.argmin(finals))
    rejected = None
    if not best:
        rejected = f"cost in the final: best candidate {min(finals[1:]):.4f}, default {finals[0]:.4f}"
    each = [StepMetrics(*(leaf.reshape(len(finalists), FINAL_MOVES, 6)[k] for leaf in metrics)) for k in (0, best)]
    return ToolTuning(
        osc_options(gains[best]),
        (finals[0], finals[best]),
        (each[0], each[1]),
        {**settings, "generations": len(costs), "costs": [finals[0], finals[best]]},
        rollout.for_envs(slice(best * FINAL_MOVES, (best + 1) * FINAL_MOVES)).findings(robot),
        rejected,
    )
