"""``batchpid view``: robots in the browser, live or recorded."""

from __future__ import annotations

import sys
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, read_recording
from batchpid.sim.cli.plot import recording_line
from batchpid.sim.tuning.gain_sets import gain_set

if TYPE_CHECKING:
    from batchpid.sim.view import LiveSimulation, Playback


def view(
    robot: Robot | None = None,
    num_envs: Annotated[int, Field(low=1, high=64)] = 16,
    gains: str | None = None,
    play: Path | None = None,
    port: Annotated[int, Field(low=1, high=65535)] = 8080,
    time_limit: Annotated[float | None, Field("s")] = None,
    **options: Any,
) -> None:
    """Show moving robots in the browser: sliders for setpoints and gains, and charts.

    The page is served on localhost only; from another machine, use ``ssh -L``. With ``--play`` it
    shows a recorded run, of the robot in the recording, or of the one that is named.

    Parameters
    ----------
    num_envs
        Number of robots; 64 at most.
    gains
        Gains, as for `batchpid rollout`.
    play
        Recorded run to show, .h5.
    port
        Port, or a free one if it is taken.
    time_limit
        Stop after this wall-clock time [s]. Default: none.
    """
    from batchpid.sim.view import View

    if play is None:
        source: Any = _live(robot or Robot.load("panda"), num_envs, gains, options)
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
    robot: Robot, num_envs: int, gains: str | None, options: dict[str, Any]
) -> LiveSimulation:
    """Return the running robots."""
    from batchpid.sim.view import LiveSimulation

    chosen = gain_set(robot, gains)
    if chosen.control != "pid":
        raise InvalidArgumentError("gains", "must be PID gains", value=gains, remedy="name others")
    return LiveSimulation(robot, num_envs, params=chosen.params, **options)


def _recorded(path: Path, robot: Robot | None) -> Playback:
    """Return the run in the file; of many envs those that fit on the page."""
    from batchpid.sim.view import Playback
    from batchpid.sim.view.scene import MAX_ROBOTS

    rollout = read_recording(path)
    print(recording_line(path, rollout))
    if rollout.num_envs > MAX_ROBOTS:
        print(f"showing the first {MAX_ROBOTS} of {rollout.num_envs} envs")
    return Playback(rollout.for_envs(slice(0, MAX_ROBOTS)), robot)
