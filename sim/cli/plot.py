"""``batchpid plot`` and ``batchpid render``: a picture of a recording, or of two, and a film."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Rollout, read_recording
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import OutputFiles, bar, beside


@dataclass(frozen=True)
class PlotCommand:
    """Draw a recorded run, or compare it with another one.

    The recording may be complete, cut short by a kill, or still being written.
    """

    recording: tyro.conf.Positional[Path]
    """File that `batchpid rollout --out` or a batchpid.sim.Recorder wrote, .h5."""
    versus: flags.OptionalPath = None
    """Another recording, to compare with."""
    kind: Literal["responses", "efforts"] = "responses"
    """Step responses, or efforts against their limits, of one recording."""
    joints: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]", help_behavior_hint="")] = ()
    """Names of joints to draw. Default: all."""
    every: Annotated[int, Field(low=1, high=1e9)] = 1
    """Draw only every n-th tick, for long recordings."""
    picture: flags.OptionalPath = None
    """Picture to draw: .png or .svg. Default: next to the recording NAME.h5, NAME-responses.png, NAME-efforts.png, or
    NAME-versus-OTHER.png."""
    force: flags.Force = False

    imports = ("batchpid.sim.plots",)

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim import plots

        if not self.recording.is_file():  # before a picture is named after it
            read_recording(self.recording)
        shown = self.kind if self.versus is None else f"versus-{self.versus.stem}"
        outputs = OutputFiles(force=self.force, inputs=(self.recording, self.versus))
        picture = outputs.path("picture", self.picture or beside(self.recording, shown), plots.FORMATS)
        rollout = _read(self.recording, self.every)
        if self.versus is not None:
            labels = (self.recording.name, self.versus.name)
            figure = plots.comparison(rollout, _read(self.versus, self.every), labels=labels, joints=self.joints)
        else:
            draw: Any = plots.step_responses if self.kind == "responses" else plots.efforts
            figure = draw(rollout, joints=self.joints)
        print(f"picture: {plots.save(figure, picture)}")


def _read(path: Path, every: int) -> Rollout:
    """Return the run in a file, unless it is empty, and print a line about it."""
    rollout = read_recording(path, every=every)
    print(f"{path}{'' if rollout.info.complete else ' (cut short)'}: {rollout.info.robot}, {rollout!r}")
    if not len(rollout.time):
        raise InvalidArgumentError("recording", f"{path} holds no tick", remedy="its run was cut short: run it again")
    return rollout


@dataclass(frozen=True)
class RenderCommand:
    """Film a recorded run in real time, all envs side by side.

    SAPIEN's renderer draws it on a Vulkan device, which may be a software one. Without a device, Matplotlib draws it,
    in less detail. ``batchpid view --play`` shows the same in a browser.
    """

    recording: tyro.conf.Positional[Path]
    """File that `batchpid rollout --out` or a batchpid.sim.Recorder wrote, .h5."""
    robot: flags.RecordedRobot = None
    num_envs: flags.ShownEnvs = 16
    """Number of envs to show, the first ones; 64 at most."""
    fps: flags.Fps = 30.0
    width: Annotated[int, Field(low=16, high=8192)] = 960
    """Width of the film [pixels]."""
    height: Annotated[int, Field(low=16, high=8192)] = 540
    """Height of the film [pixels]."""
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    out: flags.OptionalPath = None
    """Film to write: .mp4 or .gif. Default: next to the recording NAME.h5, NAME-film.mp4."""
    force: flags.Force = False

    imports = ("batchpid.sim.view.film",)

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim.cli.run import read_run
        from batchpid.sim.view.film import FORMATS, write_film
        from batchpid.sim.view.renderer import REMEDY, render_problem

        outputs = OutputFiles(force=self.force, inputs=(self.recording,))
        out = outputs.path("out", self.out or beside(self.recording, "film", ".mp4"), FORMATS)
        usage = f"batchpid render {shlex.quote(str(self.recording))} PATH/TO/ROBOT.urdf"
        rollout, robot = read_run(self.recording, self.robot, self.meshes, usage)
        rollout = rollout.for_envs(slice(0, self.num_envs))
        progress = bar("filming", unit="frame")
        path = write_film(
            rollout, out, robot=robot, fps=self.fps, width=self.width, height=self.height, progress=progress
        )
        print(f"film: {path}")
        if (problem := render_problem()) is not None:
            print(f"Note: drawn by Matplotlib; SAPIEN's renderer does not work on this machine ({problem}): {REMEDY}")
