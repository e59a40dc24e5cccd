"""``batchpid compare``: sets of gains on the same moves, a table and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim.cli import flags

if TYPE_CHECKING:
    from sim import Robot
    from sim.tuning.evaluation import Evaluation
    from sim.tuning.gain_sets import GainSet


@dataclass(frozen=True)
class CompareCommand:
    """Compare sets of gains on the same seeded moves: settling, overshoot, final error and chatter of each."""

    robot: flags.RobotName = "panda"
    gains: flags.GainSets = ()
    moves: int = 20
    """Number of random moves, the tutorial's aside."""
    seed: int = 0
    """Seed of the moves; no search of `batchpid tune` with the same seed sees them."""
    seconds: flags.Seconds = 2.0
    variation: flags.Variation = False
    payload: flags.Payload = 2.0
    friction: flags.Friction = 0.1
    physics: flags.Physics = "accurate"
    workers: flags.Workers = None
    missing_meshes: flags.MissingMeshes = "error"
    picture: flags.OptionalPath = None
    """First two sets on the first move, to draw: .png or .svg."""

    def run(self) -> None:
        """Run the command."""
        from batchpid.errors import InvalidArgumentError
        from sim import Robot
        from sim.cli.report import evaluation_table
        from sim.plots.figures import FORMATS
        from sim.tuning.gain_sets import gain_set

        picture = flags.output_path("picture", self.picture, FORMATS)
        robot = Robot.load(self.robot, missing_meshes=self.missing_meshes)
        default = ("tuned", "tutorial", "drive") if robot.settings else ("designed", "drive")
        sets = [gain_set(robot, name) for name in self.gains or default]
        if picture is not None and len(sets) < 2:
            raise InvalidArgumentError("gains", "is one set", remedy="name two for a picture")
        evaluations = evaluate_sets(
            robot,
            sets,
            moves=self.moves,
            seed=self.seed,
            variation={"payload": self.payload, "friction": self.friction} if self.variation else None,
            seconds=self.seconds,
            workers=self.workers,
            physics=self.physics,
        )
        print(f"{robot.name}: {len(evaluations[0].moves.start)} moves, seed {self.seed}, {self.seconds:g} s each\n")
        print(evaluation_table(robot, evaluations))
        if picture is not None:
            print(f"\npicture: {draw_first_move(robot, evaluations, picture)}")


def evaluate_sets(
    robot: Robot, sets: Sequence[GainSet], *, moves: int, seed: int, variation: dict[str, Any] | None, **options: Any
) -> list[Evaluation]:
    """Evaluate ``sets`` on the tutorial's move and random ``moves`` that no search with ``seed`` sees.

    ``variation`` has options of :func:`sim.tuning.randomization.draw_variation`; ``options`` go to
    :func:`sim.tuning.evaluation.evaluate_gains`.
    """
    from sim.cli.progress import bar
    from sim.tuning.evaluation import evaluate_gains
    from sim.tuning.moves import random_moves, tutorial_move
    from sim.tuning.randomization import draw_variation

    seed += 1
    unseen = tutorial_move(robot) + random_moves(robot, moves, seed)
    drawn = None if variation is None else draw_variation(robot, len(unseen.start), seed, **variation)
    return [
        evaluate_gains(robot, each.params, unseen, name=each.name, control=each.control, variation=drawn, **options)
        for each in bar("comparing", unit="set")(sets)
    ]


def draw_first_move(robot: Robot, evaluations: Sequence[Evaluation], path: Path) -> Path:
    """Draw the first two ``evaluations`` on their first move to ``path``, and return it."""
    from sim import plots

    first, second = evaluations[:2]
    figure = plots.comparison(
        first.rollout.for_envs(slice(0, 1)),
        second.rollout.for_envs(slice(0, 1)),
        labels=(first.name, second.name),
        title=f"{robot.name}, {first.moves.names[0]} move",
    )
    return plots.save(figure, path)
