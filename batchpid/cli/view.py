"""``batchpid view``: robots in the browser, live."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class View:
    """A page on localhost with robots that move: sliders for setpoints and gains, charts, pushes and payloads.

    With two controls the same robots stand side by side, one group under each. With ``--play`` it shows a recorded run.
    """

    robot: tyro.conf.Positional[str | None] = None
    """A bundled robot, or the path of a URDF; default panda, or the recorded one."""
    num_envs: int = 16
    """Robots in each group; 64 in all at most."""
    control: tuple[Literal["pid", "drive"], ...] = ("pid",)
    """What moves them: pid, drive, or both side by side."""
    compensate: Literal["gravity+coriolis", "gravity", "none"] = "gravity+coriolis"
    """Passive force added to the joints."""
    physics: Literal["accurate", "fast"] = "accurate"
    """Solver settings."""
    workers: int | None = None
    """Processes that step the scenes; default one for each core."""
    play: Path | None = None
    """A recorded run to show instead."""
    fps: float = 30.0
    """Frames a second."""
    host: str = "127.0.0.1"
    """Address to listen on. Whoever reaches it can move the sliders."""
    port: int = 8080
    """Port; the next free one if it is taken."""
    seconds: float | None = None
    """Stop after so many seconds; default at Ctrl-C."""

    def run(self) -> None:
        """Run it."""
        import sys

        from batchpid.errors import InvalidArgumentError
        from sim import Robot
        from sim.dataset import read_rollout
        from sim.view import Live, Playback, View
        from sim.view.source import Source

        if not 1.0 <= self.fps <= 120.0:
            raise InvalidArgumentError("fps", "out of range", value=self.fps, remedy="use 1 to 120")
        source: Source
        if self.play is not None:
            recorded = read_rollout(self.play)
            source = Playback(Robot.load(self.robot or recorded.robot), recorded.rollout, period=1 / self.fps)
        else:
            robot = Robot.load(self.robot or "panda")
            live = Live(
                robot,
                self.num_envs,
                controls=self.control,
                period=1 / self.fps,
                compensate=self.compensate,
                physics=self.physics,
                workers=self.workers,
            )
            if robot.settings is not None:
                live.go_to(robot.settings.target)
            source = live
        with View(source, host=self.host, port=self.port) as view:
            if self.host not in LOOPBACK:
                print(
                    f"batchpid: warning: listening on {self.host}: whoever reaches it can move the sliders",
                    file=sys.stderr,
                )
            print(f"{view.url}  (Ctrl-C ends it)", flush=True)
            view.run(self.seconds)
            print(f"{view.rate:.0f} frames/s at {view.factor:.2f} x real time")
