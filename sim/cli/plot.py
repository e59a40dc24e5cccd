"""``batchpid plot``: a picture of a recording or of two, or a film."""

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

SHOWN_ENVS = 16
"""Envs in a film."""


@dataclass(frozen=True)
class PlotCommand:
    """Draw a recorded run, compare it with another one, or film it.

    The recording may be complete, cut short by a kill, or still being written.
    """

    recording: tyro.conf.Positional[Path]
    """File that `batchpid rollout --out` or a batchpid.sim.Recorder wrote, .h5."""
    robot: flags.RecordedRobot = None
    versus: flags.OptionalPath = None
    """Another recording, to compare with."""
    kind: Literal["responses", "efforts"] = "responses"
    """Step responses, or efforts against their limits, of one recording."""
    joints: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]", help_behavior_hint="")
    ] = ()
    """Names of joints to draw. Default: all."""
    every: Annotated[int, Field(low=1, high=1e9)] = 1
    """Draw only every n-th tick, for long recordings."""
    picture: flags.OptionalPath = None
    """Picture to draw: .png or .svg. Default: next to the recording NAME.h5, NAME-responses.png,
    NAME-efforts.png, or NAME-versus-OTHER.png.
    """
    film: flags.OptionalPath = None
    """Film of the first 16 envs in real time, to write instead of a picture: .mp4 or .gif."""
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    force: flags.Force = False

    imports = ("batchpid.sim.plots",)

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim import plots

        if not self.recording.is_file():  # before a picture is named after it
            read_recording(self.recording)
        shown = self.kind if self.versus is None else f"versus-{self.versus.stem}"
        outputs = OutputFiles(self)
        if self.film is not None:
            return self._film(outputs)
        picture = outputs.path(
            "picture", self.picture or beside(self.recording, shown), plots.FORMATS
        )
        rollout = _read(self.recording, self.every)
        if self.versus is not None:
            labels = (self.recording.name, self.versus.name)
            figure = plots.comparison(
                rollout, _read(self.versus, self.every), labels=labels, joints=self.joints
            )
        else:
            draw: Any = plots.step_responses if self.kind == "responses" else plots.efforts
            figure = draw(rollout, joints=self.joints)
        print(f"picture: {plots.save(figure, picture)}")

    def _film(self, outputs: OutputFiles) -> None:
        """Film the recording."""
        from batchpid.sim.cli.run import read_run
        from batchpid.sim.view.film import FORMATS, write_film

        film = outputs.path("film", self.film, FORMATS)
        assert film is not None
        usage = f"batchpid plot {shlex.quote(str(self.recording))} PATH/TO/ROBOT.urdf --film {film}"
        rollout, robot = read_run(self.recording, self.robot, self.meshes, usage)
        shown = rollout.for_envs(slice(0, SHOWN_ENVS))
        print(
            f"film: {write_film(shown, film, robot=robot, progress=bar('filming', unit='frame'))}"
        )


def _read(path: Path, every: int) -> Rollout:
    """Return the run in a file, unless it is empty, and print a line about it."""
    rollout = read_recording(path, every=every)
    print(
        f"{path}{'' if rollout.info.complete else ' (cut short)'}: {rollout.info.robot},"
        f" {rollout!r}"
    )
    if not len(rollout.time):
        raise InvalidArgumentError(
            "recording", f"{path} holds no tick", remedy="its run was cut short: run it again"
        )
    return rollout
