"""``batchpid plot``: draw a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from sim.cli.optional import Names, OptionalPath


@dataclass(frozen=True)
class Plot:
    """Draw a recording: step responses, or efforts against limits; or compare it with another one.

    It may be complete, cut short by a kill (``NAME.h5.partial``), or still being written.
    """

    recording: Annotated[Path, tyro.conf.Positional]
    """What ``rollout --out`` or a ``sim.Recorder`` wrote: .h5 or .npz."""
    versus: OptionalPath = None
    """Another recording, to compare with."""
    kind: Literal["responses", "efforts"] = "responses"
    """What to draw of one recording."""
    joints: Names = ()
    """Names of joints. Default: all."""
    every: int = 1
    """Take only every n-th tick, for long recordings."""
    out: OptionalPath = None
    """Picture to write: .png or .svg. Default: beside the recording."""

    def run(self) -> None:
        """Run it."""
        from batchpid.validate import integer
        from sim import plots

        every = integer("every", self.every, 1, 10**9)
        out = plots.check_path(self.out or self.recording.with_name(f"{self.recording.name.partition('.')[0]}.png"))
        traces = _read(self.recording, every)
        if self.versus is not None:
            figure = plots.comparison(traces, _read(self.versus, every), joints=self.joints or None)
        else:
            draw: Any = plots.step_responses if self.kind == "responses" else plots.efforts
            figure = draw(traces, joints=self.joints or None)
        print(f"picture: {plots.save(figure, out)}")


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
