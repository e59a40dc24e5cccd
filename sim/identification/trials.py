"""Fit from several starts, and choice of the unknowns that the logs need.

A fit may end in a local minimum, for example with a payload at the wrong link, or with the law's
limit far from the error that saturates it. A short fit from each start shows the better one.

Unknowns besides those of the motors have to lower the error at held-out rows, with free initial
states of windows. A delay or a lag of setpoints is left out unless its absence raises that error.
Where residuals are correlated, friction at rest, masses, offsets and load friction are added, the
most helpful first, as long as the error falls. One evaluation with all of them, and the linear step
of each, give the order of the trials.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.fit import (
    DAMPING,
    FIRST_CHANGE,
    ROUGH_TOLERANCE,
    Solution,
    axes_of,
    bounded_step,
    iterate,
    solve,
    triangle_of,
)
from batchpid.sim.identification.intervals import Certainty, certainty, inverse
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.unknowns import SENDER, Unknown, kinds_of

TRIAL = 5
"""Evaluations of a short fit."""
KEPT = 0.95
"""Share of the held-out error that an unknown has to leave for it to be kept."""
COLORED = 0.2
"""Correlation of the residuals from which further effects are tried."""
EFFECTS = {"stribeck": KEPT, "mass": 0.8, "offset": 0.8, "load_friction": 0.8}
"""Effects that are tried, and the share of the held-out error that each has to leave: every motor
has more friction at rest, but a few percent may be an error of the model that looks like a mass.
"""

Progress = Callable[[], object] | None


class Fit(NamedTuple):
    """A fit, and what was left out of it or added to it."""

    problem: Problem
    solution: Solution
    certainty: Certainty
    dropped: tuple[Unknown, ...] = ()
    """Delay and lag of setpoints that the logs do not need."""
    effects: Mapping[str, float] = {}
    """Effects that were added, with the share of the held-out error that each left."""


def fit(
    starts: Mapping[Hashable, Sequence[Problem]],
    evaluations: int,
    progress: Progress = None,
) -> Fit:
    """Fit from the best of ``starts``: alternatives by label, each with guesses of the motors."""
    problem, point = _best_start(starts, progress)
    coarse = problem.coarse()
    if coarse is not problem:
        point = solve(coarse, point, None, evaluations, progress, ROUGH_TOLERANCE).point
    solution = solve(problem, point, None, evaluations, progress)
    result = Fit(problem, solution, certainty(problem, solution))
    return _without_sender(result, evaluations, progress)


def with_effects(
    result: Fit,
    evaluations: int,
    progress: Progress = None,
) -> Fit:
    """Return a fit with the effects that lower the held-out error, the most helpful first."""
    while result.certainty.colored > COLORED:
        trial = _with_effect(result, evaluations, progress)
        if trial is result:
            break
        result = trial
    return result


def _best_start(
    starts: Mapping[Hashable, Sequence[Problem]], progress: Progress
) -> tuple[Problem, Float64]:
    """Return the problem and the point of the start with the least error after a short fit."""

    def error(problem: Problem, point: Float64) -> float:
        return float(np.linalg.norm(problem.size(problem.evaluate(point))))

    tried = list[tuple[float, int, Problem, Float64]]()
    for guesses in starts.values():
        problem = guesses[0]
        if len(guesses) > 1:
            problem = min(guesses, key=lambda one: error(one.coarse(), one.unknowns.start))
        point = problem.unknowns.start
        if len(starts) == 1:
            return problem, point
        coarse = problem.coarse()
        point = solve(coarse, point, None, TRIAL, progress, ROUGH_TOLERANCE).point
        tried.append((error(coarse, point), len(tried), problem, point))
    return min(tried)[2:]


def _without_sender(
    result: Fit,
    evaluations: int,
    progress: Progress,
) -> Fit:
    """Return a fit without the delay and the lag of setpoints, or one of them, if the held-out
    error is about the same.

    Intervals stay as wide as with them: the motor's delay may be theirs in part.
    """
    error = _left(result.problem, result.solution)
    # A value at its bound of zero is left out as it is.
    result = _without(result, [kind for kind in SENDER if _value(result, kind) == 0.0])
    for kinds in (SENDER, SENDER[1:], SENDER[:1]):
        smaller = _without(result, kinds)
        if smaller is result:
            continue
        point, size, _ = smaller.solution
        solution = solve(smaller.problem, point, size, evaluations, progress)
        if _left(smaller.problem, solution) * KEPT <= error:
            return smaller._replace(solution=solution)
    return result


def _value(result: Fit, kind: str) -> float:
    """Return the value of the unknown of a kind; NaN if there is none."""
    pairs = zip(result.problem.unknowns.entries, result.solution.point.tolist(), strict=True)
    return next((value for entry, value in pairs if entry.kind == kind), np.nan)


def _without(result: Fit, kinds: Sequence[str]) -> Fit:
    """Return a fit without the unknowns of ``kinds``, the others as they are."""
    unknowns = result.problem.unknowns
    is_kept = np.array([entry.kind not in kinds for entry in unknowns.entries])
    if is_kept.all():
        return result
    return result._replace(
        problem=replace(result.problem, unknowns=unknowns.only(is_kept)),
        solution=result.solution._replace(point=result.solution.point[is_kept]),
        certainty=result.certainty.only(is_kept),
        dropped=(*result.dropped, *unknowns.only(~is_kept).entries),
    )


def _with_effect(
    result: Fit,
    evaluations: int,
    progress: Progress,
) -> Fit:
    """Return a fit with the effect whose linear step leaves the least held-out error, or the fit
    itself.
    """
    problem, solution = result.problem, result.solution
    unknowns = problem.unknowns
    present = [entry.kind for entry in unknowns.entries]
    effects = [effect for effect in EFFECTS if effect not in present]
    if not effects:
        return result
    # All effects at once, at the values where they are none.
    zero = np.zeros(len(unknowns.joints))
    kinds = [kind for effect in effects for kind in kinds_of(effect)]
    wider = unknowns.adding(kinds, {"load_friction": zero, "static": zero})
    wide = replace(problem.coarse(judged=True), unknowns=wider)
    count = len(present)
    point = np.append(solution.point, wider.start[count:])
    changes = FIRST_CHANGE * np.eye(len(point))
    changes[:count, :count] = _axes(result)
    if progress is not None:
        progress()
    triangle = triangle_of(wide, iterate(wide, point, changes), solution.size)
    low, high = wider.bounds - point
    names = np.array([entry.kind for entry in wider.entries])
    steps = np.zeros((len(effects), len(point)))
    for step, effect in zip(steps, effects, strict=True):
        is_free = np.isin(names, [*present, *kinds_of(effect)])
        columns = triangle[:, np.append(True, is_free)]
        step[is_free], _ = bounded_step(columns, DAMPING, low[is_free], high[is_free])
    before, *after = np.linalg.norm(wide.errors(point, steps) / solution.size, axis=1).tolist()
    best = int(np.argmin(after))
    # A linear step is no fit: half of the decrease will do.
    if after[best] > 0.5 * (1 + EFFECTS[effects[best]]) * before:
        return result
    is_used = np.isin(names, [*present, *kinds_of(effects[best])])
    trial = replace(wide, unknowns=wider.only(is_used))
    start = (point + steps[best])[is_used]
    further = solve(trial, start, None, evaluations, progress, ROUGH_TOLERANCE)
    share = _left(trial, further._replace(size=solution.size)) / before
    if share > EFFECTS[effects[best]]:
        return result
    trial = replace(trial, windows=problem.windows)
    further = solve(trial, further.point, None, evaluations, progress)
    added = {**result.effects, effects[best]: share}
    return Fit(trial, further, certainty(trial, further), result.dropped, added)


def _axes(result: Fit) -> Float64:
    """Return changes (unknowns, unknowns) along the axes of the covariance."""
    root = result.certainty.root / result.problem.unknowns.sizes[:, None]
    scale = np.maximum(np.abs(result.solution.point), 1.0)
    axes, _ = axes_of(inverse(root @ root.T), scale)
    return axes


def _left(problem: Problem, solution: Solution) -> float:
    """Return the held-out error over the size of the residuals, with free initial states."""
    return float(np.linalg.norm(problem.errors(solution.point)[0] / solution.size))
