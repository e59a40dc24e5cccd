"""``batchpid plot``: a picture of a recording, or of two."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from sim.cli import flags


@dataclass(frozen=True)
class PlotCommand:
    """Draw a recorded run, or compare it with another one.

    The recording may be complete, cut short by a kill (``NAME.h5.partial``), or still being written.
    """

    recording: tyro.conf.Positional[Path]
    """File that `batchpid rollout --out` or a sim.Recorder wrote: .npz or .h5."""
    versus: flags.OptionalPath = None
    """Another recording, to compare with."""
    kind: Literal["responses", "efforts"] = "responses"
    """Step responses, or efforts against their limits, of one recording."""
    joints: flags.Names = ()
    """Names of joints to draw. Default: all."""
    every: int = 1
    """Draw only every n-th tick, for long recordings."""
    picture: flags.OptionalPath = None
    """Picture to draw: .png or .svg. Default: a .png named as the recording."""

    def run(self) -> None:
        """Run the command."""
        from batchpid.validate import integer
        from sim import plots
        from sim.plots.figures import FORMATS

        every = integer("every", self.every, 1, 10**9)
        picture = flags.output_path("picture", self.picture, FORMATS)
        traces = _read(self.recording, every)
        if self.versus is not None:
            figure = plots.comparison(traces, _read(self.versus, every), joints=self.joints or None)
        else:
            draw: Any = plots.step_responses if self.kind == "responses" else plots.efforts
            figure = draw(traces, joints=self.joints or None)
        named_alike = self.recording.with_name(f"{self.recording.name.partition('.')[0]}.png")
        print(f"picture: {plots.save(figure, picture or named_alike)}")


def _read(path: Path, every: int) -> Any:
    from batchpid.errors import InvalidArgumentError
    from sim.plots import Traces
    from sim.recording.dataset import read_rollout

    recorded = read_rollout(path, every=every)
    run = recorded.rollout
    failed = int((~run.ok[-1:]).sum())
    print(
        f"{path}{'' if recorded.complete else ' (cut short)'}: {run.ok.shape[1]} x {recorded.robot}, "
        f"{len(run.time)} ticks up to {run.time[-1] if len(run.time) else 0:g} s"
        + (f", {failed} envs diverged" if failed else "")
    )
    if not len(run.time):
        raise InvalidArgumentError(
            "recording",
            f"{path} holds no tick",
            remedy="its run was cut short in its first second: run it again",
        )
    return Traces.of(run, recorded, label=path.name)
