"""``batchpid inspect``: the findings of a robot's preflight, its joints and the masses of its
links.
"""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from batchpid.sim import Finding, Robot
from batchpid.sim.cli.flags import Gains, flag
from batchpid.sim.diagnosis.text import table
from batchpid.sim.findings import summary
from batchpid.sim.geometry.inertia import DENSITY
from batchpid.sim.robot.parts import JOINT_HEADERS, joint_rows
from batchpid.sim.tuning.gain_sets import GainSet, gain_set, gain_table

SOURCES = {
    "inertial": "<inertial>",
    "repaired": "<inertial>, repaired",
    "shapes": f"collision shapes at {DENSITY:g} kg/m^3",
    "none": "-",
}
"""Words for the sources of masses."""
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
        masses = robot.link_masses
        total = sum(link.mass for link in masses.values())
        size = f"{robot.dof} degrees of freedom, {len(robot.links)} links, {total:.4g} kg"
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
        lines.append("\n" + table(list(joint_rows(joints)), JOINT_HEADERS, "lllrrrrrl"))
        rows = []
        for name, link in masses.items():
            mass = f"{link.mass:.4g} kg" if link.mass else "none"
            rows.append([name, mass, SOURCES[link.source]])
        lines.append("\n" + table(rows, ("link", "mass", "from"), "lrl"))
        lines += ["", *self._contact_lines()]
        return "\n".join(lines)

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
    if gains is None and not robot.has_tuned:
        # Designed gains keep the stability bound.
        return Inspection(robot, findings, None, [], all)
    chosen = gain_set(robot, gains)
    checked = robot.check(params=chosen.params, setpoint=robot.target, control=chosen.control)
    of_gains = [finding for finding in checked if finding not in findings]
    return Inspection(robot, findings, chosen, of_gains, all)


def sentences(findings: Iterable[Finding]) -> list[str]:
    """Return one sentence for each cause, in lines."""
    return [_fill(sentence) for sentence in summary(findings)]


def _fill(text: str) -> str:
    # A unit stays with its other half on a line.
    wrapper = textwrap.TextWrapper(
        120, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )
    return wrapper.fill(text.replace("N m", "N\xa0m")).replace("\xa0", " ")
