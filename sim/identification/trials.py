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

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.fit import (
    DAMPING,
    FIRST_CHANGE,
    ROUGH_TOLERANCE,
    Fit,
    axes_of,
    bounded_step,
    inverse,
    inward,
    iterate,
    solve,
    triangle_of,
    with_certainty,
)
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.unknowns import SENDER, kinds_of

TRIAL = 5
"""Evaluations of a short fit."""
KEPT = 0.95
"""Share of the held-out error that an unknown has to leave for it to be kept."""
COLORED = 0.2
"""Correlation of the residuals from which further effects are tried."""
EFFECTS = {
    "stribeck": KEPT,
    "mass": 0.8,
    "offset": 0.8,
    "load_friction": 0.8,
}
"""Effects that are tried, and the share of the held-out error that each has to leave: every motor
has more friction at rest, but a few percent may be an error of the model that looks like a mass.
"""

Progress = Callable[[], object] | None


def fit(
    starts: Mapping[Hashable, Sequence[Problem]],
    evaluations: int,
    progress: Progress = None,
) -> Fit:
    """Fit from the best of ``starts``: alternatives by label, each with guesses of the motors."""
    problem, point = _best_start(starts, progress)
    coarse = problem.coarse()
    if coarse is not problem:
        point = solve(
            coarse,
            point,
            None,
            evaluations,
            progress,
            ROUGH_TOLERANCE,
        ).point
    result = with_certainty(solve(problem, point, None, evaluations, progress))
    result = _with_effects(result, evaluations, progress)
    return _without_sender(result, evaluations, progress)


def _with_effects(
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
        point = solve(
            coarse,
            point,
            None,
            TRIAL,
            progress,
            ROUGH_TOLERANCE,
        ).point
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
    error = _left(result)
    # A value at its bound of zero is left out as it is.
    result = _without(result, [kind for kind in SENDER if _value(result, kind) == 0.0])
    for kinds in (SENDER, SENDER[1:], SENDER[:1]):
        smaller = _without(result, kinds)
        if smaller is result:
            continue
        problem, point, size, *_ = smaller
        fitted = solve(problem, point, size, evaluations, progress)
        if _left(fitted) * KEPT <= error:
            return smaller._replace(
                point=fitted.point,
                size=fitted.size,
                converged=fitted.converged,
            )
    return result


def _value(result: Fit, kind: str) -> float:
    """Return the value of the unknown of a kind; NaN if there is none."""
    pairs = zip(result.problem.unknowns.entries, result.point.tolist(), strict=True)
    return next((value for entry, value in pairs if entry.kind == kind), np.nan)


def _without(result: Fit, kinds: Sequence[str]) -> Fit:
    """Return a fit without the unknowns of ``kinds``, the others as they are."""
    unknowns = result.problem.unknowns
    is_kept = np.array([entry.kind not in kinds for entry in unknowns.entries])
    if is_kept.all():
        return result
    return result._replace(
        problem=replace(result.problem, unknowns=unknowns.only(is_kept)),
        point=result.point[is_kept],
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
    problem = result.problem
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
    point = np.append(result.point, wider.start[count:])
    changes = FIRST_CHANGE * np.eye(len(point))
    changes[:count, :count] = _axes(result)
    if progress is not None:
        progress()
    changes = inward(point, changes, *wider.bounds)
    triangle = triangle_of(wide, iterate(wide, point, changes), result.size)
    low, high = wider.bounds - point
    names = np.array([entry.kind for entry in wider.entries])
    steps = np.zeros((len(effects), len(point)))
    for step, effect in zip(steps, effects, strict=True):
        is_free = np.isin(names, [*present, *kinds_of(effect)])
        columns = triangle[:, np.append(True, is_free)]
        step[is_free], _ = bounded_step(columns, DAMPING, low[is_free], high[is_free])
    before, *after = np.linalg.norm(wide.errors(point, steps) / result.size, axis=1).tolist()
    best = int(np.argmin(after))
    # A linear step is no fit: half of the decrease will do.
    if after[best] > 0.5 * (1 + EFFECTS[effects[best]]) * before:
        return result
    is_used = np.isin(names, [*present, *kinds_of(effects[best])])
    trial = replace(wide, unknowns=wider.only(is_used))
    start = (point + steps[best])[is_used]
    further = solve(
        trial,
        start,
        None,
        evaluations,
        progress,
        ROUGH_TOLERANCE,
    )
    share = _left(further._replace(size=result.size)) / before
    if share > EFFECTS[effects[best]]:
        return result
    trial = replace(trial, windows=problem.windows)
    further = solve(trial, further.point, None, evaluations, progress)
    added = {**result.effects, effects[best]: share}
    return with_certainty(further._replace(dropped=result.dropped, effects=added))


def _axes(result: Fit) -> Float64:
    """Return changes (unknowns, unknowns) along the axes of the covariance."""
    root = result.certainty.root / result.problem.unknowns.sizes[:, None]
    scale = np.maximum(np.abs(result.point), 1.0)
    axes, _ = axes_of(inverse(root @ root.T), scale)
    return axes


def _left(fit: Fit) -> float:
    """Return the held-out error over the size of the residuals, with free initial states."""
    return float(np.linalg.norm(fit.problem.errors(fit.point)[0] / fit.size))
