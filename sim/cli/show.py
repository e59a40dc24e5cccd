"""``batchpid inspect``: the findings of a robot's preflight, its joints and the masses of its
links. ``batchpid plot``: a picture or a film of a recording. ``batchpid view``: robots in the
browser, live or recorded.
"""

from __future__ import annotations

import math
import sys
import textwrap
from collections import Counter
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from batchpid.arrays.array_types import Progress
from batchpid.arrays.field_tables import Field
from batchpid.sim import Finding, Robot, Rollout, read_recording
from batchpid.sim.cli.flags import Engine, Gains, Workers, flag
from batchpid.sim.cli.gains import law_gains
from batchpid.sim.description.merging import link_inertias
from batchpid.sim.description.tables import Joint
from batchpid.sim.diagnosis.causes import table
from batchpid.sim.findings import summary
from batchpid.sim.options.groups import DEFAULT_ENGINE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from batchpid.sim.view import LiveSimulation, Playback


JOINT_COLUMNS = (
    "",
    "joint",
    "type",
    "limits",
    "effort",
    "velocity",
    "damping",
    "friction",
    "parent > child link",
)
NO_GROUND = "No ground: links other than the fixed base reach it at the start pose."


@dataclass(frozen=True, eq=False)
class Inspection:
    """Findings about a robot."""

    robot: Robot
    findings: list[Finding]

    def report(self) -> str:
        """Return the findings, and tables of joints and links."""
        robot = self.robot
        links = robot.tables.bodies
        inertias = link_inertias(robot.tables)
        total = sum(inertia.mass for inertia in inertias.values())
        # Joints in the order of qpos, then links by mass: the data sheet has both.
        joints = [joint_row(number, joint) for number, joint in enumerate(robot.joints)]
        masses = []
        for link in links:
            inertia = inertias.get(link.name)
            masses.append([link.name, "none" if inertia is None else f"{inertia.mass:.4g} kg"])
        pairs = robot.self_contact.pairs
        reasons = Counter(pair.reason for pair in pairs)
        counts = ", ".join(f"{count} {reason!r}" for reason, count in reasons.items())
        lines = [
            f"{robot.path}: {robot.dof} degrees of freedom, {len(links)} links, {total:.4g} kg\n",
            *(map(_fill, summary(self.findings)) if self.findings else ["Nothing odd about it."]),
            "\n" + table(joints, JOINT_COLUMNS, "lllrrrrrl"),
            "\n" + table(masses, ("link", "mass"), "lr") + "\n",
            f"{'Ground at height 0.' if robot.has_ground else NO_GROUND} {len(pairs)} pairs of links"
            f" excluded from collision{counts and f': {counts}'}.",
        ]
        return "\n".join(lines)


def inspect_robot(robot: Robot) -> Inspection:
    """List findings about a robot, its joints in the order of qpos, and the masses of its links."""
    # A drive has no gains to check.
    return Inspection(robot, robot.check(setpoint=robot.target, control="drive"))


def joint_row(number: int, joint: Joint) -> list[str]:
    """Return the cells of a joint under :data:`JOINT_COLUMNS`; ``number`` is that of its qpos."""
    limits = "none"
    if math.isfinite(joint.lower) or math.isfinite(joint.upper):
        limits = f"{_bound(joint.lower)} to {_bound(joint.upper, f' {joint.unit}')}"
    return [
        str(number),
        joint.name,
        joint.type,
        limits,
        _bound(joint.effort_limit, f" {joint.effort_unit}"),
        _bound(joint.velocity_limit, f" {joint.unit}/s"),
        f"{joint.damping:g}",
        f"{joint.friction:g}",
        f"{joint.parent_link} > {joint.child_link}",
    ]


def _bound(value: float, unit: str = "") -> str:
    return f"{value:.5g}{unit}" if math.isfinite(value) else "none"


def _fill(text: str) -> str:
    # A unit stays with its other half on a line.
    wrapper = textwrap.TextWrapper(
        120,
        subsequent_indent="  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    return wrapper.fill(text.replace("N m", "N\xa0m")).replace("\xa0", " ")


SHOWN_ENVS = 16
"""Envs in a film."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Recorded run that is drawn or filmed."""

    path: Path
    rollout: Rollout
    robot: Robot | None

    def report(self) -> str:
        """Return a line about the run."""
        return recording_line(self.path, self.rollout)

    def figure(self) -> Figure:
        """Draw the run."""
        from batchpid.sim import plots

        return plots.step_responses(self.rollout)

    def film(self, path: Path, progress: Progress[int]) -> None:
        """Film the first :data:`SHOWN_ENVS` envs in real time."""
        from batchpid.sim.view.film import write_film

        shown = self.rollout.for_envs(slice(0, SHOWN_ENVS))
        write_film(shown, path, robot=self.robot, progress=progress)


def plot(
    recording: Annotated[
        Path,
        tyro.conf.Positional,
        flag("File that `batchpid rollout --out` or batchpid.sim.write_recording wrote, .h5."),
    ],
    robot: Robot | None = None,
) -> Recording:
    """Draw a recorded run, or film it: the robot of the recording, or the one that is named."""
    return Recording(recording, read_recording(recording), robot)


def recording_line(path: Path, rollout: Rollout) -> str:
    """Return a line about a recorded run."""
    return f"{path}: {rollout.info.robot}, {rollout!r}"


def view(
    robot: Robot | None = None,
    num_envs: Annotated[int, Field(low=1, high=64), flag("Number of robots; 64 at most.")] = 16,
    gains: Gains = None,
    play: Annotated[Path | None, flag("Recorded run to show, .h5.", "FILE")] = None,
    port: Annotated[int, Field(low=0, high=65535), flag("Port; 0 for a free one.")] = 8080,
    time_limit: Annotated[
        float | None, Field("s"), flag("Stop after this wall-clock time [s]. Default: none.")
    ] = None,
    engine: Engine = DEFAULT_ENGINE,
    workers: Workers = None,
) -> None:
    """Show moving robots in the browser: sliders for setpoints, and a chart of a joint.

    The page is served on localhost only; from another machine, use ``ssh -L``. With ``--play`` it
    shows a recorded run, of the robot in the recording, or of the one that is named.
    """
    from batchpid.sim.view import LiveSimulation, View

    if play is not None:
        source: LiveSimulation | Playback = _recorded(play, robot)
    else:
        robot = robot or Robot.load("panda")
        # Without gains the Runner has its own default, which knows the loops of an MJCF file.
        params = None if gains is None else law_gains(robot, gains)
        source = LiveSimulation(robot, num_envs, engine=engine, workers=workers, params=params)
    with closing(source), View(source, port=port) as page:
        for finding in page.findings:
            print(f"batchpid: {finding}", file=sys.stderr)
        print(f"Open in a browser: {page.url}  (Ctrl-C ends it)", flush=True)
        # Ctrl-C is how a view ends.
        with suppress(KeyboardInterrupt):
            page.run(time_limit)


def _recorded(path: Path, robot: Robot | None) -> Playback:
    """Return the run in the file; of many envs those that fit on the page."""
    from batchpid.sim.view import Playback
    from batchpid.sim.view.scene import MAX_ROBOTS

    rollout = read_recording(path)
    print(recording_line(path, rollout))
    if rollout.num_envs > MAX_ROBOTS:
        print(f"showing the first {MAX_ROBOTS} of {rollout.num_envs} envs")
    return Playback(rollout.for_envs(slice(0, MAX_ROBOTS)), robot)
