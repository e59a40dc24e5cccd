r"""Fit of simulated motions to logs: Gauss-Newton with finite differences, all perturbed candidates at once.

With the measured positions y and the simulated ones q(theta) of all joints j and rows k, the fit minimises the negative
logarithm of the likelihood for white noise of unknown size on each joint::

    sum_j N_j / 2 log(sum_k r_jk^2 / N_j),     r = y - q(theta)

A Gauss-Newton step solves the least-squares problem weighted by the residuals' present size of each joint, damped as D.
Marquardt does where a step fails, within the bounds of the unknowns (J. Nocedal and S. Wright, Numerical Optimization,
2nd ed., 2006, section 10.3). Column i of the Jacobian is the simulated motion with unknown i changed a little, less the
motion without, over the change.

Under the PID law a whole log is one simulation. A log of efforts is cut into short windows, because an error of an
uncontrolled arm grows: multiple shooting (H. G. Bock, "Recent advances in parameter identification techniques for
O.D.E.", 1983). The state at the start of a window is unknown, too; its effect, linear for small errors, is projected
out of the residual and the Jacobian of that window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.robot.robot import Robot
from sim.tuning.identification.logs import Log
from sim.tuning.identification.plant import Drive
from sim.tuning.identification.regression import Motion
from sim.tuning.identification.unknowns import Unknowns
from sim.tuning.identification.windows import Window, cut, project, simulate, whole

Float64 = NDArray[np.float64]
CHUNK = 256
"""Most simulations of one task."""
STATE_STEP = 1e-4
"""Change of an initial position [rad or m], and of a velocity per second, for the projection."""
MAX_ITERATIONS = 25
GAIN = 2e-5
"""Least decrease of the cost for which the fit goes on."""
CONVERGED = 0.02
"""Size of a step, in standard deviations of the unknowns, below which the fit ends."""


@dataclass
class Problem:
    """Logs to fit, cut into windows."""

    robot: Robot
    joints: tuple[int, ...]
    drive: Drive
    logs: list[Log]
    motions: list[Motion]
    unknowns: Unknowns
    executor: Executor | None = None
    windows: list[Window] = field(init=False)

    def __post_init__(self) -> None:
        divide = whole if self.drive.params is not None else cut
        self.windows = [
            window
            for number, (log, motion) in enumerate(zip(self.logs, self.motions, strict=True))
            for window in divide(number, log, motion, self.drive.timestep)
        ]

    def evaluate(self, theta: Float64, jacobian: bool) -> list[tuple[Float64, Float64 | None]]:
        """Return the residuals (rows, joints) of each window, and their Jacobians (rows, joints, unknowns)."""
        unknowns, shoots = self.unknowns, self.drive.params is None
        joints = len(self.joints)
        steps = unknowns.steps(theta)
        points = np.vstack([theta, theta + np.diag(steps)]) if jacobian else theta[None]
        motors = unknowns.motors(points)
        states = np.zeros((len(points), 2, joints))
        if shoots:
            shift = STATE_STEP * np.eye(2 * joints).reshape(-1, 2, joints)
            states = np.concatenate([states, shift])
            motors = motors.take(np.r_[: len(points), np.zeros(2 * joints, int)])
        tasks, sizes = [], len(states)
        halves = 1 if shoots or sizes == 1 else 2
        for group in self._groups(max(1, CHUNK // sizes)):
            members = [self.windows[number] for number in group]
            rows = np.array_split(np.arange(sizes), halves)
            tasks += [(members, motors.take(part), states[part]) for part in rows]
        simulated = self._map(tasks)
        found: list[tuple[Float64, Float64 | None]] = []
        parts = iter(simulated)
        for group in self._groups(max(1, CHUNK // sizes)):
            pieces = [next(parts) for _ in range(halves)]
            for number, member in enumerate(group):
                window = self.windows[member]
                positions = np.concatenate([piece[number] for piece in pieces])
                residual = window.measured - positions[0]
                slopes = (positions[1 : len(points)] - positions[0]) / steps[:, None, None] if jacobian else None
                columns = None if slopes is None else slopes.transpose(1, 2, 0)
                if shoots:
                    basis = ((positions[len(points) :] - positions[0]) / STATE_STEP).transpose(1, 2, 0)
                    residual, columns = project(basis, residual, columns)
                found.append((residual, columns))
        return found

    def lags(self, seconds: float) -> list[int]:
        """Return how many rows of each log are ``seconds`` long."""
        return [round(seconds / float(np.median(np.diff(log.time)))) for log in self.logs]

    def _groups(self, most: int) -> Iterator[list[int]]:
        """Yield the numbers of windows that are simulated together: of the same number of steps."""
        group: list[int] = []
        for number, window in enumerate(self.windows):
            shape = window.segment.command.shape, window.past
            if group and (
                len(group) == most
                or shape != (self.windows[group[0]].segment.command.shape, self.windows[group[0]].past)
            ):
                yield group
                group = []
            group.append(number)
        if group:
            yield group

    def _map(self, tasks: list[Any]) -> list[list[Float64]]:
        about = (self.robot, self.joints, self.drive)
        if self.executor is None:
            return [simulate(about, *task) for task in tasks]
        return list(self.executor.map(simulate, [about] * len(tasks), *zip(*tasks, strict=True)))


class Iterate(NamedTuple):
    """Accepted point of the fit."""

    theta: Float64
    cost: float
    windows: list[tuple[Float64, Float64 | None]]
    sigma: Float64
    """Root mean square of the residuals of each joint (joints,)."""


def cost_of(problem: Problem, windows: list[tuple[Float64, Float64 | None]]) -> tuple[float, Float64]:
    """Return the negative logarithm of the likelihood per joint and row, and the residuals' sizes (joints,)."""
    rows = np.concatenate([r[w.fitted] for (r, _), w in zip(windows, problem.windows, strict=True)])
    with np.errstate(invalid="ignore", over="ignore"):
        sigma = np.sqrt((rows**2).mean(0)) + 1e-12
        cost = float(np.log(sigma).mean())
    return (cost, sigma) if np.isfinite(cost) else (np.inf, sigma)


