"""``batchpid demo``: many robots move to the tutorial's setpoint; a table and a picture."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from batchpid.arrays.array_types import Document
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import FOLDER, OutputFiles, beside, waiting, write_figures
from batchpid.sim.tuning.gain_sets import gain_set

RUNNER = flags.runner_flags("ground", "workers", "engine", "backend")


@dataclass(frozen=True)
class DemoCommand:
    """Move 64 arms to the tutorial's setpoint; print a table of the joints and draw a picture.

    PID and passive force are computed at each of the 2000 sim steps of a second. Env 0 starts where SAPIEN's tutorial
    does, the others at seeded poses near it.
    """

    robot: flags.RobotName = "panda"
    num_envs: flags.NumEnvs = 64
    gains: flags.Gains = None
    seconds: flags.Seconds = 2.0
    seed: flags.Seed = 0
    """Seed of the start poses."""
    spread: flags.Spread = 0.3
    runner: Annotated[flags.RunnerFlags, flags.group(RUNNER)] = field(default_factory=RUNNER)
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    picture: flags.OptionalPath = None
    """Step responses to draw: .png or .svg. Default: out/ROBOT-demo.png."""
    json: flags.Json = None
    force: flags.Force = False

    imports = ("batchpid.sim.plots", "batchpid.sim.runner")

    def run(self) -> int:
        """Run the command; return the exit status, 3 if no env settles."""
        from batchpid.sim import Runner, plots
        from batchpid.sim.cli.report import exit_status, run_figures
        from batchpid.sim.cli.run import held, simulate, start_poses

        outputs, picture = OutputFiles(self), self.picture or beside(FOLDER / self.robot, "demo")
        picture = outputs.path("picture", picture, plots.FORMATS)
        json = outputs.path("json", self.json, (".json",))
        robot = Robot.load(self.robot, **vars(self.meshes))
        settings = robot.settings
        if settings is None:
            raise InvalidArgumentError(
                "robot", "has no tutorial setpoint", value=self.robot, remedy=f"run: batchpid rollout {self.robot}"
            )
        start = start_poses(robot, self.num_envs, self.spread, self.seed)
        gains = gain_set(robot, self.gains)
        title = f"{robot.name}: {self.num_envs} robots, {gains.control} at {settings.rate_hz:g} Hz, gains {gains.name}"
        options: Document = {"params": gains.params, "control": gains.control} | self.runner.options()
        with waiting(f"building {self.num_envs} robots"):
            made = Runner(robot, self.num_envs, timestep=1 / settings.rate_hz, substeps=10, **options)
        with made as runner:
            print(f"{title}, {robot.dof} joints, {len(runner.pids) or 1} processes, {runner.backend}", flush=True)
            setpoints = held(settings.target, self.seconds, runner.timestep * runner.substeps)
            rollout, report = simulate(runner, start, setpoints)
        print(report)
        for note in settings.notes:
            print(f"Note: {note}")
        figure = plots.step_responses(rollout, mark=0, title=f"{title}; env 0 from the tutorial's pose")
        print(f"\npicture: {plots.save(figure, picture)}")
        if json is not None:
            write_figures(json, run_figures(robot, rollout))
            print(f"figures: {json}")
        return exit_status(robot, rollout)
