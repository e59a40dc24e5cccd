"""``batchpid inspect``: the findings of a robot's preflight, its joints and the masses of its
links. ``batchpid plot``: a picture or a film of a recording. ``batchpid view``: robots in the
browser, live or recorded.
"""

from __future__ import annotations

import math
import sys
import textwrap
from collections import Counter
from collections.abc import Iterable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from batchpid.arrays.array_types import Progress
from batchpid.arrays.field_tables import Field
from batchpid.sim import Finding, Robot, Rollout, read_recording
from batchpid.sim.cli.flags import Engine, Gains, Workers, flag
from batchpid.sim.cli.gains import law_gains
from batchpid.sim.description.merging import link_inertias
from batchpid.sim.description.tables import Body, Joint
from batchpid.sim.diagnosis.causes import table
from batchpid.sim.findings import summary
from batchpid.sim.geometry.shapes import DENSITY
from batchpid.sim.options.groups import DEFAULT_ENGINE
from batchpid.sim.robot.robot_options import tuned_file
from batchpid.sim.tuning.gain_sets import GainSet, gain_set, gain_table

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
    """Findings about a robot and gains."""

    robot: Robot
    findings: list[Finding]
    gains: GainSet | None
    """Gains that are checked, if any."""
    of_gains: list[Finding]
    """Findings about the gains."""
    all: bool

    def report(self) -> str:
        """Return the findings, and tables of joints and links."""
        robot = self.robot
        links = robot.tables.bodies
        inertias = link_inertias(robot.tables)
        total = sum(inertia.mass for inertia in inertias.values())
        size = f"{robot.dof} degrees of freedom, {len(links)} links, {total:.4g} kg"
        lines = [
            f"{robot.path}: {size}\n",
            *(sentences(self.findings) or ["Nothing odd about it."]),
        ]
        if self.gains is not None:
            lines += [
                f"\nUnder gains {self.gains.name}:",
                *(sentences(self.of_gains) or ["Nothing odd."]),
                "\n" + gain_table(robot, self.gains.params),
            ]

        # Joints in the order of qpos, then links by mass: the data sheet has both.
        joints = list(robot.joints)
        if self.all:
            joints += [joint for joint in robot.tables.joints if not joint.moves]
        rows = [joint_row(number, joint) for number, joint in enumerate(joints)]
        lines.append("\n" + table(rows, JOINT_COLUMNS, "lllrrrrrl"))
        rows = []
        for link in links:
            inertia = inertias.get(link.name)
            mass = "none" if inertia is None else f"{inertia.mass:.4g} kg"
            rows.append([link.name, mass, self._origin_of_mass(link)])
        lines.append("\n" + table(rows, ("link", "mass", "from"), "lrl"))
        lines += ["", *self._contact_lines()]
        return "\n".join(lines)

    def _origin_of_mass(self, link: Body) -> str:
        """Return where the mass of a link is from."""
        repaired = {repair.link for repair in self.robot.repairs if repair.code == "inertia"}
        if link.mass:
            return "<inertial>, repaired" if link.name in repaired else "<inertial>"
        if self.robot.tables.shapes_of(link.name):
            return f"collision shapes at {DENSITY:g} kg/m^3"
        return "-"

    def _contact_lines(self) -> list[str]:
        """Return lines about the ground, and about the pairs of links that do not collide."""
        robot = self.robot
        pairs = robot.self_contact.pairs
        if robot.has_ground:
            ground = "Ground at height 0."
        else:
            ground = NO_GROUND
        if not pairs:
            return [_fill(f"{ground} All links collide.")]
        reasons = Counter(pair.reason for pair in pairs)
        counts = ", ".join(f"{count} {reason!r}" for reason, count in reasons.items())
        more = "" if self.all else " (--all)"
        lines = [f"{ground} {len(pairs)} pairs of links excluded from collision: {counts}{more}."]
        if self.all:
            for reason in reasons:
                names = [f"{pair.first} - {pair.second}" for pair in pairs if pair.reason == reason]
                lines.append(f"Do not collide, {reason!r}: {', '.join(names)}")
        return [_fill(line) for line in lines]


def inspect_robot(
    robot: Robot,
    gains: Gains = None,
    all: Annotated[
        bool, flag("List fixed joints and pairs of links that do not collide, too.")
    ] = False,
) -> Inspection:
    """List findings about a robot and gains, its joints in the order of qpos, and the masses of its
    links.
    """
    findings = robot.check(setpoint=robot.target, control="drive")  # without gains
    if gains is None and tuned_file(robot) is None:
        # Designed gains keep the stability bound.
        return Inspection(robot, findings, None, [], all)
    chosen = gain_set(robot, gains)
    checked = robot.check(
        params=chosen.params,
        setpoint=robot.target,
        control=chosen.control,
    )
    of_gains = [finding for finding in checked if finding not in findings]
    return Inspection(robot, findings, chosen, of_gains, all)


def joint_row(number: int, joint: Joint) -> list[str]:
    """Return the cells of a joint under :data:`JOINT_COLUMNS`; ``number`` is that of its qpos."""
    links = f"{joint.parent_link} > {joint.child_link}"
    if not joint.moves:
        return ["-", joint.name, joint.type, *"-----", links]
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
        links,
    ]


def _bound(value: float, unit: str = "") -> str:
    return f"{value:.5g}{unit}" if math.isfinite(value) else "none"


def sentences(findings: Iterable[Finding]) -> list[str]:
    """Return one sentence for each cause, in lines."""
    return [_fill(sentence) for sentence in summary(findings)]


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
    kind: str

    def report(self) -> str:
        """Return a line about the run."""
        return recording_line(self.path, self.rollout)

    def figure(self) -> Figure:
        """Draw the run."""
        from batchpid.sim import plots

        draw = {
            "responses": plots.step_responses,
            "efforts": plots.efforts,
            "following": plots.following_errors,
        }
        return draw[self.kind](self.rollout)

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
    return Recording(recording, read_recording(recording), robot, kind)


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
