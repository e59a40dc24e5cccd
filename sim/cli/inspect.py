"""``batchpid inspect``: the joints of a robot and the findings of its preflight."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass

from batchpid.versions import package_versions
from sim import Robot
from sim.cli import flags
from sim.tuning.gain_sets import gain_set

HEADERS = ("", "joint", "type", "limits", "effort", "velocity", "damping", "friction", "parent > child link")


@dataclass(frozen=True)
class InspectCommand:
    """List the joints of a robot in the order of qpos, and what is odd about it and about gains."""

    robot: flags.RobotName = "panda"
    gains: flags.Gains = None
    all: flags.Switch = False
    """List the fixed joints too."""
    strict: flags.Switch = False
    """Exit with status 1 if a finding is worse than a note."""
    missing_meshes: flags.MissingMeshes = "skip"
    engine: flags.Switch = False
    """Print the kind of the calls into the engine too, and the reason if they are not native."""

    imports = ("sim.engine.dynamics",)

    def run(self) -> int:
        """Run the command and return its exit status."""
        robot = Robot.load(self.robot, missing_meshes=self.missing_meshes)
        print(f"{robot.name}: {robot.dof} degrees of freedom, {len(robot.links)} links, {robot.path}\n")
        print(joint_table(robot, fixed_too=self.all) + "\n")
        print(disabled_pairs(robot) + "\n")
        setpoint = None if robot.settings is None else robot.settings.target
        findings = robot.check(setpoint=setpoint, control="drive")  # without gains
        print("\n".join(map(str, findings)) or "Nothing odd about it.")
        if self.gains is not None or robot.has_tuned:  # designed gains keep the stability bound
            gains = gain_set(robot, self.gains)
            with_gains = robot.check(params=gains.params, setpoint=setpoint, control=gains.control)
            of_gains = [finding for finding in with_gains if finding not in findings]
            print(f"\nUnder gains {gains.name}:")
            print("\n".join(map(str, of_gains)) or "Nothing odd.")
            findings += of_gains
        if self.engine:
            from sim.engine.native import status

            print(f"\nEngine: SAPIEN {package_versions(['sapien'])['sapien']}, {status()}.")
        return int(self.strict and any(finding.severity != "note" for finding in findings))


def joint_table(robot: Robot, *, fixed_too: bool) -> str:
    """Return a table of the moving joints, numbered as in qpos, and the fixed ones."""
    from sim.cli.report import table

    rows = [
        [
            str(index),
            joint.name,
            joint.type,
            f"{_bound(joint.lower)} to {_bound(joint.upper)} {joint.unit}",
            f"{_bound(joint.effort_limit)} {joint.effort_unit}",
            f"{_bound(joint.velocity_limit)} {joint.unit}/s",
            f"{joint.damping:g}",
            f"{joint.friction:g}",
            f"{joint.parent_link} > {joint.child_link}",
        ]
        for index, joint in enumerate(robot.joints)
    ]
    rows += [
        ["-", joint.name, joint.type, *"-----", f"{joint.parent_link} > {joint.child_link}"]
        for joint in robot.all_joints
        if fixed_too and not joint.moves
    ]
    return table(rows, HEADERS, "lllrrrrrl")


def disabled_pairs(robot: Robot) -> str:
    """Return the pairs of links that do not collide, by reason, and whether the robot's scenes have a ground."""
    contact = robot.self_contact
    lines = [] if robot.has_ground else ["No ground: links other than the fixed base reach it at the start pose."]
    for reason in dict.fromkeys(pair.reason for pair in contact.pairs):
        pairs = ", ".join(f"{pair.first} - {pair.second}" for pair in contact.pairs if pair.reason == reason)
        lines.append(textwrap.fill(f"Do not collide, {reason!r}: {pairs}", 120, subsequent_indent="  "))
    return "\n".join(lines) or "All links collide."


def _bound(value: float) -> str:
    return f"{value:.5g}" if math.isfinite(value) else "none"
