"""Fits of all variants of the drive, and of other delays; the one with the highest likelihood is the result.

Efforts that jump from step to step are smoothed by a delay of a fractional number of steps, but not by a whole number.
So the likelihood may have a maximum between any two steps, and a fit finds the nearest. It is repeated one step earlier
and later.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.fit import LEAST_GAIN, Solution, Step, fit
from batchpid.sim.identification.fit_history import History, State
from batchpid.sim.identification.problem import Problem

NEIGHBOURS, NEIGHBOUR_EVALUATIONS = 6, 8
"""Most fits at other delays, and most evaluations of each."""


class Progress:
    """Progress of fits: a bar over their evaluations."""

    def __init__(self, fits: int, evaluations: int, progress: Callable[[Any], Any] | None) -> None:
        self._evaluations = evaluations
        self._bar = (progress or (lambda items: items))(range(fits * evaluations + 2 * NEIGHBOUR_EVALUATIONS))
        self._steps, self._shown = iter(self._bar), 0

    def __call__(self, done: int, left: int, cost: float) -> None:
        """Advance the bar to the number of ``done`` fits and of evaluations ``left``, and show the typical error."""
        while self._shown < (done + 1) * self._evaluations - left and next(self._steps, None) is not None:
            self._shown += 1
        if hasattr(self._bar, "set_postfix"):
            self._bar.set_postfix(error=f"{np.exp(cost):.3g}")


def search(
    problems: list[Problem], state: State, evaluations: int, record: History, progress: Progress
) -> tuple[Problem, Solution]:
    """Return the likeliest solution of the search from ``state`` on, and its problem, one of ``problems``.

    Each is begun with the solution of the one before, with ``evaluations`` at most.
    """
    done = [(number, fit(problems[number], Step.first(np.array(theta), 0))) for number, theta in state.done]
    begin: Step | None = state.step
    while (stage := _stage(problems, done, evaluations)) is not None:
        number, start = stage
        before = tuple((number, solution.theta.tolist()) for number, solution in done)

        def report(step: Step, cost: float, before: Any = before) -> None:
            record.write(State(step, before))
            progress(len(before), step.left, cost)

        done.append((number, fit(problems[number], begin or start, report)))
        begin = None
    number, best = min(done, key=lambda each: each[1].cost)
    return problems[number], best


def _stage(problems: list[Problem], done: list[tuple[int, Solution]], evaluations: int) -> tuple[int, Step] | None:
    """Return the number of the next problem and where its fit begins, None at the end."""
    if len(done) < len(problems):
        start = done[-1][1].theta if done else np.zeros(0)  # the first begins where the state says
        return len(done), Step.first(start, evaluations)
    variants, neighbours = done[: len(problems)], iter(done[len(problems) :])
    number, best = min(variants, key=lambda each: each[1].cost)
    jumps = problems[number].drive.noisy or problems[number].shoots
    if not jumps or len(done) - len(problems) >= NEIGHBOURS:
        return None
    for direction in (-1, 1):
        at = best
        while (theta := _delayed(problems[number], at.theta, direction)) is not None:
            found = next(neighbours, None)
            if found is None:
                return number, Step.first(theta, NEIGHBOUR_EVALUATIONS)
            if found[1].cost > at.cost - LEAST_GAIN:
                break
            at = found[1]
        if at is not best:
            return None
    return None


def _delayed(problem: Problem, theta: Float64, steps: int) -> Float64 | None:
    """Return ``theta`` with the delay increased by ``steps``, None if that is out of bounds."""
    if ("delay", None) not in problem.unknowns.names:
        return None
    delay = problem.unknowns.names.index(("delay", None))
    later = theta.copy()
    later[delay] += steps * problem.drive.timestep
    return later if problem.unknowns.low[delay] <= later[delay] <= problem.unknowns.high[delay] else None
