"""Evaluation of gains: a set of moves, each in a separate env, all at once, with metrics of every
joint.

A move is made in two ways: as a step of the setpoint, which shows how fast and how cleanly it is
approached, and as a minimum-jerk motion of the setpoint, with its rate, which shows how closely it
is followed. A comparison evaluates sets of gains on the same moves.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Float64, Progress, Rows
from batchpid.checks import file_path, number
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.metrics import StepMetrics, step_metrics
from batchpid.motors import DRIVEN
from batchpid.sim.diagnosis.causes import (
    absolute_band,
    cause_lines,
    joint_difference,
    median_and_worst,
    overshoot_of_settled,
    table,
)
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.options.groups import DEFAULT_ENGINE, EngineName
from batchpid.sim.randomization.checks import check_robot
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.robot import Robot
from batchpid.sim.rollout import Rollout
from batchpid.sim.runner.runner import Runner
from batchpid.sim.tuning.gain_sets import GainSet, default_sets, gain_set
from batchpid.sim.tuning.moves import (
    Moves,
    seeded_moves,
    shortest_durations,
    smooth_durations,
    smooth_variation,
)
from batchpid.trajectories import minimum_jerk

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMPARISON_HEADERS = (
    "gains",
    "settling",
    "following error",
    "overshoot",
    "final error",
    "chatter",
    "settled /\nin time",
)
COMPARISON_NOTES = """\
Median / worst over the arm's joints and all moves, made as steps of the setpoint. following error: largest
|qpos - setpoint| of a joint [rad or m] on the same moves as smooth motions, with setpoint rates. overshoot: of joints
that settled. chatter: variation of the effort over that of the smooth move. settled / in time: moves of which every
joint settled, within the run and within a second or 1.2 times the shortest that the effort limits allow."""
EVALUATION_SUBSTEPS = 5
"""Sim steps of a tick: an odd number, so that an effort that alternates from step to step shows in
the samples.
"""
SETTLE_SECONDS = 1.0
"""Time within which a move should settle [s]."""
SETTLE_SLACK = 1.2
"""Or within this multiple of the shortest time that the effort limits allow."""


class Evaluation(NamedTuple):
    """Performance of a set of gains on a set of moves; arrays are (moves, dof) unless said
    otherwise.
    """

    name: str
    moves: Moves
    rollout: Rollout
    metrics: StepMetrics
    chatter: Float64
    """Total variation of the effort, over the variation in a smooth (minimum-jerk) motion of the
    same duration.
    """
    settling_limit: Float64
    """Settling time asked for (moves,) [s]."""
    following_error: Float64
    """Largest error on the same moves as smooth motions [rad or m]: :func:`following_error`."""


def step_response_metrics(
    robot: Robot,
    rollout: Rollout,
    start: Rows,
) -> StepMetrics:
    """Return the metrics of a rollout from rest at ``start`` (envs, dof); inf for envs that
    diverged.

    Followers have the metrics of their leaders. Under control "drive" the metrics of efforts are
    undefined (NaN).
    """
    command = rollout.info.own_command
    if command is not None:
        problem = f"has setpoints of {', '.join(command.names)}, not of joints"
        remedy = "pass a run with joint setpoints"
        raise InvalidArgumentError("rollout", problem, remedy=remedy)
    has_effort = rollout.info.control != "drive"
    metrics = step_metrics(
        rollout.tick,
        rollout.setpoint,
        np.where(rollout.ok[..., None], rollout.qpos, np.nan),
        start=start,
        effort=rollout.effort if has_effort else None,
        saturated=rollout.saturated if has_effort else None,
        absolute_band=absolute_band(robot),
        continuous=robot.continuous,
    )
    return StepMetrics(*map(robot.coupling.of_leaders, metrics))


def following_error(robot: Robot, rollout: Rollout) -> Float64:
    """Return the largest |qpos - setpoint| at the ends of the ticks (envs, dof) [rad or m]; inf for
    envs that diverged.

    A setpoint and its rate hold at the end of their tick, so the error of an ideal loop is 0.
    Followers have the error of their leaders. The errors of continuous joints are modulo 2 pi.
    """
    size = np.abs(joint_difference(robot, rollout.qpos - rollout.setpoint))
    largest = np.where(rollout.ok[..., None], size, np.inf).max(0)
    errors: Float64 = robot.coupling.of_leaders(largest)
    return errors


def arm_joints(robot: Robot) -> NDArray[np.bool_]:
    """Return which joints belong to the arm (dof,): those that carry more than one leaf link, so no
    fingers.

    Followers do not count. A robot with fewer than three such joints (legs, a bare chain) is all
    arm.
    """
    # From each leaf link to the root, every joint carries that leaf.
    above = {joint.child_link: joint for joint in robot.tables.joints}
    leaves = Counter[str]()
    for link in set(above) - {joint.parent_link for joint in robot.tables.joints}:
        while link in above:
            leaves[above[link].name] += 1
            link = above[link].parent_link
    carries = np.array([leaves[name] > 1 for name in robot.joint_names])
    if carries.sum() < 3:
        return robot.independent
    return carries & robot.independent


def settling_limits(robot: Robot, moves: Moves) -> Float64:
    """Return the settling time asked for on each move (moves,) [s]: a second, or 1.2 times the
    shortest motion.
    """
    return np.maximum(SETTLE_SECONDS, SETTLE_SLACK * shortest_durations(robot, moves))


def load_randomization(path: str | Path | None, robot: Robot) -> Randomization | None:
    """Return the randomization in a YAML or JSON file, with seed 0 unless the file gives one; None
    without a file.

    Raises
    ------
    OSError
        The file cannot be read.
    InvalidArgumentError
        It is not a randomization, or does not fit the robot.
    """
    if path is None:
        return None
    path = file_path("randomize", path)
    document = documents.read(path)
    with documents.named(str(path)):
        if isinstance(document, dict):
            document = {"seed": 0, **document}
        randomization = Randomization.from_dict(document)
        check_robot(randomization, robot)
    return randomization


def reseeded(randomization: Randomization | None, seed: int) -> Randomization | None:
    """Return ``randomization`` with ``seed`` added to its seed, for other draws."""
    if randomization is None:
        return None
    return replace(randomization, seed=randomization.seed + seed)


def run_moves(
    runner: Runner,
    moves: Moves,
    seconds: float,
    *,
    streams: NDArray[np.int64] | None = None,
    durations: NDArray[np.float64] | None = None,
) -> tuple[Rollout, StepMetrics]:
    """Run ``moves``, one per env, from rest for ``seconds``, two ticks at least; return the rollout
    and its metrics.

    ``streams`` (moves,) are streams of the runner's randomization, by default one for each move, so
    that the draws are the same at every call. A move is a step of the setpoint, or, where
    ``durations`` (moves,) [s] are above 0, a minimum-jerk motion of that duration, or its
    beginning, with setpoint rates. Raises InvalidArgumentError if ``seconds`` are out of range.
    """
    seconds = number("seconds", seconds, 1e-6, 1e6, "simulated time, s")
    tick = runner.timestep * runner.substeps
    ticks = max(2, round(seconds / tick))
    start = moves.start
    # A randomization may move the start poses; without one they are exact.
    if runner.options.randomization is None:
        runner.reset(start)
    else:
        observation = runner.reset(start, seed=0 if streams is None else streams)
        start = observation.qpos.astype(np.float64)
    setpoints = np.broadcast_to(moves.target, (ticks, *moves.target.shape))
    rates = None
    if durations is not None:
        motion = minimum_jerk(
            start, moves.target, tick, duration=np.maximum(durations, tick)[:, None]
        )
        # The last row holds the target, at rest.
        rows = np.minimum(np.arange(ticks), motion.ticks - 1)
        is_smooth = durations[:, None] > 0
        setpoints = np.where(is_smooth, motion.position[rows], setpoints)
        rates = np.where(is_smooth, motion.velocity[rows], 0.0)
    rollout = runner.rollout(setpoints, setpoint_rates=rates)
    return rollout, step_response_metrics(runner.robot, rollout, start)


def evaluate_gains(
    robot: Robot,
    params: bp.PIDParams,
    moves: Moves,
    *,
    name: str = "gains",
    seconds: float = 2.0,
    **runner_options: Any,
) -> Evaluation:
    """Run ``moves`` from rest for ``seconds`` under ``params``, all at once, and return the metrics
    of every joint.

    ``params`` have one row for all moves, or one row per move; ``runner_options`` go to
    :class:`batchpid.sim.Runner`. The moves are made once more, as smooth motions of
    :func:`smooth_durations`, of which the first ``seconds`` are run, with setpoint rates.
    """
    options = {"substeps": EVALUATION_SUBSTEPS, **runner_options}
    with Runner(robot, len(moves.start), params=params, **options) as runner:
        rollout, metrics = run_moves(runner, moves, seconds)
        # The same moves as smooth motions, in the same scenes.
        motion, _ = run_moves(runner, moves, seconds, durations=smooth_durations(robot, moves))
    # The smooth motion to compare with takes as long as the slowest arm joint took to settle.
    settling = metrics.settling_time
    settled = np.where(np.isfinite(settling) & arm_joints(robot), settling, 0.0).max(1)
    shortest = shortest_durations(robot, moves)
    possible = np.where(np.isfinite(shortest), shortest, 0.0)
    durations = np.maximum(np.maximum(settled, possible), 0.1)
    return Evaluation(
        name=name,
        moves=moves,
        rollout=rollout,
        metrics=metrics,
        chatter=metrics.effort_variation / smooth_variation(robot, moves, durations),
        settling_limit=settling_limits(robot, moves),
        following_error=following_error(robot, motion),
    )


@dataclass(frozen=True, eq=False)
class Comparison:
    """Evaluations of sets of gains on the same moves; result of :func:`compare`."""

    robot: Robot
    evaluations: tuple[Evaluation, ...]
    """One for each set and engine; the engines of a set follow each other."""
    engines: tuple[EngineName, ...]

    def report(self) -> str:
        """Return a table of the sets, the causes for which moves did not settle, and with two
        engines the largest differences between them.
        """
        robot = self.robot
        # Fingers need not settle: the figures are those of the arm.
        names = {None, *np.array(robot.joint_names)[arm_joints(robot)]}
        lines = [
            table(
                [self._row(evaluation) for evaluation in self.evaluations],
                COMPARISON_HEADERS,
                "lrrrrrr",
            ),
            COMPARISON_NOTES,
        ]
        for evaluation in self.evaluations:
            findings = evaluation.rollout.findings(robot)
            causes = [cause for cause in findings if cause.joint in names]
            if causes:
                lines += [f"\nNot settled under {evaluation.name} (each env makes one move):"]
                lines += cause_lines(causes)
        if len(self.engines) == 2:
            lines.append("\nLargest difference of a position between the engines:")
            pairs = zip(self.evaluations[::2], self.evaluations[1::2], strict=True)
            lines += [self._difference(*pair) for pair in pairs]
        return "\n".join(lines)

    def figure(self) -> Figure:
        """Draw the first two evaluations on their first move."""
        from batchpid.sim import plots

        shown = self.evaluations[:2]
        runs = [evaluation.rollout.for_envs(slice(0, 1)) for evaluation in shown]
        labels = [evaluation.name for evaluation in shown]
        title = f"{self.robot.name}, {shown[0].moves.names[0]} move"
        return plots.step_responses(*runs, labels=labels, title=title)

    def _row(self, evaluation: Evaluation) -> list[str]:
        """Return the row of an evaluation in the table."""
        arm = arm_joints(self.robot)
        metrics = evaluation.metrics
        settling = metrics.settling_time[:, arm]
        settled = np.isfinite(settling).all(1).sum()
        # A joint without a move has no settling time, and is in time.
        slowest = np.nan_to_num(settling, nan=0.0, posinf=np.inf).max(1)
        in_time = (slowest <= evaluation.settling_limit).sum()
        return [
            evaluation.name,
            median_and_worst(settling, "{:.2f} s"),
            median_and_worst(evaluation.following_error[:, arm].max(1), "{:.2g}"),
            median_and_worst(overshoot_of_settled(metrics.overshoot[:, arm], settling), "{:.1%}"),
            median_and_worst(metrics.steady_state_error[:, arm], "{:.1e}"),
            median_and_worst(evaluation.chatter[:, arm], "{:.1f}"),
            f"{settled} / {in_time} of {len(settling)}",
        ]

    def _difference(self, first: Evaluation, second: Evaluation) -> str:
        """Return a line with the largest difference of a position between two evaluations."""
        difference = np.abs(first.rollout.qpos - second.rollout.qpos)
        largest = np.nan_to_num(difference, nan=np.inf).max(0)
        move, joint = np.unravel_index(int(largest.argmax()), largest.shape)
        place = f"joint {self.robot.joint_names[joint]!r}, move {first.moves.names[move]!r}"
        unit = self.robot.units[joint]
        return f"  {first.name} / {second.name}: {largest.max():.1e} {unit} ({place})"


def compare(
    robot: Robot,
    gains: tuple[str, ...] | Sequence[GainSet] = (),
    moves: int = 20,
    seed: int = 0,
    seconds: float = 2.0,
    engine: tuple[EngineName, ...] | EngineName | None = None,
    randomization: Randomization | None = None,
    workers: int | None = None,
    progress: Progress[tuple[GainSet, EngineName]] | None = None,
    **runner_options: Any,
) -> Comparison:
    """Compare sets of gains on the same seeded moves: settling, overshoot, final error and chatter
    of each.

    In two engines every set runs in both, on the same moves, and the report has the largest
    difference of their motions.

    Parameters
    ----------
    gains
        Sets of gains: tuned, designed, sapien-tutorial, mjcf, drive, params files (.yaml) that
        `batchpid tune` or batchpid.save_params wrote. Default:
        tuned, sapien-tutorial and drive for a bundled robot, else designed and drive.
    moves
        Number of random moves, the tutorial's aside.
    seed
        Seed of the moves; no search of `batchpid tune` with the same seed sees them.
    seconds
        Simulated time of each move [s].
    engine
        Physics engines, separated by a space: sapien, mujoco or both. Default: mujoco.
    randomization
        Draw the robot of each move: a YAML file (docs/randomization.md), e.g. `payload: {uniform:
        [0, 0.5]}`.
    workers
        Processes that step the scenes; 0: this one. Default: one per available core.
    progress
        Wraps the sets, e.g. ``tqdm.tqdm``.
    runner_options
        More options of :class:`batchpid.sim.Runner`.

    Raises
    ------
    InvalidArgumentError
        A set of gains is unknown.
    """
    if isinstance(engine, str):
        engine = (engine,)
    # The flag without a word is an empty tuple.
    engine = engine or (DEFAULT_ENGINE,)
    titles = {name: load_engine(name).title for name in engine}
    named = gains or default_sets(robot)
    sets = [gain_set(robot, entry) if isinstance(entry, str) else entry for entry in named]
    # The search of the same seed has other moves and other draws.
    unseen = seeded_moves(robot, moves, seed + 1)
    draws = reseeded(randomization, seed + 1)
    # Drives know friction and inertia, and no other actuators.
    drawn_drives = draws
    if draws is not None:
        kinds = {name: draw for name, draw in draws.actuators.items() if name in DRIVEN}
        drawn_drives = replace(draws, actuators=kinds)
    pairs = list(product(sets, titles))
    evaluations = []
    for chosen, name in pairs if progress is None else progress(pairs):
        evaluation = evaluate_gains(
            robot,
            chosen.params,
            unseen,
            name=chosen.name if len(titles) == 1 else f"{chosen.name}, {titles[name]}",
            seconds=seconds,
            control=chosen.control,
            randomization=drawn_drives if chosen.control == "drive" else draws,
            engine=name,
            workers=workers,
            **runner_options,
        )
        evaluations.append(evaluation)
    return Comparison(robot, tuple(evaluations), tuple(titles))
