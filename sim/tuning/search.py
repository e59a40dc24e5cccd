r"""Black-box search for gains on the real scenes: CMA-ES from the designed gains, in log space.

Each env runs one move of one candidate, so that a generation is one rollout. A share of the effort limits is reserved
for moves that are harder than those searched. The cost of a candidate is the mean over joints, taken as the mean over
moves plus the worst move, of::

    w_itae ITAE / (A 1 s^2) + w_settling Ts / 1 s + w_overshoot log(1 + O / 5 %)
        + w_final log(1 + E / 1e-3) + w_chatter max(TV / TV_smooth - 1, 0) + w_saturation S

A is the joint's move, or the smallest that counts as one; O the overshoot as a fraction of that; E the error left
at the end; TV the total variation of the effort and TV_smooth that of the smooth motion that takes a second; S the
share of time in saturation. N. Hansen, "The CMA evolution strategy: a tutorial" (arXiv:1604.00772); the search itself
is the package ``cmaes``.

A search is a function of its seed and does not depend on the number of workers. To resume, a fresh search of the same
seed is given the costs in the history, and continues as if it had never stopped.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.files import write_atomically
from batchpid.stability import stability_bound
from batchpid.validate import integer, number
from batchpid.versions import package_versions
from sim.robot.robot import Robot
from sim.runner import Runner
from sim.tuning.evaluation import SUBSTEPS, absolute_band, run_moves
from sim.tuning.moves import Moves, search_moves, smooth_variation
from sim.tuning.randomization import draw_variation
from sim.tuning.weights import Weights

Float64 = NDArray[np.float64]
FACTORS = {
    # factor: its standard deviation at first, in units of INITIAL_SPREAD; the last two matter less
    "bandwidth": 1.0,
    "stiffness": 1.0,
    "damping": 1.0,
    "setpoint_weight": 2.0,
    "derivative_filter_time": 2.0,
}
"""Factors that are searched for all joints together; with ``per_joint`` one for each joint's inertia as well.

