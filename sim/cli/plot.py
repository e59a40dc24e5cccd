"""``batchpid plot``: a picture of a recording, or of two."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from batchpid.checks.validate import integer
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Rollout, read_recording
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import OutputFiles, beside, stem


@dataclass(frozen=True)
class PlotCommand:
    """Draw a recorded run, or compare it with another one.

    The recording may be complete, cut short by a kill (``NAME.h5.partial``), or still being written.
    """

    recording: tyro.conf.Positional[Path]
    """File that `batchpid rollout --out` or a batchpid.sim.Recorder wrote: .npz or .h5."""
    versus: flags.OptionalPath = None
    """Another recording, to compare with."""
    kind: Literal["responses", "efforts"] = "responses"
    """Step responses, or efforts against their limits, of one recording."""
    joints: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]", help_behavior_hint="")] = ()
    """Names of joints to draw. Default: all."""
    every: int = 1
    """Draw only every n-th tick, for long recordings."""
    picture: flags.OptionalPath = None
    """Picture to draw: .png or .svg. Default: next to the recording NAME.npz, NAME-responses.png, NAME-efforts.png, or
    NAME-versus-OTHER.png."""
    force: flags.Force = False

    imports = ("batchpid.sim.plots",)

    def run(self) -> None:
        """Run the command."""
        from batchpid.sim import plots

        every = integer("every", self.every, 1, 10**9)
        if not self.recording.is_file():  # before a picture is named after it
            read_recording(self.recording)
        shown = self.kind if self.versus is None else f"versus-{stem(self.versus)}"
        outputs = OutputFiles(force=self.force, inputs=(self.recording, self.versus))
        picture = outputs.path("picture", self.picture or beside(self.recording, shown), plots.FORMATS)
        rollout = _read(self.recording, every)
        if self.versus is not None:
            labels = (self.recording.name, self.versus.name)
            figure = plots.comparison(rollout, _read(self.versus, every), labels=labels, joints=self.joints)
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
