"""``batchpid render``: a film of a recorded run, by SAPIEN's own renderer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from sim.cli.optional import OptionalStr


@dataclass(frozen=True)
class Render:
    """A film of a recorded run, in real time, all envs side by side.

    Needs a Vulkan device, a software one included; without one it says what to install. ``batchpid view --play`` shows
    the same anywhere.
    """

    run_file: tyro.conf.Positional[Path]
    """What batchpid rollout --out wrote."""
    out: Path = Path("out/film.mp4")
    """The film: .mp4 or .gif."""
    robot: OptionalStr = None
    """A bundled robot or the path of a URDF. Default: the recorded one."""
    envs: int = 16
    """Show so many envs, the first ones."""
    fps: float = 30.0
    """Frames a second."""
    width: int = 960
    """Pixels."""
    height: int = 540
    """Pixels."""

    def run(self) -> None:
        """Run it."""
        from tqdm import tqdm

        from batchpid.validate import integer
        from sim import Robot
        from sim.recording.dataset import read_rollout
        from sim.view.film import write_film

        recorded = read_rollout(self.run_file)
        robot = Robot.load(self.robot or recorded.robot)
        rollout = recorded.rollout.for_envs(slice(0, integer("envs", self.envs, 1, 64)))

        def progress(rows: object) -> object:
            return tqdm(rows, desc="filming", unit="frame", leave=False)

        path = write_film(
            rollout, self.out, robot=robot, fps=self.fps, width=self.width, height=self.height, progress=progress
        )
        print(f"film: {path}")
