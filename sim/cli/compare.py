"""``batchpid compare``: sets of gains on the same moves, in one engine or in both."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import OutputFiles, write_figures
from batchpid.sim.options.groups import DEFAULT_ENGINE
from batchpid.sim.tuning.gain_sets import gain_set

RUNNER = flags.runner_flags(*flags.SCENE_FLAGS, "workers")


@dataclass(frozen=True)
class CompareCommand:
    """Compare sets of gains on the same seeded moves: settling, overshoot, final error and chatter
    of each.

    With `--engine sapien mujoco` every set runs in both engines, on the same moves, and the largest
    difference of their motions is printed.
    """

    robot: flags.RobotName = "panda"
    gains: flags.GainSets = ()
    moves: Annotated[int, Field(high=100_000)] = 20
    """Number of random moves, the tutorial's aside."""
    seed: flags.Seed = 0
    """Seed of the moves; no search of `batchpid tune` with the same seed sees them."""
    seconds: flags.Seconds = 2.0
    randomize: flags.Randomize = None
    engine: flags.Engines = (DEFAULT_ENGINE,)
    runner: Annotated[flags.RunnerFlags, flags.group(RUNNER)] = field(default_factory=RUNNER)
    actuators: flags.Actuators = None
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    picture: flags.OptionalPath = None
    """First two rows of the table on the first move, to draw: .png or .svg."""
    json: flags.Json = None
    force: flags.Force = False

    imports = ("batchpid.sim.plots", "batchpid.sim.runner.runner")

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim import plots
        from batchpid.sim.cli.report import draw_first_move, evaluation_table, motion_difference
        from batchpid.sim.cli.run import evaluate_sets
        from batchpid.sim.tuning.randomization_files import load_randomization

        outputs = OutputFiles(self)
        picture = outputs.path("picture", self.picture, plots.FORMATS)
        json = outputs.path("json", self.json, (".json",))
        robot = Robot.load(self.robot, actuators=self.actuators, **vars(self.meshes))
        default = ("tuned", "tutorial", "drive") if robot.settings else ("designed", "drive")
        sets = [gain_set(robot, name) for name in self.gains or default]
        if not self.engine:
            raise InvalidArgumentError("engine", "is missing", remedy="name sapien, mujoco or both")
        if picture is not None and len(sets) * len(set(self.engine)) < 2:
            raise InvalidArgumentError(
                "gains", "names a single set", remedy="name two, or two engines, for a picture"
            )
        if not self.moves and robot.settings is None:
            remedy = "use 1 or more: the robot has no move of a tutorial"
            raise InvalidArgumentError("moves", "leaves none", value=self.moves, remedy=remedy)
        randomization = (
            None if self.randomize is None else load_randomization(self.randomize, robot)
        )
        options = flags.chosen(self, "moves seed seconds") | self.runner.options()
        evaluations = evaluate_sets(
            robot, sets, randomization=randomization, engines=self.engine, **options
        )
        print(
            f"{robot.name}: {len(evaluations[0].moves.start)} moves, seed {self.seed},"
            f" {self.seconds:g} s each\n"
        )
        print(evaluation_table(robot, evaluations))
        if len(set(self.engine)) == 2:
            print("\nLargest difference of a position between the engines:")
            for first, second in zip(evaluations[::2], evaluations[1::2], strict=True):
                print(motion_difference(robot, first, second))
        if json is not None:
            arrays = "metrics chatter settling_limit following_error"
            figures = {
                evaluation.name: {name: getattr(evaluation, name) for name in arrays.split()}
                for evaluation in evaluations
            }
            write_figures(
                json,
                {
                    "joints": robot.joint_names,
                    "moves": evaluations[0].moves.names,
                    "gains": figures,
                },
            )
            print(f"\nfigures: {json}")
        if picture is not None:
            print(f"\npicture: {draw_first_move(robot, evaluations, picture)}")
