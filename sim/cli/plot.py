"""``batchpid plot``: a picture or a film of a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Rollout, read_recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN_ENVS = 16
"""Envs in a film."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Recorded run that is drawn or filmed."""

    path: Path
    rollout: Rollout
    robot: Robot | None
    kind: str

    def report(self) -> str:
        """Return a line about the run."""
        return recording_line(self.path, self.rollout)

    def figure(self) -> Figure:
        """Draw the run."""
        from batchpid.sim import plots

        if self.kind == "responses":
            return plots.step_responses(self.rollout)
        if self.kind == "efforts":
            return plots.efforts(self.rollout)
        return plots.following_errors(self.rollout)

    def film(self, path: Path, progress: Callable[[Any], Any]) -> None:
        """Film the first :data:`SHOWN_ENVS` envs in real time."""
        from batchpid.sim.view.film import write_film

        shown = self.rollout.for_envs(slice(0, SHOWN_ENVS))
        write_film(shown, path, robot=self.robot, progress=progress)


def plot(
    recording: tyro.conf.Positional[Path],
    robot: Robot | None = None,
    kind: Literal["responses", "efforts", "following"] = "responses",
) -> Recording:
    """Draw a recorded run, or film it.

    The recording may be complete, cut short by a kill, or still being written. A film draws
    the robot of the recording, or the one that is named.

    Parameters
    ----------
    recording
        File that `batchpid rollout --out` or a batchpid.sim.Recorder wrote, .h5.
    kind
        Step responses, efforts against their limits, or errors of following.
    """
    rollout = read_recording(recording)
    if not len(rollout.time):
        remedy = "its run was cut short: run it again"
        raise InvalidArgumentError("recording", f"{recording} holds no tick", remedy=remedy)
    return Recording(recording, rollout, robot, kind)


def recording_line(path: Path, rollout: Rollout) -> str:
    """Return a line about a recorded run."""
    cut = "" if rollout.info.complete else " (cut short)"
    return f"{path}{cut}: {rollout.info.robot}, {rollout!r}"
