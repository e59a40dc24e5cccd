"""Comparison of sets of gains on the same moves: as a table, as figures and as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from batchpid.arrays.array_types import Progress
from batchpid.motors import DRIVEN
from batchpid.sim.diagnosis.text import cause_lines, median_and_worst, overshoot_of_settled, table
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.options.groups import DEFAULT_ENGINE, EngineName
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tuning.evaluation import (
    Evaluation,
    arm_joints,
    evaluate_gains,
    reseeded,
)
from batchpid.sim.tuning.gain_sets import GainSet, default_sets, gain_set
from batchpid.sim.tuning.moves import random_moves, tutorial_move

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
        title = f"{self.robot.name}, {shown[0].moves.names[0]} move"
        if len(runs) == 1:
            return plots.step_responses(runs[0], title=title)
        return plots.comparison(*runs, labels=(shown[0].name, shown[1].name), title=title)

    def _row(self, evaluation: Evaluation) -> list[str]:
        """Return the row of an evaluation in the table."""
        arm = arm_joints(self.robot)
        metrics = evaluation.metrics
        error = evaluation.following_error
        settling = metrics.settling_time[:, arm]
        settled = np.isfinite(settling).all(1).sum()
        # A joint without a move has no settling time, and is in time.
        slowest = np.nan_to_num(settling, nan=0.0, posinf=np.inf).max(1)
        in_time = (slowest <= evaluation.settling_limit).sum()
        return [
            evaluation.name,
            median_and_worst(settling, "{:.2f} s"),
            "-" if error is None else median_and_worst(error[:, arm].max(1), "{:.2g}"),
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
        Sets of gains: tuned, designed, sapien-tutorial, mjcf, drive, drive:STIFFNESS,DAMPING,
        params files (.yaml or .json) that `batchpid tune` or batchpid.save_params wrote. Default:
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
    unseen = tutorial_move(robot) + random_moves(robot, moves, seed + 1)
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
            follow=True,
            control=chosen.control,
            randomization=drawn_drives if chosen.control == "drive" else draws,
            engine=name,
            workers=workers,
            **runner_options,
        )
        evaluations.append(evaluation)
    return Comparison(robot, tuple(evaluations), tuple(titles))
