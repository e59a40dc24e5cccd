"""Search for the likeliest fit: assumptions about the drive, start, fits of all variants, other delays, more effects.

Filtered efforts hardly show a short delay, but the simulated motion does. For the start of a fit, the motion is
simulated for a grid of delays, and then for the candidates of a search over the unknowns that all joints share, by
CMA-ES (N. Hansen, "The CMA evolution strategy: a tutorial", arXiv:1604.00772). Each candidate has the motors that the
regression gives for its delay, payload and stopping time.

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
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.logged_control import LoggedDrive
from batchpid.sim.identification.plant import plants_of
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.regression import DELAYS, STRONG, WEAK, Motion, Regression, explains_better
from batchpid.sim.identification.unknowns import KINDS, LAW, Motors
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tuning.history import HistoryFile

GRID = DELAYS[::4]
"""Delays that are tried first [s]."""
GENERATIONS, POPULATION = 4, 8
SPREAD = np.array([5e-4, 0.3, 0.05])
"""Standard deviations of the first candidates: delay [s], logarithm of the stopping time, payload [kg]."""
NEIGHBOURS, NEIGHBOUR_EVALUATIONS = 6, 8
"""Most fits at other delays, and most evaluations of each."""
EXTRA_EVALUATIONS = 25
"""Most evaluations of a fit with further unknowns."""
ACCEPTED = 0.99
"""Largest error on the held-out part with further unknowns that are kept, over the error without."""


class State(NamedTuple):
    """State of a search: all that the rest of it depends on, and what its history holds before each step."""

    step: FitStep
    """State of the fit that is being done."""
    done: tuple[tuple[int, list[float]], ...] = ()
    """Fits that were done: number of the problem, and solution."""

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


def hypotheses(drive: LoggedDrive, payload: bool) -> list[LoggedDrive]:
    """Return the possible compensations: outside the motors, with the payload or without, or through the motors.

    The logged efforts may also include the compensation.
    """
    if drive.compensate == "none":
        return [drive]
    ways = [drive, replace(drive, through=True)]
    if payload:
        ways.append(replace(drive, knows_payload=True))
    return ways if drive.params is not None else [*ways, replace(drive, compensate="none")]


def variants(drive: LoggedDrive, motions: list[Motion]) -> list[LoggedDrive]:
    """Return the possible measurements of the law: with or without sensor noise, rates or differences of positions.

    Without noise, the law gets the simulated positions and rates.
    """
    if drive.params is None:
        return [drive]
    quiet = replace(drive, measured_rate=False)
    seen = any(motion.sensor.size.any() for motion in motions)
    return [*([replace(quiet, noisy=True)] if seen else []), quiet, *([drive] if drive.measured_rate else [])]


def best_drive(
    robot: Robot,
    joints: tuple[int, ...],
    drive: LoggedDrive,
    logs: list[Log],
    motions: list[Motion],
    payload: bool,
    gains_known: bool = True,
) -> tuple[LoggedDrive, Regression]:
    """Return the drive that explains the logs best, with its regression."""
    ways = hypotheses(drive, payload)
    found = [
        (Regression(plants_of(robot, joints, each, logs), logs, motions, payload, gains_known), each) for each in ways
    ]
    best, chosen = found[0]
    for other, way in found[1:]:
        if explains_better(other.best, best.best):
            best, chosen = other, way
    return chosen, best


def begin(problem: Problem, regression: Regression, ideal: Motors, seed: int) -> Float64:
    """Return the point (unknowns,) at which a fit begins: the candidate with the highest likelihood."""
    from cmaes import CMA

    unknowns = problem.unknowns

    def costs(candidates: list[Motors]) -> Float64:
        points = np.array([unknowns.clip(unknowns.point(motors)) for motors in candidates])
        return problem.costs(problem.sizes(problem.residuals(points)))

    # Each joint has its prior: the strong one where the log hardly shows the strength.
    kg, priors = regression.best.motors["payload"][0, 0], np.array([WEAK, STRONG])
    grid = costs([regression.at(delay, kg, prior).motors for prior in priors for delay in GRID])
    both = grid.reshape(len(priors), len(GRID), -1)
    late = both.min(0).sum(1).argmin()
    prior = priors[both[:, late].argmin(0)]

    yields = KINDS["stopping"]

    def candidate(x: Float64) -> Motors:
        delay, stopping, kg = x * SPREAD
        stopping = np.clip(np.exp(stopping), yields.low, yields.high)
        return regression.at(delay, kg, prior).motors | {"stopping": np.array([[stopping]])}

    first = regression.at(GRID[late], kg, prior).motors
    mean = np.array([GRID[late], np.log(yields.start), kg]) / SPREAD
    bounds = np.array([[0.0, DELAYS[-1]], np.log([yields.low, yields.high]), [0.0, np.inf]]) / SPREAD[:, None]
    bounds = bounds if ("payload", None) in unknowns.names else bounds[:2]
    optimizer = CMA(mean[: len(bounds)], 1.0, bounds=bounds, seed=seed, population_size=POPULATION)
    tried = [first, ideal]
    lowest = [*costs(tried).sum(1)]
    for _ in range(GENERATIONS):
        asked = [optimizer.ask() for _ in range(POPULATION)]
        candidates = [candidate(np.append(x, mean[len(x) :])) for x in asked]
        found = costs(candidates).sum(1)
        optimizer.tell(list(zip(asked, found, strict=True)))
        tried, lowest = [*tried, *candidates], [*lowest, *found]
    return unknowns.clip(unknowns.point(tried[int(np.argmin(lowest))]))


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
