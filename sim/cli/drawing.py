"""``batchpid plot``: a picture or a film of a recording. ``batchpid view``: robots in the browser,
live or recorded.
"""

from __future__ import annotations

import sys
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from batchpid.arrays.array_types import Document, Progress
from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Rollout, read_recording
from batchpid.sim.cli.flags import Gains, flag
from batchpid.sim.cli.gains import law_gains

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from batchpid.sim.view import LiveSimulation, Playback

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

    def film(self, path: Path, progress: Progress[int]) -> None:
        """Film the first :data:`SHOWN_ENVS` envs in real time."""
        from batchpid.sim.view.film import write_film

        shown = self.rollout.for_envs(slice(0, SHOWN_ENVS))
        write_film(shown, path, robot=self.robot, progress=progress)


def plot(
    recording: Annotated[
        Path,
        tyro.conf.Positional,
        flag("File that `batchpid rollout --out` or a batchpid.sim.Recorder wrote, .h5."),
    ],
    robot: Robot | None = None,
    kind: Annotated[
        Literal["responses", "efforts", "following"],
        flag("Step responses, efforts against their limits, or errors of following."),
    ] = "responses",
) -> Recording:
    """Draw a recorded run, or film it.

    The recording may be complete, cut short by a kill, or still being written. A film draws
    the robot of the recording, or the one that is named.
    """
    return Recording(recording, _read(recording), robot, kind)


def _read(path: Path) -> Rollout:
    """Return the run in a file. Raises InvalidArgumentError for one without ticks."""
    rollout = read_recording(path)
    if not len(rollout.time):
        remedy = "its run was cut short: run it again"
        raise InvalidArgumentError("recording", f"{path} holds no tick", remedy=remedy)
    return rollout


def recording_line(path: Path, rollout: Rollout) -> str:
    """Return a line about a recorded run."""
    cut = "" if rollout.info.complete else " (cut short)"
    return f"{path}{cut}: {rollout.info.robot}, {rollout!r}"


def view(
    robot: Robot | None = None,
    num_envs: Annotated[int, Field(low=1, high=64), flag("Number of robots; 64 at most.")] = 16,
    gains: Gains = None,
    play: Annotated[Path | None, flag("Recorded run to show, .h5.", "FILE")] = None,
    port: Annotated[
        int, Field(low=1, high=65535), flag("Port, or a free one if it is taken.")
    ] = 8080,
    time_limit: Annotated[
        float | None, Field("s"), flag("Stop after this wall-clock time [s]. Default: none.")
    ] = None,
    **options: Any,
) -> None:
    """Show moving robots in the browser: sliders for setpoints, and a chart of a joint.

    The page is served on localhost only; from another machine, use ``ssh -L``. With ``--play`` it
    shows a recorded run, of the robot in the recording, or of the one that is named.
    """
    from batchpid.sim.view import View

    if play is None:
        source: LiveSimulation | Playback = _live(
            robot or Robot.load("panda"), num_envs, gains, options
        )
    else:
        source = _recorded(play, robot)
    with closing(source), View(source, port=port) as page:
        for finding in page.findings:
            print(f"batchpid: {finding}", file=sys.stderr)
        print(f"Open in a browser: {page.url}  (Ctrl-C ends it)", flush=True)
        # Ctrl-C is how a view ends.
        with suppress(KeyboardInterrupt):
            page.run(time_limit)


def _live(
    robot: Robot,
    num_envs: int,
    gains: str | None,
    options: Document,
) -> LiveSimulation:
    """Return the running robots."""
    from batchpid.sim.view import LiveSimulation

    # Without gains the Runner has its own default, which knows the loops of an MJCF file.
    if gains is not None:
        options["params"] = law_gains(robot, gains)
    return LiveSimulation(robot, num_envs, **options)


def _recorded(path: Path, robot: Robot | None) -> Playback:
    """Return the run in the file; of many envs those that fit on the page."""
    from batchpid.sim.view import Playback
    from batchpid.sim.view.scene import MAX_ROBOTS

    rollout = _read(path)
    print(recording_line(path, rollout))
    if rollout.num_envs > MAX_ROBOTS:
        print(f"showing the first {MAX_ROBOTS} of {rollout.num_envs} envs")
    return Playback(rollout.for_envs(slice(0, MAX_ROBOTS)), robot)
