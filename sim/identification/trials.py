"""Fit from several starts, without the delays that it does not need, and with the effects that it
does.

A start ends in a valley where the payload is sought at the wrong link, or the law's limit far from
the error that saturates it: a short fit from each start shows the better one. What is fitted in
addition to the motors has to lower the error at held-out rows, with free initial states: a delay or
a lag of setpoints is left out unless its absence raises that error, and friction at rest, masses,
offsets and load friction are added one after the other where the residuals are correlated and the
error falls.
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
    Solution,
    axes_of,
    bounded_step,
    iterate,
    solve,
    triangle_of,
)
from batchpid.sim.identification.intervals import Certainty, certainty
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.unknowns import SENDER, TOGETHER, Unknown

TRIAL = 5
"""Evaluations of a short fit."""
KEPT = 0.95
"""Share of the held-out error that an unknown has to leave for it to be kept."""
COLORED = 0.2
"""Correlation of the residuals from which further effects are tried."""
EFFECTS = ("stribeck", "mass", "offset", "load_friction")
"""Effects that are tried."""

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
            problem = min(guesses, key=lambda guess: error(guess, guess.unknowns.start))
        point = problem.unknowns.start
        if len(starts) == 1:
            return problem, point
        point = solve(problem, point, None, TRIAL, progress).point
        tried.append((error(problem, point), len(tried), problem, point))
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
    kinds = [kind for kind in EFFECTS if kind not in present]
    if not kinds:
        return result
    # All effects at once, at the values where they are none.
    none = {"load_friction": np.zeros(len(unknowns.joints)), "static": np.zeros(len(unknowns.joints))}
    names = [name for kind in kinds for name in TOGETHER.get(kind, (kind,))]
    wider = unknowns.adding(names, none)
    added = len(wider.entries) - len(present)
    wide = replace(problem, unknowns=wider)
    point = np.append(solution.point, wider.start[-added:])
    changes = FIRST_CHANGE * np.eye(len(point))
    changes[:-added, :-added] = _axes(result)
    if progress is not None:
        progress()
    triangle = triangle_of(wide, iterate(wide, point, changes), solution.size)
    low, high = wider.bounds
    steps = np.zeros((len(kinds), len(point)))
    for step, kind in zip(steps, kinds, strict=True):
        names = TOGETHER.get(kind, (kind,))
        is_free = np.array([entry.kind in (*names, *present) for entry in wider.entries])
        columns = triangle[:, np.append(True, is_free)]
        step[is_free], _ = bounded_step(
            columns, DAMPING, (low - point)[is_free], (high - point)[is_free]
        )
    errors = wide.errors(point, steps) / solution.size
    left = np.linalg.norm(errors, axis=1)
    best = int(np.argmin(left[1:]))
    kind = kinds[best]
    if left[1 + best] > KEPT * left[0]:
        return result
    names = TOGETHER.get(kind, (kind,))
    is_used = np.array([entry.kind in (*names, *present) for entry in wider.entries])
    problem = replace(problem, unknowns=wider.only(is_used))
    solution = solve(problem, (point + steps[best])[is_used], None, evaluations, progress)
    after = np.linalg.norm(problem.errors(solution.point)[0] / result.solution.size)
    if after > KEPT * left[0]:
        return result
    effects = {**result.effects, kind: float(after / left[0])}
    return Fit(problem, solution, certainty(problem, solution), result.dropped, effects)


def _axes(result: Fit) -> Float64:
    """Return changes (unknowns, unknowns) along the axes of the covariance."""
    root = result.certainty.root / result.problem.unknowns.sizes[:, None]
    scale = np.maximum(np.abs(result.solution.point), 1.0)
    axes, _ = axes_of(np.linalg.inv(root @ root.T), scale)
    return axes


def _left(problem: Problem, solution: Solution) -> float:
    """Return the held-out error over the size of the residuals, with free initial states."""
    return float(np.linalg.norm(problem.errors(solution.point)[0] / solution.size))