class State(NamedTuple):
    """State of a fit before a step."""

    theta: Float64
    damping: float = 0.0
    step: int = 0


def fit(
    problem: Problem,
    state: State,
    *,
    iterations: int = MAX_ITERATIONS,
    record: Callable[[State], None] | None = None,
    progress: Callable[[Any], Any] | None = None,
) -> Iterate:
    """Return the best point from ``state`` on; ``record`` is called with the state before each step."""
    unknowns, damping = problem.unknowns, state.damping
    best = _iterate(problem, state.theta)
    bar = (progress or (lambda items: items))(range(state.step, iterations))
    for number in bar:
        if record is not None:
            record(State(best.theta, damping, number))
        if hasattr(bar, "set_postfix"):
            bar.set_postfix(error=f"{np.exp(best.cost):.3g}")
        step, deviation = gauss_newton_step(problem, best, damping)
        theta = unknowns.clip(best.theta + step)
        moved = float(np.max(np.abs(theta - best.theta) / deviation))
        if moved < CONVERGED:
            break
        tried = _iterate(problem, theta)
        if tried.cost < best.cost:
            gain, best = best.cost - tried.cost, tried
            damping = 0.0 if damping < 1e-3 else damping / 10
            if gain < GAIN:
                break
        elif damping > 1e6:
            break
        else:
            damping = max(10 * damping, 1e-2)
    return best


def _iterate(problem: Problem, theta: Float64) -> Iterate:
    windows = problem.evaluate(theta, jacobian=True)
    cost, sigma = cost_of(problem, windows)
    return Iterate(theta, cost, windows, sigma)


def weighted(problem: Problem, point: Iterate) -> tuple[Float64, Float64]:
    """Return the fitted residuals (n,) and their Jacobian (n, unknowns), in units of each joint's sigma."""
    residuals, columns = [], []
    for (residual, jacobian), window in zip(point.windows, problem.windows, strict=True):
        assert jacobian is not None
        residuals.append((residual[window.fitted] / point.sigma).reshape(-1))
        columns.append((jacobian[window.fitted] / point.sigma[:, None]).reshape(-1, jacobian.shape[2]))
    return np.concatenate(residuals), np.nan_to_num(np.concatenate(columns))


def gauss_newton_step(problem: Problem, point: Iterate, damping: float) -> tuple[Float64, Float64]:
    """Return the step within the bounds, and the standard deviations of the unknowns for white noise."""
    from scipy.optimize import lsq_linear

    unknowns = problem.unknowns
    r, columns = weighted(problem, point)
    scale = unknowns.scale
    normal = (columns * scale).T @ (columns * scale)
    target = (columns * scale).T @ r
    prior = (scale / unknowns.spread) ** 2
    information = normal + np.diag(prior)
    gradient = target + prior * (unknowns.prior - point.theta) / scale
    root = np.linalg.cholesky(information + damping * np.diag(np.diagonal(information)) + 1e-12 * np.eye(len(scale)))
    low, high = ((bound - point.theta) / scale for bound in (unknowns.low, unknowns.high))
    tiny = 1e-12 + 1e-9 * np.abs(high - low).clip(max=1e3)
    solved = lsq_linear(
        root.T, np.linalg.solve(root, gradient), (np.minimum(low, 0) - tiny, np.maximum(high, 0) + tiny)
    )
    deviation = scale * np.sqrt(np.diagonal(np.linalg.inv(information)))
    return scale * solved.x, deviation
