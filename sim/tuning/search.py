r"""Black-box tuning on the real scenes: CMA-ES from the designed gains, in log space, many candidates at once.

Every candidate runs every move in an env of its own, so a generation is one rollout, with a share of the effort limits
kept back for moves that are harder than those searched. Its cost is the mean over joints, taken as the mean over moves
plus the worst move, of::

    w_itae ITAE / (A 1 s^2) + w_settling Ts / 1 s + w_overshoot log(1 + O / 5 %)
        + w_final log(1 + E / 1e-3) + w_chatter max(TV / TV_smooth - 1, 0) + w_saturation S

A is the joint's move, or the smallest that counts as one; O the overshoot as a fraction of that; E the error left
at the end; TV the total variation of the effort and TV_smooth that of the smooth motion that takes a second; S the
share of time in saturation. N. Hansen, "The CMA evolution strategy: a tutorial" (arXiv:1604.00772); the search itself
is the package ``cmaes``.

A search is a function of its seed: the number of workers does not enter, and its history replays it. To resume, the
costs in the history are told to a fresh search of the same seed, which then goes on as if it had never stopped.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
from sim.robot.limits import SetpointWarning
from sim.robot.robot import Robot
from sim.runner import Runner
from sim.tuning.evaluation import SUBSTEPS, absolute_band, judge
from sim.tuning.moves import Moves, search_moves, smooth_effort
from sim.tuning.randomization import draw_variation

Float64 = NDArray[np.float64]
SHARED = ("bandwidth", "stiffness", "damping", "setpoint_weight", "derivative_filter_time")
"""Factors that the search finds for all joints together; with ``per_joint`` one for each joint's inertia as well.

