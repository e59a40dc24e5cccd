"""``batchpid compare`` and ``batchpid parity``: sets of gains on the same moves, and one robot in both engines."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import OutputFiles, write_figures
from batchpid.sim.runner_keywords import DEFAULT_ENGINE
from batchpid.sim.tuning.gain_sets import gain_set

RUNNER = flags.runner_flags(*flags.SCENE_FLAGS, "workers")


@dataclass(frozen=True)
class CompareCommand:
    """Compare sets of gains on the same seeded moves: settling, overshoot, final error and chatter of each.

    With `--engine sapien mujoco` every set runs in both engines, on the same moves.
    """

    robot: flags.RobotName = "panda"
    gains: flags.GainSets = ()
    moves: Annotated[int, Field(high=100_000)] = 20
    """Number of random moves, the tutorial's aside."""
    seed: flags.Seed = 0
    """Seed of the moves; no search of `batchpid tune` with the same seed sees them."""
    seconds: flags.Seconds = 2.0
    randomize: flags.Randomize = None
    variation: flags.Variation = False
    payload: flags.Payload = 2.0
    friction: flags.Friction = 0.1
    engine: flags.Engines = (DEFAULT_ENGINE,)
    runner: Annotated[flags.RunnerFlags, flags.group(RUNNER)] = field(default_factory=RUNNER)
    actuators: flags.Actuators = None
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    picture: flags.OptionalPath = None
    """First two rows of the table on the first move, to draw: .png or .svg."""
    json: flags.Json = None
    force: flags.Force = False

    imports = ("batchpid.sim.plots", "batchpid.sim.runner")

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim import plots
        from batchpid.sim.cli.report import draw_first_move, evaluation_table
        from batchpid.sim.cli.run import evaluate_sets, read_variation

        outputs = OutputFiles(force=self.force)
        picture = outputs.path("picture", self.picture, plots.FORMATS)
        json = outputs.path("json", self.json, (".json",))
        robot = Robot.load(self.robot, actuators=self.actuators, **vars(self.meshes))
        default = ("tuned", "tutorial", "drive") if robot.settings else ("designed", "drive")
        sets = [gain_set(robot, name) for name in self.gains or default]
        if not self.engine:
            raise InvalidArgumentError("engine", "is missing", remedy="name sapien, mujoco or both")
        if picture is not None and len(sets) * len(set(self.engine)) < 2:
            raise InvalidArgumentError("gains", "names a single set", remedy="name two, or two engines, for a picture")
        if not self.moves and robot.settings is None:
            remedy = "use 1 or more: the robot has no move of a tutorial"
            raise InvalidArgumentError("moves", "leaves none", value=self.moves, remedy=remedy)
        robot, randomization = read_variation(robot, self.randomize, flags.variation(self))
        options = flags.chosen(self, "moves seed seconds") | self.runner.options()
        evaluations = evaluate_sets(robot, sets, randomization=randomization, engines=self.engine, **options)
        print(f"{robot.name}: {len(evaluations[0].moves.start)} moves, seed {self.seed}, {self.seconds:g} s each\n")
        print(evaluation_table(robot, evaluations))
        if json is not None:
            arrays = "metrics chatter settling_limit following_error"
            figures = {each.name: {name: getattr(each, name) for name in arrays.split()} for each in evaluations}
            write_figures(json, {"joints": robot.joint_names, "moves": evaluations[0].moves.names, "gains": figures})
            print(f"\nfigures: {json}")
        if picture is not None:
            print(f"\npicture: {draw_first_move(robot, evaluations, picture)}")


@dataclass(frozen=True)
class ParityCommand:
    """Compare SAPIEN and MuJoCo on one robot: dynamics, motion under equal efforts and gains, contact."""

    robot: flags.RobotName = "panda"
    gains: flags.Gains = None
    moves: Annotated[int, Field(low=1, high=100_000)] = 8
    """Number of random moves under the gains."""
    seed: flags.Seed = 0
    """Seed of states, efforts and moves."""
    seconds: flags.Seconds = 2.0
    workers: flags.Workers = None
    actuators: flags.Actuators = None
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    picture: flags.OptionalPath = None
    """Differences over time, to draw: .png or .svg."""
    json: flags.Json = None
    force: flags.Force = False

    imports = ("batchpid.sim.plots", "batchpid.sim.runner")

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim import plots
        from batchpid.sim.cli.report import table
        from batchpid.sim.plots.figures import engine_differences
        from batchpid.sim.tuning.engine_parity import compare_engines

        outputs = OutputFiles(force=self.force)
        picture = outputs.path("picture", self.picture, plots.FORMATS)
        json_path = outputs.path("json", self.json, (".json",))
        robot = Robot.load(self.robot, actuators=self.actuators, **vars(self.meshes))
        gains = gain_set(robot, self.gains)
        found = compare_engines(
            robot, gains.params, moves=self.moves, seconds=self.seconds, seed=self.seed, workers=self.workers
        )
        worst, settling = float(found.closed_loop.max()), np.median(found.settling, axis=1)
        rows = [
            ["gravity and Coriolis efforts, 100 random states", f"{found.bias:.1e}", "relative"],
            ["velocity after 5 sim steps", f"{found.first_tick:.1e}", "relative"],
            ["  two starts one bit apart, in SAPIEN", f"{found.first_chaos:.1e}", "relative"],
            [f"equal efforts for {found.time[-1]:g} s", f"{found.open_loop[-1]:.1e}", "rad or m"],
            ["  two starts one bit apart, in SAPIEN", f"{found.chaos[-1]:.1e}", "rad or m"],
            [f"equal gains ({gains.name}), {len(found.closed_loop)} moves", f"{worst:.1e}", "rad or m"],
            ["  settling time, median", " / ".join(f"{each:.2f}" for each in settling), "s, sapien / mujoco"],
            ["  moves that settled", " / ".join(map(str, found.settled)), "sapien / mujoco"],
        ]
        if found.push is not None:
            rows.append([f"{len(found.push)} pushes on the ground", f"{found.push.max():.1e}", "rad or m"])
        print(f"{robot.name}: MuJoCo compared with SAPIEN\n")
        print(table(rows, ["comparison", "difference", "unit"], "lrl"))
        print()
        print("\n".join(found.verdict()))
        if json_path is not None:
            names = "bias first_tick first_chaos time open_loop chaos closed_loop settling push"
            figures = {name: getattr(found, name) for name in names.split()}
            write_figures(json_path, figures | {"settled": found.settled, "verdict": found.verdict()})
            print(f"\nfigures: {json_path}")
        if picture is not None:
            first, second = (each.rollout for each in found.moves)
            apart = np.abs(first.qpos - second.qpos).max(2)
            title = f"{robot.name}: MuJoCo compared with SAPIEN"
            figure = engine_differences(found.time, found.open_loop, found.chaos, first.time, apart, title)
            print(f"\npicture: {plots.save(figure, picture)}")
