"""``batchpid plot``: a picture of a recording or of two, or a film."""

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
    """Recorded run, and another one to compare it with."""

    path: Path
    rollout: Rollout
    robot: Robot | None
    versus: Path | None
    kind: Literal["responses", "efforts", "following"]
    joints: tuple[str, ...]

    def report(self) -> str:
        """Return a line about the run."""
        cut = "" if self.rollout.info.complete else " (cut short)"
        return f"{self.path}{cut}: {self.rollout.info.robot}, {self.rollout!r}"

    def figure(self) -> Figure:
        """Draw the run, or both."""
        from batchpid.sim import plots

        # Two runs are compared as bands: fans of both would hide each other.
        if self.versus is not None:
            labels = (self.path.name, self.versus.name)
            other = _read(self.versus)
            return plots.comparison(self.rollout, other, labels=labels, joints=self.joints)
        if self.kind == "responses":
            return plots.step_responses(self.rollout, joints=self.joints)
        if self.kind == "efforts":
            return plots.efforts(self.rollout, joints=self.joints)
        return plots.following_errors(self.rollout, joints=self.joints)

    def film(self, path: Path, progress: Callable[[Any], Any]) -> None:
        """Film the first :data:`SHOWN_ENVS` envs in real time."""
        from batchpid.sim.view.film import write_film

        shown = self.rollout.for_envs(slice(0, SHOWN_ENVS))
        write_film(shown, path, robot=self.robot, progress=progress)


def plot(
    recording: tyro.conf.Positional[Path],
    robot: Robot | None = None,
    versus: Path | None = None,
    kind: Literal["responses", "efforts", "following"] = "responses",
    joints: tuple[str, ...] = (),
) -> Recording:
    """Draw a recorded run, compare it with another one, or film it.

    The recording may be complete, cut short by a kill, or still being written. A film draws
    the robot of the recording, or the one that is named.

    Parameters
    ----------
    recording
        File that `batchpid rollout --out` or a batchpid.sim.Recorder wrote, .h5.
    versus
        Another recording, to compare with.
    kind
        Step responses, efforts against their limits, or errors of following, of one recording.
    joints
        Names of joints to draw. Default: all.
    """
    return Recording(recording, _read(recording), robot, versus, kind, joints)


def _read(path: Path) -> Rollout:
    """Return the run in a file, unless it is empty."""
    rollout = read_recording(path)
    if not len(rollout.time):
        remedy = "its run was cut short: run it again"
        raise InvalidArgumentError("recording", f"{path} holds no tick", remedy=remedy)
    return rollout
