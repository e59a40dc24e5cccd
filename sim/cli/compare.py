"""``batchpid compare``: sets of gains on the same moves, a table and a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from sim.cli.optional import OptionalInt, OptionalPath


@dataclass(frozen=True)
class Compare:
    """Gain sets on the same seeded moves: settling, overshoot, final error and chatter of each."""

    gains: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[GAINS ...]")] = (
        "tuned",
        "tutorial",
        "drive",
    )
    """Params files, or: tutorial, tuned, designed, drive, drive:STIFFNESS,DAMPING."""
    robot: str = "panda"
    """A bundled robot, or the path of a URDF."""
    moves: int = 20
    """Random moves, beside the tutorial's."""
    seed: int = 1
    """Of the moves."""
    seconds: float = 2.0
    """Simulated time of each move [s]."""
    workers: OptionalInt = None
    """Processes; 0: this one. Default: one for each available core."""
    physics: Literal["accurate", "fast"] = "accurate"
    """Solver settings."""
    variation: bool = False
    """Payload, friction, coarse sensors and late efforts, drawn for each move."""
    payload: float = 2.0
    """With variation: the largest payload [kg], less where the robot does not carry it."""
    friction: float = 0.1
    """With variation: the largest joint friction (PhysX's coefficient)."""
    missing_meshes: Literal["error", "skip"] = "error"
    """Go on without collision shapes whose mesh is missing."""
    picture: OptionalPath = None
    """The first two sets on the first move: .png or .svg."""

    def run(self) -> None:
        """Run it."""
        from batchpid.errors import InvalidArgumentError
        from sim import Robot, plots
        from sim.cli.progress import bar
        from sim.cli.report import evaluation_table
        from sim.tuning.evaluation import evaluate_gains
        from sim.tuning.gain_sets import gain_set
        from sim.tuning.moves import random_moves, tutorial_move
        from sim.tuning.randomization import draw_variation

        if self.picture is not None:
            plots.check_path(self.picture)
            if len(self.gains) < 2:
                raise InvalidArgumentError("gains", "is one set", remedy="name two for a picture")
        robot = Robot.load(self.robot, missing_meshes=self.missing_meshes)
        sets = [gain_set(robot, name) for name in self.gains]
        moves = tutorial_move(robot) + random_moves(robot, self.moves, self.seed)
        drawn = None
        if self.variation:
            drawn = draw_variation(robot, len(moves.start), self.seed, payload=self.payload, friction=self.friction)
        evaluations = [
            evaluate_gains(
                robot,
                each.params,
                moves,
                name=each.name,
                control=each.control,
                seconds=self.seconds,
                workers=self.workers,
                physics=self.physics,
                variation=drawn,
            )
            for each in bar("comparing", unit="set")(sets)
        ]
        print(f"{robot.name}: {len(moves.start)} moves, seed {self.seed}, {self.seconds:g} s each\n")
        print(evaluation_table(robot, evaluations))
        if self.picture is not None:
            first, second = (
                plots.Traces.of(evaluation.rollout.for_envs(slice(0, 1)), robot, evaluation.name)
                for evaluation in evaluations[:2]
            )
            title = f"{robot.name}, {moves.names[0]} move"
            print(f"\npicture: {plots.save(plots.comparison(first, second, title=title), self.picture)}")
