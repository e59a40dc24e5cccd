"""``batchpid demo``: many robots move to the tutorial's setpoint; a table and a picture."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import FOLDER, beside
from batchpid.sim.cli.rollout import RolloutCommand

RUNNER = flags.runner_flags("ground", "workers", "engine", "backend")


@dataclass(frozen=True)
class DemoCommand:
    """Move 64 arms to the tutorial's setpoint; print a table of the joints and draw a picture.

    PID and passive force are computed at each of the 2000 sim steps of a second. Env 0 starts where
    SAPIEN's tutorial does, the others at seeded poses near it.
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

    imports = RolloutCommand.imports

    def run(self) -> int:
        """Run the command; return the exit status, 3 if no env settles."""
        picture = self.picture or beside(FOLDER / Path(self.robot).stem, "demo")
        same = flags.chosen(
            self, "robot num_envs gains seconds seed spread runner meshes json force"
        )
        return RolloutCommand(**same, picture=picture, substeps=10).run()
