"""``batchpid view``: robots in the browser, live."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from sim.cli.optional import OptionalFloat, OptionalInt, OptionalPath, OptionalStr

if TYPE_CHECKING:
    from sim.view import Playback

LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class View:
    """A page on localhost with robots that move: sliders for setpoints and gains, charts, pushes and payloads.

    With two controls the same robots stand side by side, one group under each. With ``--play`` it shows a recorded run.
    """

    robot: tyro.conf.Positional[OptionalStr] = None
    """A bundled robot, or the path of a URDF. Default: panda, or the recorded one."""
    num_envs: int = 16
    """Robots in each group; 64 in all at most."""
    control: tuple[Literal["pid", "drive"], ...] = ("pid",)
    """What moves them: pid, drive, or both side by side."""
    params: OptionalStr = None
    """Gains of the PID to begin with: a file that `batchpid tune` or batchpid.save_params wrote, or one of tuned,
    designed, tutorial. Default: tuned ones where the robot has them, else designed ones."""
    compensate: Literal["gravity+coriolis", "gravity", "none"] = "gravity+coriolis"
    """Passive force added to the joints."""
    physics: Literal["accurate", "fast"] = "accurate"
    """Solver settings."""
    workers: OptionalInt = None
    """Processes that step the scenes. Default: one for each core."""
    play: OptionalPath = None
    """A recorded run to show instead."""
    fps: float = 30.0
    """Frames a second."""
    host: str = "127.0.0.1"
    """Address to listen on. Whoever reaches it can move the sliders."""
    port: int = 8080
    """Port; the next free one if it is taken."""
    seconds: OptionalFloat = None
    """Stop after so many seconds. Default: at Ctrl-C."""

    def run(self) -> None:
        """Run it."""
        import sys

        from batchpid.errors import InvalidArgumentError
        from batchpid.validate import integer
        from sim import Robot
        from sim.tuning.gain_sets import gain_set
        from sim.view import LiveSimulation, View
        from sim.view.data import ViewData

        port = integer("port", self.port, 1, 65535)
        if not 1.0 <= self.fps <= 120.0:
            raise InvalidArgumentError("fps", "out of range", value=self.fps, remedy="use 1 to 120")
        data: ViewData
        if self.play is not None:
            data = _recorded(self.play, self.robot, 1 / self.fps)
        else:
            robot = Robot.load(self.robot or "panda")
            gains = None if self.params is None else gain_set(robot, self.params)
            if gains is not None and gains.control != "pid":
                raise InvalidArgumentError(
                    "params", "are the PID's", value=self.params, remedy="use --control drive for a drive"
                )
            live = LiveSimulation(
                robot,
                self.num_envs,
                controls=self.control,
                period=1 / self.fps,
                compensate=self.compensate,
                physics=self.physics,
                workers=self.workers,
                params=None if gains is None else gains.params,
            )
            if robot.settings is not None:
                live.set_setpoints(robot.settings.target)
            data = live
        with View(data, host=self.host, port=port) as view:
            if self.host not in LOOPBACK:
                print(
                    f"batchpid: warning: listening on {self.host}: whoever reaches it can move the sliders",
                    file=sys.stderr,
                )
            print(f"Open in a browser: {view.url}  (Ctrl-C ends it)", flush=True)
            with suppress(KeyboardInterrupt):  # that is how it ends
                view.run(self.seconds)
            print(f"{view.rate:.0f} frames/s at {view.factor:.2f} x real time")


def _recorded(path: Path, name: str | None, period: float) -> Playback:
    """The run in a file; of many envs those that fit on the page."""
    from batchpid.errors import BatchPIDError, InvalidArgumentError
    from sim import Robot
    from sim.recording.dataset import read_rollout
    from sim.view import Playback
    from sim.view.layout import MAX_ROBOTS

    recorded = read_rollout(path)
    try:
        robot = Robot.load(name or recorded.robot)
    except BatchPIDError as error:
        if name is not None:
            raise
        raise InvalidArgumentError(
            "play",
            f"is a run of {recorded.robot!r}, which is not bundled",
            value=str(path),
            remedy=f"pass its URDF too: batchpid view path/to/{recorded.robot}.urdf --play {path}",
        ) from error
    count = recorded.rollout.num_envs
    if count > MAX_ROBOTS:
        print(f"showing the first {MAX_ROBOTS} of {count} envs")
    return Playback(recorded.rollout.for_envs(slice(0, MAX_ROBOTS)), robot, period=period)
