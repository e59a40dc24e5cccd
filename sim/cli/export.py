"""``batchpid export``: gains as a file for another program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import Outputs

SUFFIXES = {"c": ".h"}
"""Suffix of the file of each target."""


@dataclass(frozen=True)
class ExportCommand:
    """Write a robot's gains as a file for another program.

    Target "c" is a C99 header without dependencies: the law with its gains, bit-identical to batchpid's. Differences
    between the target's law and batchpid's are printed, one line each.
    """

    robot: flags.RobotName = "panda"
    gains: flags.Gains = None
    to: Literal["c"] = "c"
    """Target: "c", a header."""
    timestep: float = 1 / 1000
    """Time step of the control on the robot [s]."""
    limits: flags.Switch = False
    """Limit setpoints to the robot's joint limits and speeds before they reach the law."""
    prefix: str = "batchpid"
    """Beginning of every name in the file."""
    strict: flags.Switch = False
    """End with an error if the target's law differs."""
    missing_meshes: flags.MissingMeshes = "skip"
    out: flags.OptionalPath = None
    """File to write. Default: out/ROBOT-pid.h."""
    force: flags.Force = False

    imports = ("batchpid.sim.tuning.gain_sets", "batchpid.export")

    def run(self) -> None:
        """Run the command."""
        from batchpid.errors import InvalidArgumentError
        from batchpid.export import to_c
        from batchpid.io.files import write_atomically
        from batchpid.sim.tuning.gain_sets import gain_set

        robot = Robot.load(self.robot, missing_meshes=self.missing_meshes)
        chosen = gain_set(robot, self.gains)
        if chosen.control != "pid":
            remedy = "choose gains of the law: tuned, designed, tutorial, or a file"
            raise InvalidArgumentError("gains", "are a drive's, which has no file", value=chosen.name, remedy=remedy)
        suffix = SUFFIXES[self.to]
        out = self.out or Path(f"out/{robot.path.stem}-pid{suffix}")
        out = Outputs(force=self.force).path("out", out, (suffix,))
        guard = robot.guard() if self.limits else None
        exported = to_c(chosen.params, self.timestep, joint_names=robot.joint_names, guard=guard, prefix=self.prefix)
        differences = list(exported.differences)
        if robot.coupling is not None:
            followers = [name for name, own in zip(robot.joint_names, robot.independent, strict=True) if not own]
            differences.append(
                f"{', '.join(followers)}: followers are joints of their own in the file; ignore their efforts"
            )
        if self.strict and differences:
            raise InvalidArgumentError("to", "; ".join(differences), value=self.to, remedy="leave out --strict")
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, exported.text)
        for each in differences:
            print(f"differs: {each}")
        print(f"written: {out}: {chosen.name} gains of {robot.dof} joints at {1 / self.timestep:g} Hz")
