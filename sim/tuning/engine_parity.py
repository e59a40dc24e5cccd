"""Comparison of two physics engines on one robot: from its dynamics to moves under gains and a push on the ground."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64, Rows
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.engine.robot_model import robot_model
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner import Runner
from batchpid.sim.tuning.evaluation import SUBSTEPS, Evaluation, evaluate_gains
from batchpid.sim.tuning.moves import random_moves
from batchpid.sim.workers.contact_log import MissedContactWarning

ENGINES = ("sapien", "mujoco")
"""The reference, and the engine that is compared with it."""
POSES, ENVS, OPEN_SECONDS, ACCELERATION = 100, 8, 0.5, {"rad": 5.0, "m": 0.1}
"""Random states; envs, length [s] and accelerations [rad/s^2, m/s^2] of the motion under equal efforts."""
PUSHES, DEPTH, PUSH_SECONDS = 4, 0.02, 1.0
"""Pushes on the ground, the depth [m] of their setpoints in it, and their length [s]."""
_NEAR = 1e-3
"""Distance from a joint limit at which an env counts as having reached it [rad or m]."""
DYNAMICS_TOLERANCE, MOTION_TOLERANCE, SETTLING_TOLERANCE = 1e-4, 1e-3, 0.05
"""Differences that a verdict calls none: relative [1]; under gains [rad or m]; of settling times, relative."""


class Parity(NamedTuple):
    """Differences of MuJoCo from SAPIEN on one robot. Positions are in rad or m."""

    bias: float
    """Largest difference of gravity, Coriolis and centrifugal efforts at random states, relative to the largest."""
    first_tick: float
    """Largest difference of a velocity 5 sim steps after rest, under equal efforts, relative to the largest."""
    time: Float64
    """Times of the open-loop motion (ticks,) [s]."""
    open_loop: Float64
    """Largest difference of a position up to then, under equal efforts (ticks,); NaN if all envs began at limits."""
    chaos: Float64
    """The same between two runs in SAPIEN whose starts differ by one bit of a float32 (ticks,)."""
    first_chaos: float
    """``first_tick`` between these two runs."""
    moves: tuple[Evaluation, Evaluation]
    """Moves under the gains in each engine."""
    push: Float64 | None
    """Largest difference of a position at the end of each push on the ground (pushes,); None without a ground."""

    @property
    def closed_loop(self) -> Float64:
        """Largest difference of a position on each move (moves,)."""
        first, second = (each.rollout.qpos for each in self.moves)
        return np.nan_to_num(np.abs(first - second).max((0, 2)), nan=np.inf).astype(np.float64)

    @property
    def settled(self) -> tuple[int, int]:
        """Number of moves in which every joint settled, in each engine."""
        first, second = (int(np.isfinite(_settling(each)).sum()) for each in self.moves)
        return first, second

    @property
    def settling(self) -> Float64:
        """Settling time of each move in each engine (2, moves) [s]; inf where a joint does not settle."""
        return np.array([_settling(each) for each in self.moves])

    def verdict(self) -> list[str]:
        """Return the meaning of the figures, one sentence each."""
        said = []
        if self.bias < DYNAMICS_TOLERANCE:
            said.append("Both engines simulate the same robot: masses, inertias and joints agree.")
        else:
            said.append("The engines do NOT simulate the same robot: compare masses, inertias and joints first.")
        apart = np.flatnonzero(self.open_loop > np.maximum(MOTION_TOLERANCE, 10 * self.chaos))
        if np.isnan(self.open_loop).any():
            said.append("Under equal efforts NOTHING was compared: every env began at a joint limit.")
        elif not len(apart):
            said.append("Under equal efforts they part no faster than rounding explains.")
        else:
            said.append(
                f"Under equal efforts they part after {self.time[apart[0]]:.2f} s by more than rounding explains."
            )
        worst, times = float(self.closed_loop.max()), self.settling
        finite = np.isfinite(times).all(0)
        same = self.settled[0] == self.settled[1] and (np.isfinite(times[0]) == np.isfinite(times[1])).all()
        slower = np.abs(np.diff(times[:, finite], axis=0) / times[0, finite]).max(initial=0.0)
        if worst < MOTION_TOLERANCE and same and slower < SETTLING_TOLERANCE:
            said.append("Gains that are good in one engine are good in the other: moves agree.")
        else:
            said.append("Moves under the gains DIFFER: do not rely on results of one engine alone.")
        if self.push is not None and self.push.max() > MOTION_TOLERANCE:
            said.append("In contact positions differ: contacts of the two engines yield and slide differently.")
        elif self.push is not None:
            said.append("In contact positions agree.")
        return said


def _settling(evaluation: Evaluation) -> Float64:
    times = evaluation.metrics.settling_time
    return np.nan_to_num(times, nan=0.0, posinf=np.inf).max(1)  # NaN: a joint that did not move


def compare_engines(
    robot: Robot,
    params: bp.PIDParams | None = None,
    *,
    moves: int = 8,
    seconds: float = 2.0,
    seed: int = 0,
    workers: int | None = None,
) -> Parity:
    """Compare SAPIEN and MuJoCo on ``robot``, under ``params`` (default as in :class:`batchpid.sim.Runner`).

    Parameters
    ----------
    moves, seconds, seed
        Number of random moves, their length [s] and their seed.
    workers
        Of every :class:`batchpid.sim.Runner`.

    Raises
    ------
    MissingDependencyError
        MuJoCo is not installed.
    InvalidArgumentError
        The params do not fit the robot, or there are no such moves.
    """
    drawn = random_moves(robot, moves, seed)
    bias = _dynamics(robot, seed)
    time, open_loop, chaos, firsts = _open_loop(robot, random_moves(robot, ENVS, seed + 1).start, seed, workers)
    first, second = (
        evaluate_gains(
            robot, _params(robot, params), drawn, name=engine, seconds=seconds, engine=engine, workers=workers
        )
        for engine in ENGINES
    )
    pushed = _push(robot, params, seed, workers)
    return Parity(bias, firsts[0], time, open_loop, chaos, firsts[1], (first, second), pushed)


def _params(robot: Robot, params: bp.PIDParams | None) -> bp.PIDParams:
    if params is not None:
        return params
    return robot.tuned() if robot.has_tuned else robot.designed()


def _dynamics(robot: Robot, seed: int) -> float:
    """Return the largest relative difference of the passive forces that the engines compute themselves."""
    qpos = robot.sample(POSES, seed=seed)
    qvel = np.random.default_rng(seed).uniform(-1, 1, qpos.shape)
    forces = []
    for name in ENGINES:
        engine = load_engine(name)
        options: Document = {"ground": False, "merge_fixed": robot.merge_fixed, "engine": name}
        spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, engine.physics["fast"], **options)
        pack = engine.make_pack(spec, 1)
        found = []
        for position, velocity in zip(qpos, qvel, strict=True):
            pack.write_state([0], position[None], velocity[None])
            found.append(pack.passive_force(True, True)[0])
        pack.close()
        forces.append(np.array(found))
    return _relative(*forces)


def _relative(reference: Rows, other: Rows) -> float:
    return float(np.abs(reference - other).max() / max(np.abs(reference).max(), 1e-300))


def _open_loop(
    robot: Robot, start: Float64, seed: int, workers: int | None
) -> tuple[Float64, Float64, Float64, list[float]]:
    """Return times, differences of the engines, and of two runs in SAPIEN; and both differences after one tick.

    The efforts give sinusoidal accelerations at the start poses. Once an env reaches a joint limit it is left out.
    """
    tick = SUBSTEPS / 2000
    ticks, rng = np.arange(1, round(OPEN_SECONDS / tick) + 1), np.random.default_rng(seed)
    time = (tick * ticks).astype(np.float64)
    frequency, phase = rng.uniform(0.5, 2.0, (2, len(start), robot.dof))
    wave = np.sin(2 * np.pi * (frequency * time[:, None, None] + phase)) * [ACCELERATION[unit] for unit in robot.units]
    efforts = (robot.dynamics().mass_matrix(start) @ wave[..., None])[..., 0]
    runs = []
    for engine, qpos in ((ENGINES[0], start), (ENGINES[1], start), (ENGINES[0], _next_float32(start))):
        options: Document = {"engine": engine, "control": "effort", "substeps": SUBSTEPS, "compensate": "gravity"}
        options["workers"] = workers
        options |= {"collisions": False} if robot.fixed_base else {"ground": False}
        with Runner(robot, len(start), **options) as runner, warnings.catch_warnings():
            warnings.simplefilter("ignore", MissedContactWarning)
            runner.reset(qpos)
            runs.append(runner.rollout(efforts))
    within = (runs[0].qpos > robot.lower + _NEAR) & (runs[0].qpos < robot.upper - _NEAR)
    within |= robot.upper - robot.lower <= 4 * _NEAR  # a joint that is held counts from the start
    free = np.logical_and.accumulate(within.all(2))[..., None]
    apart = [np.maximum.accumulate(np.where(free, np.abs(runs[0].qpos - run.qpos), 0).max((1, 2))) for run in runs[1:]]
    open_loop, chaos = (np.nan_to_num(each, nan=np.inf).astype(np.float64) for each in apart)
    if not free[0].any():
        open_loop = np.full_like(open_loop, np.nan)
    return time, open_loop, chaos, [_relative(runs[0].qvel[0], run.qvel[0]) for run in runs[1:]]


def _next_float32(qpos: Float64) -> Float64:
    return np.nextafter(qpos.astype(np.float32), np.float32(np.inf)).astype(np.float64)


def _push(robot: Robot, params: bp.PIDParams | None, seed: int, workers: int | None) -> Float64 | None:
    """Return the largest difference of a position after each push on the ground; None if no pose reaches it."""
    if not (robot.has_ground and robot.fixed_base):
        return None
    model = robot_model(robot, True)
    poses = robot.sample(400, seed=seed + 2)
    low = [pose for pose in poses if -10 * DEPTH < model.height(pose) < -DEPTH][:PUSHES]
    if not low:
        return None
    ends = []
    for engine in ENGINES:
        options: Document = {"engine": engine, "ground": True, "workers": workers}
        with Runner(robot, len(low), params=_params(robot, params), **options) as runner:
            runner.reset()
            ticks = round(PUSH_SECONDS / (runner.timestep * runner.substeps))
            ends.append(runner.rollout(np.broadcast_to(low, (ticks, *np.shape(low)))).qpos[-1])
    return np.nan_to_num(np.abs(ends[0] - ends[1]).max(1), nan=np.inf).astype(np.float64)