By a bandwidth c the poles move out alike: kp c^2, ki c^3, kd c. Stiffness multiplies kp alone, damping kd alone.
"""
REACH = np.array([1.0, 1.0, 1.0, 2.0, 2.0])
"""How far each is varied, in units of SPREAD: the last two matter less."""
START_HZ = 1.7
"""Bandwidth of the designed gains that a search begins with."""
HEADROOM = 0.9
"""Share of the effort limits that candidates may use: what the searched moves leave is for harder ones."""
SPREAD = 0.12
"""First standard deviation of the search, in log space."""
SAFE_RATIO = 0.8
"""Share of the stability range beyond which a candidate pays."""
FAILED = 1e3
"""Cost of a candidate that diverges; smaller the longer it lasts."""


@dataclass(frozen=True)
class Weights:
    """What the cost is made of."""

    itae: float = 1.0
    """Of the normalised ITAE."""
    settling: float = 1.0
    """Of the settling time in seconds."""
    overshoot: float = 1.0
    """Of the overshoot, as log(1 + overshoot / 5 %): one move beyond reach must not outweigh all others."""
    final: float = 2.0
    """Of the error left at the end, as log(1 + error / settling band's least width)."""
    chatter: float = 0.3
    """Of the effort's variation beyond that of the smooth motion."""
    saturation: float = 3.0
    """Of the share of time in saturation."""


def start_gains(robot: Robot, gain_units: str = "mass_matrix") -> bp.PIDParams:
    """The designed gains that a search begins with.

    With the mass matrix the poles lie between those of Bessel's prototype s^3 + 6 s^2 + 15 s + 15 (W. E. Thomson,
    "Delay networks having maximally flat frequency characteristics", Proc. IEE 96, 1949), zeta = sqrt(0.6) and
    Ti = sqrt(15) / w, and three equal ones: a step settles in 0.91 s with 0.1 % overshoot, and takes two thirds of the
    effort of three equal poles that are as fast. With other units joints disturb each other, which those bear better.
    """
    if gain_units != "mass_matrix":
        return bp.design_gains(robot, 2.25, gain_units=gain_units, measurement_rate="measured")
    integral_time = 4.5 / (2 * math.pi * START_HZ)
    return bp.design_gains(
        robot, START_HZ, 0.82, integral_time=integral_time, gain_units=gain_units, measurement_rate="measured"
    )


class Tuning(NamedTuple):
    """What a search found."""

    params: bp.PIDParams
    cost: float
    start_params: bp.PIDParams
    """The designed gains that it began with."""
    start_cost: float
    history: tuple[tuple[float, ...], ...]
    """Costs of every candidate of every generation: with the seed, all it takes to resume."""
    settings: dict[str, Any]
    """Seed, moves and versions, for the record."""


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
        How often a population of so many candidates is tried.
    seconds
        Simulated time of each move [s].
    gain_units
        "effort", "inertia" or "mass_matrix": :mod:`batchpid.computed_torque`.
    per_joint
        Search for a factor of each joint's gains too; more generations are needed.
    weights
        Of the cost.
    moves
        Default: those of :func:`sim.tuning.moves.search_moves`.
    variation
        Options of :func:`sim.tuning.randomization.draw_variation`, {} for its defaults: each move gets a robot of its
        own payload and friction, the same for all candidates. None: the robot as it is.
    workers
        Processes; the result does not depend on it.
    time_limit
        Stop after the generation in which this many seconds have passed; None: run all generations.
    history
        A JSON file that is written after each generation. If it exists the search resumes from it.
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
    generations, population = (
        integer("generations", generations, 1, 100_000),
        integer("population", population, 4, 1000),
    )
    number("seconds", seconds, 0.05, 600.0, "seconds")
    weights = Weights() if weights is None else weights
    if moves is None:
        moves = search_moves(robot, seed)
    search = _Search(robot, gain_units, per_joint, moves, seconds, weights)
    settings = {
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
    cma = CMA(mean=np.zeros(search.dimension), sigma=SPREAD, seed=seed, population_size=population)
    known = _read_history(history, settings)
    options: dict[str, Any] = {
        "substeps": SUBSTEPS,
        "workers": workers,
        **runner_options,
    }
    if variation is not None:
        drawn = draw_variation(robot, len(moves.start), seed, **variation)
        options["variation"] = drawn.for_envs(np.tile(np.arange(len(moves.start)), population))
    began, costs_of, best = time.monotonic(), [], (math.inf, np.zeros(search.dimension))
    start_cost = math.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SetpointWarning)
        runner = Runner(
            robot,
            population * len(moves.start),
            params=search.params(np.zeros((1, search.dimension))),
            **options,
        )
        with runner:
            bar = (progress or (lambda items: items))(range(generations))
            for generation in bar:
                points = [cma.ask() for _ in range(population)]
                if generation == 0:
                    points[0] = np.zeros(search.dimension)  # the designed gains are a candidate too
                replayed = generation < len(known)
                costs = known[generation] if replayed else search.costs(runner, np.array(points))
                cma.tell([(point, cost) for point, cost in zip(points, costs, strict=True)])
                costs_of.append(tuple(costs))
                if generation == 0:
                    start_cost = costs[0]
                lowest = int(np.argmin(costs))
                if costs[lowest] < best[0]:
                    best = (costs[lowest], points[lowest])
                if hasattr(bar, "set_postfix"):
                    bar.set_postfix(cost=f"{best[0]:.4f}", designed=f"{start_cost:.4f}")
                if not replayed:
                    _write_history(history, settings, costs_of)
                if time_limit is not None and time.monotonic() - began > time_limit:
                    break
    return Tuning(
        params=search.params(best[1][None]),
        cost=float(best[0]),
        start_params=search.params(np.zeros((1, search.dimension))),
        start_cost=float(start_cost),
        history=tuple(costs_of),
        settings={**settings, "generations": len(costs_of)},
    )


class _Search:
    """From a point of the search space to params, and from a rollout of candidates to their costs."""

    def __init__(
        self, robot: Robot, gain_units: str, per_joint: bool, moves: Moves, seconds: float, weights: Weights
    ) -> None:
        self.robot, self.moves, self.seconds, self.weights = robot, moves, seconds, weights
        self.designed = start_gains(robot, gain_units)
        self.dimension = len(SHARED) + (robot.dof if per_joint else 0)
        self._band = absolute_band(robot)
        smooth = [
            np.abs(np.diff(smooth_effort(robot, s, t, 1.0), axis=0)).sum(0)
            for s, t in zip(moves.start, moves.target, strict=True)
        ]
        floor = 1e-3 * np.where(np.isfinite(robot.effort_limit), robot.effort_limit, 1.0)
        self._smooth = np.maximum(smooth, floor)
        self._size = np.maximum(np.abs(moves.target - moves.start), self._band / 0.02)
        self._mass = None if gain_units == "mass_matrix" else robot.mass_matrix(robot.sample(50, seed=0))
        self._diagonal = gain_units == "inertia"

    def params(self, points: Float64) -> bp.PIDParams:
        """Params with one row for each of ``points`` (n, dimension)."""
        shared = np.exp(REACH * points[:, : len(SHARED)])
        bandwidth, stiffness, damping, weight, filter_time = shared.T[..., None]
        joints = np.exp(points[:, len(SHARED) :]) if self.dimension > len(SHARED) else 1.0
        d = self.designed
        return d.replace(
            kp=d.kp * bandwidth**2 * stiffness * joints,
            ki=d.ki * bandwidth**3 * joints,
            kd=d.kd * bandwidth * damping * joints,
            setpoint_weight=np.minimum(d.setpoint_weight * weight, 1.0) + np.zeros_like(d.kp),
            derivative_filter_time=d.derivative_filter_time * filter_time,
        )

    def costs(self, runner: Runner, points: Float64) -> list[float]:
        """Cost of each of ``points``, tried on ``runner``, whose envs are candidates x moves."""
        count, moves = len(points), self.moves
        table = self.params(points)
        runner.params = _with_headroom(table).for_envs(np.repeat(np.arange(count), len(moves.start)))
        start, target = np.tile(moves.start, (count, 1)), np.tile(moves.target, (count, 1))
        runner.reset(start)
        ticks = max(10, round(self.seconds / (runner.timestep * runner.substeps)))
        rollout = runner.rollout(np.broadcast_to(target, (ticks, *target.shape)))
        m = judge(self.robot, rollout, start)
        shape = (count, *moves.start.shape)
        w, horizon = self.weights, self.seconds

        def part(figure: Float64) -> Float64:
            return np.minimum(figure.reshape(shape), 1e6)

        cost = (
            w.itae * part(m.itae) / self._size
            + w.settling * np.minimum(part(m.settling_time), 1.5 * horizon)
            + w.overshoot * np.log1p(part(m.peak_deviation) / self._size / 0.05)
            + w.final * np.log1p(part(m.steady_state_error) / self._band)
            + w.chatter * np.maximum(part(m.effort_variation) / self._smooth - 1, 0)
            + w.saturation * part(m.saturation_share)
        ).mean(2)
        total = cost.mean(1) + cost.max(1)
        lasted = rollout.ok.mean(0).reshape(count, -1)
        total = np.where(lasted.min(1) < 1, FAILED * (2 - lasted.mean(1)), np.minimum(total, FAILED))
        return [float(c) for c in total + self._nearness(table, runner.timestep)]

    def _nearness(self, table: bp.PIDParams, dt: float) -> Float64:
        """What candidates near to the stability limit pay (count,), whether or not these moves show it."""
        joints = self.robot.dof
        mass, scale, damping = self._mass, np.ones(joints), self.robot.damping
        if mass is None:  # u = M a: unit inertias
            mass, damping = np.eye(joints)[None], np.zeros(joints)
        elif self._diagonal:
            scale = np.diagonal(mass, axis1=1, axis2=2)
        ratios = [
            stability_bound(mass, kp * scale, kd * scale, dt, filter_time=tau, damping=damping).ratio.max()
            for kp, kd, tau in zip(table.kp, table.kd, table.derivative_filter_time, strict=True)
        ]
        return 10 * np.maximum(np.array(ratios) - SAFE_RATIO, 0)


def _with_headroom(params: bp.PIDParams) -> bp.PIDParams:
    low, high = params.effort_min, params.effort_max
    return params.replace(
        effort_min=None if low is None else HEADROOM * low,
        effort_max=None if high is None else HEADROOM * high,
    )


def _read_history(path: Path | str | None, settings: dict[str, Any]) -> Sequence[Sequence[float]]:
    if path is None or not Path(path).exists():
        return []
    try:
        document = json.loads(Path(path).read_text())
        told = [[float(c) for c in row] for row in document["costs"]]
        theirs = document["settings"]
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidArgumentError(
            "history",
            f"is no history of a search: {error}",
            value=str(path),
            remedy="remove it, or name another file",
        ) from None
    ours = json.loads(json.dumps(settings))
    different = sorted(key for key in {*ours, *theirs} if ours.get(key) != theirs.get(key))
    if different or any(len(row) != settings["population"] for row in told):
        raise InvalidArgumentError(
            "history",
            f"is of another search ({', '.join(different)} differ)",
            value=str(path),
            remedy="use the same options, remove it, or name another file",
        )
    return told


def _write_history(path: Path | str | None, settings: dict[str, Any], costs: Sequence[Sequence[float]]) -> None:
    if path is not None:
        write_atomically(path, json.dumps({"settings": settings, "costs": [list(row) for row in costs]}))
