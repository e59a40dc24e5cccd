"""``batchpid inspect``: what a robot is made of, and what is odd about it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from sim import Robot


@dataclass(frozen=True)
class Inspect:
    """The joints of a robot in the order of qpos, then what is odd about it."""

    robot: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ROBOT")]
    """A bundled robot, or the path of a URDF."""
    all: bool = False
    """List the fixed joints too."""
    missing_meshes: Literal["error", "skip"] = "error"
    """What to do about collision meshes that are not found."""
    strict: bool = False
    """Exit with status 1 if a finding is worse than a note."""

    def run(self) -> int:
        """Run it; returns the exit status."""
        from sim import Robot

        robot = Robot.load(self.robot, missing_meshes=self.missing_meshes)
        print(f"{robot.name}: {robot.dof} degrees of freedom, {len(robot.links)} links, {robot.path}\n")
        print(_joints(robot, self.all) + "\n")
        setpoint = None if robot.settings is None else robot.settings.target
        findings = robot.check(setpoint=setpoint)
        of_robot = robot.check(setpoint=setpoint, control="drive")  # the PID's gains left aside
        of_gains = [finding for finding in findings if finding not in of_robot]
        print("\n".join(map(str, of_robot)) or "Nothing odd about it.")
        if of_gains:
            print("\nUnder the tutorial's gains, robot.params(); those of robot.tuned() keep the bound:")
            print("\n".join(map(str, of_gains)))
        return int(self.strict and any(finding.severity != "note" for finding in findings))


def _joints(robot: Robot, fixed_too: bool) -> str:
    from sim.cli.report import table

    place = {joint.name: str(index) for index, joint in enumerate(robot.joints)}
    listed = [*robot.joints, *(joint for joint in robot.all_joints if fixed_too and not joint.moves)]
    rows = []
    for joint in listed:
        moves = joint.moves
        rows.append(
            [
                place.get(joint.name, "-"),
                joint.name,
                joint.type,
                f"{_bound(joint.lower)} to {_bound(joint.upper)} {joint.unit}" if moves else "-",
                f"{_bound(joint.effort_limit)} {joint.effort_unit}" if moves else "-",
                f"{_bound(joint.velocity_limit)} {joint.unit}/s" if moves else "-",
                f"{joint.damping:g}" if moves else "-",
                f"{joint.friction:g}" if moves else "-",
                f"{joint.parent_link} > {joint.child_link}",
            ]
        )
    headers = [
        "",
        "joint",
        "type",
        "limits",
        "effort",
        "velocity",
        "damping",
        "friction",
        "parent > child link",
    ]
    return table(rows, headers, "lllrrrrrl")


def _bound(value: float) -> str:
    return f"{value:.5g}" if math.isfinite(value) else "none"
