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

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.identification.fit import (
    DAMPING,
    FIRST_CHANGE,
    ROUGH_TOLERANCE,
    Fit,
    bounded_step,
    inward,
    iterate,
    triangle_of,
    with_certainty,
)
from batchpid.sim.identification.problem import Problem, size_of
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

Solver = Callable[..., Fit]
""":func:`batchpid.sim.identification.fit.solve` with its number of evaluations and its progress: of a
problem, from a point, to a tolerance.
"""


def fit(starts: Sequence[Problem], solver: Solver) -> Fit:
    """Fit from the best of ``starts``."""
    problem, point = _best_start(starts, solver)
    coarse = problem.coarse()
    if coarse is not problem:
        point = solver(coarse, point, tolerance=ROUGH_TOLERANCE).point
    result = with_certainty(solver(problem, point))
    # The effects that lower the held-out error, the most helpful first.
    while result.colored > COLORED:
        trial = _with_effect(result, solver)
        if trial is result:
            break
        result = trial
    return _without_sender(result, solver)


def _best_start(starts: Sequence[Problem], solver: Solver) -> tuple[Problem, Float64]:
    """Return the problem and the point of the start with the least error after a short fit."""
    point = starts[0].unknowns.start
    if len(starts) == 1:
        return starts[0], point
    least = np.inf
    for start in starts:
        coarse = start.coarse()
        end = solver(
            coarse,
            start.unknowns.start,
            evaluations=TRIAL,
            tolerance=ROUGH_TOLERANCE,
        ).point
        error = float(np.linalg.norm(size_of(coarse.fitted(end))))
        if error < least:
            problem = start
            point = end
            least = error
    return problem, point


def _without_sender(result: Fit, solver: Solver) -> Fit:
    """Return a fit without the delay and the lag of setpoints, or one of them, if the held-out
    error is about the same.

    Intervals stay as wide as with them: the motor's delay may be theirs in part.
    """
    error = _left(result)
    for kinds in (SENDER, SENDER[1:], SENDER[:1]):
        unknowns = result.problem.unknowns
        is_kept = np.array([entry.kind not in kinds for entry in unknowns.entries])
        if is_kept.all():
            continue
        problem = replace(result.problem, unknowns=unknowns.only(is_kept))
        smaller = solver(problem, result.point[is_kept])
        if _left(smaller._replace(size=result.size)) * KEPT <= error:
            return smaller._replace(
                deviation=result.deviation[is_kept],
                root=result.root[is_kept],
                shown=result.shown[is_kept],
                alike=result.alike[np.ix_(is_kept, is_kept)],
                dropped=kinds,
                effects=result.effects,
            )
    return result


def _with_effect(result: Fit, solver: Solver) -> Fit:
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
    changes = inward(point, FIRST_CHANGE * np.eye(len(point)), *wider.bounds)
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
    further = solver(trial, start, tolerance=ROUGH_TOLERANCE)
    share = _left(further._replace(size=result.size)) / before
    if share > EFFECTS[effects[best]]:
        return result
    trial = replace(trial, windows=problem.windows)
    further = solver(trial, further.point)
    added = {**result.effects, effects[best]: share}
    return with_certainty(further._replace(effects=added))


def _left(fit: Fit) -> float:
    """Return the held-out error over the size of the residuals, with free initial states."""
    return float(np.linalg.norm(fit.problem.errors(fit.point)[0] / fit.size))
