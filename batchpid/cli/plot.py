"""``batchpid plot``: draw a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


@dataclass(frozen=True)
class Plot:
    """Draw a recording: step responses, or efforts against limits; or compare it with another one.

    It may be complete, cut short by a kill (``NAME.h5.partial``), or still being written.
    """

    recording: Annotated[Path, tyro.conf.Positional]
    """What ``rollout --out`` or a ``sim.Recorder`` wrote: .h5."""
    versus: Path | None = None
    """Another recording, to compare with."""
    kind: Literal["responses", "efforts"] = "responses"
    """What to draw of one recording."""
    joints: tuple[str, ...] = ()
    """Names of joints. Default: all."""
    every: int = 1
    """Take every so-manieth tick: for long recordings."""
    out: Path | None = None
    """Picture to write: .png or .svg. Default: beside the recording."""

    def run(self) -> None:
        """Run it."""
        from batchpid import plots
        from sim.arguments import integer

        every = integer("every", self.every, 1, 10**9)
        out = plots.check_path(
            self.out or self.recording.with_name(f"{self.recording.name.partition('.')[0]}.png")
        )
        traces = _read(self.recording, every)
        if self.versus is not None:
            figure = plots.comparison(traces, _read(self.versus, every), joints=self.joints or None)
        else:
            draw: Any = plots.step_responses if self.kind == "responses" else plots.efforts
            figure = draw(traces, joints=self.joints or None)
        print(f"picture: {plots.save(figure, out)}")


def _read(path: Path, every: int) -> Any:
    import numpy as np

    from batchpid.errors import InvalidArgumentError
    from batchpid.plots import Traces
    from sim import read_recording

    run = read_recording(path, every=every)
    about = run.attributes
    ends = "" if run.complete else " (cut short)"
    print(
        f"{path}{ends}: robot {about['robot']}, {about['num_envs']} envs, {len(run.time)} ticks up to "
        f"{run.time[-1] if len(run.time) else 0:g} s, {int((~run.ok[-1:]).sum())} envs failed at the end"
    )
    if not len(run.time):
        raise InvalidArgumentError(
            "recording",
            f"{path} holds no tick",
            remedy="its run was cut short in its first second: run it again",
        )
    alive = run.ok[..., None]
    return Traces(
        time=run.time,
        setpoint=run.setpoint,
        qpos=np.where(alive, run.qpos, np.nan),
        effort=np.where(alive, run.effort, np.nan),
        saturated=run.saturated,
        joint_names=run.joint_names,
        units=tuple(map(str, about["units"])),
        lower=about["lower"],
        upper=about["upper"],
        effort_limit=about["effort_limit"],
        label=path.name,
    )
