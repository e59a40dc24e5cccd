"""Fits of all variants of the drive, and of other delays; the one with the highest likelihood is the result.

Efforts that jump from step to step are smoothed by a delay of a fractional number of steps, but not by a whole number.
So the likelihood may have a maximum between any two steps, and a fit finds the nearest. It is repeated one step earlier
and later.

Effects beside those of every fit are added one after the other, from the fit without them, and kept at the joints whose
error on the held-out part falls.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Document, Float64
from batchpid.sim.identification.fit import LEAST_GAIN, FitStep, Solution, fit
from batchpid.sim.identification.plant import plants_of
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.regression import Regression
from batchpid.sim.identification.unknowns import LAW
from batchpid.sim.tuning.history import HistoryFile

NEIGHBOURS, NEIGHBOUR_EVALUATIONS = 6, 8
"""Most fits at other delays, and most evaluations of each."""
EXTRA_EVALUATIONS = 25
"""Most evaluations of a fit with further unknowns."""
ACCEPTED = 0.99
"""Largest error on the held-out part with further unknowns that are kept, over the error without."""


class State(NamedTuple):
    """State of a search: everything on which its next steps depend; the history keeps it before each step."""

    step: FitStep
    """State of the present fit."""
    done: tuple[tuple[int, list[float]], ...] = ()
    """Completed fits: number of the problem, and solution."""

    def plain(self) -> Document:
        """Return the state as plain values."""
        theta, left, last, cost = self.step
        return {"theta": theta.tolist(), "left": left, "last": last.tolist(), "cost": cost, "done": self.done}

    @classmethod
    def of_plain(cls, found: Document, unknowns: int, evaluations: int, problems: int) -> State:
        """Return the state of plain values.

        Raises an error if it does not fit the numbers of ``unknowns``, ``evaluations`` and ``problems``.
        """
        theta, last = (np.array(found[name], float) for name in ("theta", "last"))
        done = tuple((int(number), [float(value) for value in point]) for number, point in found["done"])
        step = FitStep(theta, int(found["left"]), last, float(found["cost"]))
        points = [theta, last, *(np.array(point) for _, point in done)]
        if not all(point.shape == (unknowns,) and np.isfinite(point).all() for point in points):
            raise ValueError(f"its points are not {unknowns} finite numbers")
        if not 0 <= step.left <= evaluations or not all(0 <= number < problems for number, _ in done):
            raise ValueError("its counts are out of range")
        return cls(step, done)


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
    problems: list[Problem], state: State, evaluations: int, record: HistoryFile, progress: Progress
) -> tuple[Problem, Solution]:
    """Return the likeliest solution of the search from ``state`` on, and its problem, one of ``problems``.

    Each is begun with the solution of the one before, with ``evaluations`` at most.
    """
    done = [(number, fit(problems[number], FitStep.first(np.array(theta), 0))) for number, theta in state.done]
    begin: FitStep | None = state.step
    while (stage := _stage(problems, done, evaluations)) is not None:
        number, start = stage
        before = tuple((number, solution.theta.tolist()) for number, solution in done)

        def report(step: FitStep, cost: float, before: Any = before) -> None:
            record.write(State(step, before).plain())
            progress(len(before), step.left, cost)

        done.append((number, fit(problems[number], begin or start, report)))
        begin = None
    number, best = min(done, key=lambda each: each[1].cost)
    return problems[number], best


def extended(problem: Problem, best: Solution, kinds: tuple[str, ...]) -> tuple[Problem, Solution]:
    """Return the fit with further ``kinds`` of unknowns at the joints where the error on the held-out part falls."""
    sizes, joints = _typical(problem, best), list(range(len(problem.joints)))
    while joints:
        unknowns = problem.unknowns.plus(kinds, joints, sizes)
        wider = replace(problem, unknowns=unknowns)
        tried = unknowns.tries(best.theta, kinds, sizes)
        if not set(LAW).isdisjoint(kinds):  # with another law other motors explain the motion
            tried = np.concatenate([tried, [_regressed(wider, point) for point in tried]])
        costs = wider.costs(wider.sizes(wider.residuals(tried))).mean(1)
        found = fit(wider, FitStep.first(tried[int(costs.argmin())], EXTRA_EVALUATIONS))
        before, after = (wider.held_out_errors([window.residual for window in each.windows]) for each in (best, found))
        if np.linalg.norm(after) < ACCEPTED * np.linalg.norm(before):
            return wider, found
        fewer = [joint for joint in joints if after[joint] < ACCEPTED * before[joint]]
        joints = fewer if len(fewer) < len(joints) else []
    return problem, best


def _regressed(problem: Problem, point: Float64) -> Float64:
    """Return ``point`` with the motors that a regression gives for the law at ``point``."""
    unknowns, both = problem.unknowns, zip(problem.logs, problem.motions, strict=True)
    logs, motions = map(list, zip(*(each for each in both if not each[0].settings.held_out), strict=True))
    plants = plants_of(problem.robot, problem.joints, problem.drive, logs)
    motors, payload = unknowns.motors(point[None]), ("payload", None) in unknowns.names
    law = {name: motors[name] for name in LAW if name in motors}
    start = Regression(plants, logs, motions, payload, "gain" not in law, law)
    return unknowns.clip(unknowns.point(motors | start.best.motors))


def _typical(problem: Problem, best: Solution) -> dict[str, Float64]:
    """Return typical values (joints,) for further unknowns."""
    motions = problem.motions
    sizes = {
        "speed": np.max([np.abs(motion.qvel).max(0) for motion in motions], axis=0),
        "error": np.max([np.abs(motion.command - motion.qpos).max(0) for motion in motions], axis=0),
        "friction": problem.unknowns.motors(best.theta[None])["friction"][0],
    }
    return {name: np.maximum(size, 1e-3) for name, size in sizes.items()}


def _stage(problems: list[Problem], done: list[tuple[int, Solution]], evaluations: int) -> tuple[int, FitStep] | None:
    """Return the number of the next problem and where its fit begins, None at the end."""
    if len(done) < len(problems):
        start = done[-1][1].theta if done else np.zeros(0)  # the first begins where the state says
        return len(done), FitStep.first(start, evaluations)
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
                return number, FitStep.first(theta, NEIGHBOUR_EVALUATIONS)
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