A bandwidth factor c moves all poles alike: kp c^2, ki c^3, kd c. Stiffness multiplies kp alone, damping kd alone.
"""
INITIAL_SPREAD = 0.12
"""First standard deviation of the search, in log space."""
HEADROOM = 0.9
"""Share of the effort limits that candidates may use."""
PENALTY_RATIO = 0.8
"""Stability ratio (:func:`batchpid.stability_bound`) beyond which a candidate is penalised."""
DIVERGED_COST = 1e3
"""Cost of a candidate that diverges; up to twice that, the sooner it does."""


class Tuning(NamedTuple):
    """Result of a search."""

    params: bp.PIDParams
    cost: float
    start_params: bp.PIDParams
    """Designed gains that the search began with."""
    start_cost: float
    history: tuple[tuple[float, ...], ...]
    """Costs of every candidate of every generation."""
    settings: dict[str, Any]
    """Seed, moves, options and versions, for the record."""


def tune(
    robot: Robot,
    *,
    seed: int = 0,
    generations: int = 10,
    population: int = 8,
    seconds: float = 1.5,
    gain_units: str = "mass_matrix",
    per_joint: bool = False,
    weights: Weights | None = None,
    moves: Moves | None = None,
    variation: Mapping[str, Any] | None = None,
    workers: int | None = None,
    time_limit: float | None = None,
    history: Path | str | None = None,
    progress: Callable[[Any], Any] | None = None,
    **runner_options: Any,
) -> Tuning:
    """Search for gains of ``robot``.

    Parameters
    ----------
    seed
        Of the search, the moves and the variation.
    generations, population
        Number of generations, and of candidates in each.
    seconds
        Simulated time of each move [s].
    gain_units
        "effort", "inertia" or "mass_matrix": :mod:`batchpid.computed_torque`.
    per_joint
        Search for a factor of each joint's gains too, which needs more generations.
    weights
        Of the terms of the cost.
    moves
        Default: those of :func:`sim.tuning.moves.search_moves`.
    variation
        Options of :func:`sim.tuning.randomization.draw_variation`, {} for its defaults: the robot of each move has its
        own payload and friction, the same for all candidates. None: no variation.
    workers
        Number of processes; the result does not depend on it.
    time_limit
        Stop after the generation in which this many seconds have passed; None: run all generations.
    history
        JSON file, written after each generation. If it exists the search resumes from it.
    progress
        Wraps the range of generations, e.g. ``tqdm.tqdm``; it may have ``set_postfix``.
    runner_options
        More options of :class:`sim.Runner`, e.g. ``physics="fast"``.

    Raises
    ------
    InvalidArgumentError
        An option out of range, or a history of another search.
    MissingDependencyError
        The package ``cmaes`` is missing.
    """
    try:
        from cmaes import CMA
    except ImportError:
        raise MissingDependencyError("cmaes", "tuning", "tune") from None
    seed = integer("seed", seed, 0, 2**31 - 1)
    generations = integer("generations", generations, 1, 100_000)
    population = integer("population", population, 4, 1000)
    seconds = number("seconds", seconds, 0.05, 600.0, "seconds")
    weights = Weights() if weights is None else weights
    moves = search_moves(robot, seed) if moves is None else moves
    count = len(moves.start)
    settings: dict[str, Any] = {
        "robot": robot.name,
        "seed": seed,
        "population": population,
        "gain_units": gain_units,
        "per_joint": per_joint,
        "moves": list(moves.names),
        "seconds": seconds,
        "weights": dataclasses.asdict(weights),
        "headroom": HEADROOM,
        "variation": None if variation is None else dict(variation),
        **{name: str(value) for name, value in runner_options.items()},
        "versions": package_versions(("batchpid", "sapien", "numpy", "cmaes")),
    }
    record = _History(history, settings)
    if variation is not None:
        drawn = draw_variation(robot, count, seed, **variation)
        runner_options["variation"] = drawn.for_envs(np.tile(np.arange(count), population))
    search = _Search(robot, gain_units, per_joint, moves, seconds, weights)
    optimizer = CMA(mean=np.zeros(search.dimension), sigma=INITIAL_SPREAD, seed=seed, population_size=population)
    start = search.params(np.zeros((1, search.dimension)))
    options: dict[str, Any] = {"params": start, "substeps": SUBSTEPS, "workers": workers} | runner_options
    points: list[Float64] = []
    began = time.monotonic()
    with Runner(robot, population * count, **options) as runner:
        bar = (progress or (lambda items: items))(range(generations))
        for generation in bar:
            points += [optimizer.ask() for _ in range(population)]
            if generation == 0:
                points[0] = np.zeros(search.dimension)  # the designed gains are a candidate too
            if generation == len(record.costs):
                record.append(search.costs(runner, np.array(points[-population:])))
            optimizer.tell(list(zip(points[-population:], record.costs[generation], strict=True)))
            costs = record.costs[: generation + 1]
            if hasattr(bar, "set_postfix"):
                bar.set_postfix(cost=f"{np.min(costs):.4f}", designed=f"{costs[0][0]:.4f}")
            if time_limit is not None and time.monotonic() - began > time_limit:
                break
    return Tuning(
        params=search.params(points[int(np.argmin(costs))][None]),
        cost=float(np.min(costs)),
        start_params=start,
        start_cost=costs[0][0],
        history=tuple(costs),
        settings={**settings, "generations": len(costs)},
    )


class _Search:
    """Search space and cost: from points to params, and to the costs of their rollouts."""

    def __init__(
        self, robot: Robot, gain_units: str, per_joint: bool, moves: Moves, seconds: float, weights: Weights
    ) -> None:
        self.robot, self.moves, self.seconds, self.weights = robot, moves, seconds, weights
        self.designed = robot.designed(gain_units)
        self.dimension = len(FACTORS) + (robot.dof if per_joint else 0)
        self._band = absolute_band(robot)
        self._smooth = smooth_variation(robot, moves, 1.0)
        self._size = np.maximum(np.abs(moves.target - moves.start), self._band / 0.02)
        # The plant that the gains see: mass matrices, the gains' unit per joint, and viscous damping.
        if gain_units == "mass_matrix":
            self._mass, self._damping = np.eye(robot.dof)[None], np.zeros(robot.dof)
        else:
            self._mass, self._damping = robot.mass_matrix(robot.sample(50, seed=0)), robot.damping
        inertia = gain_units == "inertia"
        self._unit = np.diagonal(self._mass, axis1=1, axis2=2) if inertia else np.ones(robot.dof)

    def params(self, points: Float64) -> bp.PIDParams:
        """Return params with one row for each of ``points`` (n, dimension)."""
        shared = np.exp(np.array(list(FACTORS.values())) * points[:, : len(FACTORS)])
        bandwidth, stiffness, damping, weight, filter_time = shared.T[..., None]
        joints = np.exp(points[:, len(FACTORS) :]) if self.dimension > len(FACTORS) else 1.0
        d = self.designed
        return d.replace(
            kp=d.kp * bandwidth**2 * stiffness * joints,
            ki=d.ki * bandwidth**3 * joints,
            kd=d.kd * bandwidth * damping * joints,
            setpoint_weight=np.minimum(d.setpoint_weight * weight, 1.0) + np.zeros_like(d.kp),
            derivative_filter_time=d.derivative_filter_time * filter_time,
        )

    def costs(self, runner: Runner, points: Float64) -> tuple[float, ...]:
        """Return the cost of each of ``points``, run on ``runner``, whose envs are candidates x moves."""
        count, moves, params = len(points), self.moves, self.params(points)
        limits = {name: getattr(params, name) for name in ("effort_min", "effort_max")}
        limited = params.replace(**{name: HEADROOM * limit for name, limit in limits.items() if limit is not None})
        runner.params = limited.for_envs(np.repeat(np.arange(count), len(moves.start)))
        rollout, m = run_moves(runner, moves.take(np.tile(np.arange(len(moves.start)), count)), self.seconds)
        w = self.weights

        def bounded(figure: Float64) -> Float64:
            return np.minimum(figure.reshape(count, *moves.start.shape), 1e6)

        cost = (
            w.itae * bounded(m.itae) / self._size
            + w.settling * np.minimum(bounded(m.settling_time), 1.5 * self.seconds)
            + w.overshoot * np.log1p(bounded(m.peak_deviation) / self._size / 0.05)
            + w.final * np.log1p(bounded(m.steady_state_error) / self._band)
            + w.chatter * np.maximum(bounded(m.effort_variation) / self._smooth - 1, 0)
            + w.saturation * bounded(m.saturation_share)
        ).mean(2)
        lasted = rollout.ok.mean(0).reshape(count, -1)
        total = np.minimum(cost.mean(1) + cost.max(1), DIVERGED_COST)
        total = np.where(lasted.min(1) < 1, DIVERGED_COST * (2 - lasted.mean(1)), total)
        return tuple((total + self._stability_penalty(params, runner.timestep)).tolist())

    def _stability_penalty(self, params: bp.PIDParams, dt: float) -> Float64:
        """Return the penalty (count,) of candidates near the stability bound, which these moves may not show."""
        ratios = [
            stability_bound(
                self._mass, kp * self._unit, kd * self._unit, dt, filter_time=tau, damping=self._damping
            ).ratio.max()
            for kp, kd, tau in zip(params.kp, params.kd, params.derivative_filter_time, strict=True)
        ]
        return 10 * np.maximum(np.array(ratios) - PENALTY_RATIO, 0)


class _History:
    """Costs of the generations of a search, kept in a file unless ``path`` is None; read from it if it exists."""

    def __init__(self, path: Path | str | None, settings: dict[str, Any]) -> None:
        self.costs: list[tuple[float, ...]] = []
        self._path, self._settings = path, settings
        if path is None or not Path(path).exists():
            return
        try:
            document = json.loads(Path(path).read_text())
            self.costs = [tuple(map(float, row)) for row in document["costs"]]
            ours, theirs = json.loads(json.dumps(settings)), document["settings"]
            different = sorted(key for key in {*ours, *theirs} if ours.get(key) != theirs.get(key))
            if any(len(row) != settings["population"] for row in self.costs):
                different.append("costs")
            problem = f"is of another search ({', '.join(different)} differ)" if different else None
        except (ValueError, KeyError, TypeError) as error:
            problem = f"is no history of a search: {error}"
        if problem is not None:
            raise InvalidArgumentError(
                "history", problem, value=str(path), remedy="use the same options, remove it, or name another file"
            )

    def append(self, costs: tuple[float, ...]) -> None:
        """Append those of a generation, and write the file."""
        self.costs.append(costs)
        if self._path is not None:
            write_atomically(self._path, json.dumps({"settings": self._settings, "costs": self.costs}))
