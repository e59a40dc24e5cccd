"""``batchpid render``: a film of a recorded run."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from batchpid.checks.validate import integer
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import OutputFiles, beside
from batchpid.sim.cli.progress import bar


@dataclass(frozen=True)
class RenderCommand:
    """Film a recorded run in real time, all envs side by side.

    SAPIEN's renderer draws it, with a Vulkan device, which may be a software one. Without one, Matplotlib draws it,
    plainer. ``batchpid view --play`` shows the same in a browser.
    """

    recording: tyro.conf.Positional[Path]
    """File that `batchpid rollout --out` or a batchpid.sim.Recorder wrote: .npz or .h5."""
    robot: flags.RecordedRobot = None
    num_envs: int = 16
    """Number of envs to show, the first ones; 64 at most."""
    fps: flags.Fps = 30.0
    width: int = 960
    """Width of the film [pixels]."""
    height: int = 540
    """Height of the film [pixels]."""
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    out: flags.OptionalPath = None
    """Film to write: .mp4 or .gif. Default: next to the recording NAME.npz, NAME-film.mp4."""
    force: flags.Force = False

    imports = ("batchpid.sim.view.film",)

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim.cli.run import read_run
        from batchpid.sim.view.film import FORMATS, write_film
        from batchpid.sim.view.layout import MAX_ROBOTS
        from batchpid.sim.view.renderer import REMEDY, render_problem

        outputs = OutputFiles(force=self.force, inputs=(self.recording,))
        out = outputs.path("out", self.out or beside(self.recording, "film", ".mp4"), FORMATS)
        usage = f"batchpid render {shlex.quote(str(self.recording))} PATH/TO/ROBOT.urdf"
        rollout, robot = read_run(self.recording, self.robot, self.meshes, usage)
        rollout = rollout.for_envs(slice(0, integer("num_envs", self.num_envs, 1, MAX_ROBOTS)))
        progress = bar("filming", unit="frame")
        path = write_film(
            rollout, out, robot=robot, fps=self.fps, width=self.width, height=self.height, progress=progress
        )
        print(f"film: {path}")
        if (problem := render_problem()) is not None:
            print(f"Note: drawn by Matplotlib; SAPIEN's renderer does not work on this machine ({problem}): {REMEDY}")
