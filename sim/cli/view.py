"""``batchpid view``: robots in the browser, live or recorded."""

from __future__ import annotations

import shlex
import sys
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.tuning.gain_sets import gain_set

if TYPE_CHECKING:
    from batchpid.sim.view import LiveSimulation, Playback

LOOPBACK = ("127.0.0.1", "localhost")

RUNNER = flags.runner_flags("compensate", "engine", "physics", "ground", "workers")


@dataclass(frozen=True)
class ViewCommand:
    """Show moving robots in the browser: sliders for setpoints and gains, and charts.

    The page is served on localhost. With ``--play`` it shows a recorded run.
    """

    robot: flags.RecordedRobot = None
    num_envs: flags.ShownEnvs = 16
    """Number of robots; 64 at most."""
    gains: flags.Gains = None
    spread: flags.Spread = 0.2
    runner: Annotated[flags.RunnerFlags, flags.group(RUNNER)] = field(default_factory=RUNNER)
    actuators: flags.Actuators = None
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    play: flags.OptionalPath = None
    """Recorded run to show, .h5."""
    fps: flags.Fps = 30.0
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for all of this machine. Everyone who sees the printed address
    can use it.
    """
    port: Annotated[int, Field(low=1, high=65535)] = 8080
    """Port, or a free one if it is taken."""
    time_limit: flags.TimeLimit = None

    imports = ("batchpid.sim.view",)

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim.view import View

        source = self._live() if self.play is None else self._recorded(self.play)
        with closing(source), View(source, host=self.host, port=self.port) as view:
            if self.host not in LOOPBACK:
                warning = (
                    f"listening on {self.host}, unencrypted: everyone who sees the address can move"
                    " the robots"
                )
                print(f"batchpid: warning: {warning}", file=sys.stderr)
            if view.port != self.port:
                print(f"port {self.port} is in use; the page is at {view.port}")
            for finding in view.findings:
                print(f"batchpid: {finding}", file=sys.stderr)
            print(f"Open in a browser: {view.url}  (Ctrl-C ends it)", flush=True)
            with suppress(KeyboardInterrupt):
                view.run(self.time_limit)
            print(f"{view.rate:.0f} frames/s, real-time factor {view.factor:.2f}")

    def _live(self) -> LiveSimulation:
        """Return the running robots."""
        from batchpid.sim.view import LiveSimulation

        robot = Robot.load(self.robot or "panda", actuators=self.actuators, **vars(self.meshes))
        gains = None if self.gains is None else gain_set(robot, self.gains)
        if gains and gains.control != "pid":
            raise InvalidArgumentError(
                "gains", "must be PID gains", value=self.gains, remedy="name others"
            )
        return LiveSimulation(
            robot,
            self.num_envs,
            period=1 / self.fps,
            spread=self.spread,
            **self.runner.options(),
            params=gains and gains.params,
        )

    def _recorded(self, path: Path) -> Playback:
        """Return the run in the file; of many envs those that fit on the page."""
        from batchpid.sim.cli.run import read_run
        from batchpid.sim.view import Playback
        from batchpid.sim.view.scene import MAX_ROBOTS

        usage = f"batchpid view PATH/TO/ROBOT.urdf --play {shlex.quote(str(path))}"
        rollout, robot = read_run(path, self.robot, self.meshes, usage)
        if rollout.num_envs > MAX_ROBOTS:
            print(f"showing the first {MAX_ROBOTS} of {rollout.num_envs} envs")
        return Playback(rollout.for_envs(slice(0, MAX_ROBOTS)), robot, period=1 / self.fps)
