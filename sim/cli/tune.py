"""``batchpid tune``: gains that settle, found by simulation."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

import batchpid as bp
from batchpid.arrays.array_types import Document
from batchpid.arrays.field_tables import Field
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import FOLDER, OutputFiles, bar, beside
from batchpid.sim.tuning.cost import Weights
from batchpid.sim.tuning.gain_sets import GainSet

RUNNER = flags.runner_flags("engine", "workers", "cluster", *flags.SCENE_FLAGS)


@dataclass(frozen=True)
class TuneCommand:
    """Tune the gains of any robot: design them from its inertia, then search by CMA-ES on simulated
    moves.

    Ends with a table of the gains before and after, on moves that the search did not see, and
    writes the better params.
    """

    robot: flags.RobotName = "panda"
    generations: Annotated[int, Field(low=1, high=100_000)] = 10
    """Number of populations that the search evaluates."""
    population: Annotated[int, Field(low=4, high=1000)] = 8
    """Candidates of a population, evaluated at once."""
    seed: flags.Seed = 0
    """Seed of the search and its moves. The result does not depend on the number of workers."""
    seconds: flags.MoveSeconds = 1.5
    """Simulated time of each move of the search [s]."""
    gain_units: Literal["mass_matrix", "effort"] = "mass_matrix"
    """Gains per mass matrix (all joints respond equally fast), or as efforts (for any
    controller).
    """
    per_joint: flags.Switch = False
    """Search for a factor of each joint too; needs more generations."""
    weights: Annotated[Weights, tyro.conf.arg(name="")] = field(default_factory=Weights)
    randomize: flags.Randomize = None
    runner: Annotated[flags.RunnerFlags, flags.group(RUNNER)] = field(default_factory=RUNNER)
    time_limit: flags.TimeLimit = None
    actuators: flags.Actuators = None
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    out: flags.OptionalPath = None
    """Params file to write: .yaml or .json. Default: out/ROBOT.tuned.yaml."""
    picture: flags.OptionalPath = None
    """Before and after on the first move, to draw: .png or .svg. Default: NAME-tune.png, next to
    the params file.
    """
    force: flags.Force = False

    imports = ("batchpid.sim.plots", "batchpid.sim.tuning.search")

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim import plots
        from batchpid.sim.cli.report import draw_first_move, evaluation_table
        from batchpid.sim.cli.run import evaluate_sets
        from batchpid.sim.tuning.evaluation import arm_joints
        from batchpid.sim.tuning.randomization_files import load_randomization
        from batchpid.sim.tuning.search import tune

        outputs, named = OutputFiles(self), FOLDER / Path(self.robot).stem
        out = outputs.path(
            "out", self.out or named.with_suffix(".tuned.yaml"), (".yaml", ".yml", ".json")
        )
        picture = outputs.path(
            "picture", self.picture or beside(self.out or named, "tune"), plots.FORMATS
        )
        robot = Robot.load(self.robot, actuators=self.actuators, **vars(self.meshes))
        randomization = (
            None if self.randomize is None else load_randomization(self.randomize, robot)
        )
        options: Document = {
            "randomization": randomization,
            "seed": self.seed,
        } | self.runner.options()
        searched = flags.chosen(
            self, "generations population seconds gain_units per_joint weights time_limit"
        )
        result = tune(robot, progress=bar("tuning", unit="generation"), **searched, **options)
        print(
            f"{robot.name}: cost {result.start_cost:.4f} as designed, {result.cost:.4f} as tuned;"
            f" weight of the settling time {self.weights.settling:g}, of the following error"
            f" {self.weights.following:g}\n"
        )

        # The gains are judged on moves that the search did not see.
        sets = GainSet("designed", result.start_params), GainSet("tuned", result.params)
        evaluations = evaluate_sets(
            robot, sets, moves=20, engines=(options.pop("engine"),), **options
        )
        print(evaluation_table(robot, evaluations))
        arm = arm_joints(robot)
        rejected = result.rejected or evaluations[1].drawback(evaluations[0], arm)
        if rejected:
            print(f"\nThe designed gains are written, the tuned ones are rejected: {rejected}.")
        chosen = 0 if rejected else 1
        about = {"cost": result.cost, "start_cost": result.start_cost, "gains": sets[chosen].name}
        about |= {"rejected": rejected} if rejected else {}
        bp.save_params(out, sets[chosen].params, robot.joint_names, result.settings | about)
        print(f"\nwritten: {out}\npicture: {draw_first_move(robot, evaluations, picture)}")
        for shortfall in evaluations[chosen].shortfalls(arm)[:5]:
            print(f"SHORT of the usual demands: {shortfall}")
        motors = [] if self.actuators is None else ["--actuators", str(self.actuators)]
        print(
            "next:", shlex.join(["batchpid", "rollout", self.robot, "--gains", str(out), *motors])
        )
