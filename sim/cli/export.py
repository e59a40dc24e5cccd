"""``batchpid export``: gains as a file for another program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import Outputs

if TYPE_CHECKING:
    import batchpid as bp
    from batchpid.export import Exported

FILES = {"c": "-pid.h", "ros2_control": "-controllers.yaml"}
"""End of the default file name of each target."""
POSES = 64
"""Sampled poses, for the range of the inertia."""


@dataclass(frozen=True)
class ExportCommand:
    """Write a robot's gains as a file for another program.

    Target "c" is a C99 header without dependencies: the law with its gains, bit-identical to batchpid's. "ros2_control"
    is the YAML of a controller. Differences between the target's law and batchpid's are printed, one line each.
    """

    robot: flags.RobotName = "panda"
    gains: flags.Gains = None
    to: Literal["c", "ros2_control"] = "c"
    """Target: "c", a header; "ros2_control", parameters of a controller."""
    controller: Literal["joint_trajectory_controller", "pid_controller"] = "joint_trajectory_controller"
    """Controller of ros2_control."""
    timestep: float = 1 / 1000
    """Time step of the control on the robot [s]."""
    limits: flags.Switch = False
    """Limit setpoints to the robot's joint limits and speeds before they reach the law."""
    prefix: str = "batchpid"
    """Beginning of every name in the file; in ros2_control the name of the controller."""
    strict: flags.Switch = False
    """End with an error if the target's law differs."""
    missing_meshes: flags.MissingMeshes = "skip"
    out: flags.OptionalPath = None
    """File to write. Default: out/ROBOT-pid.h, or another ending."""
    force: flags.Force = False

    imports = ("batchpid.sim.tuning.gain_sets", "batchpid.export")

    def run(self) -> None:
        """Run the command."""
        from batchpid.errors import InvalidArgumentError
        from batchpid.io.files import write_atomically
        from batchpid.sim.tuning.gain_sets import gain_set

        robot = Robot.load(self.robot, missing_meshes=self.missing_meshes)
        chosen = gain_set(robot, self.gains)
        if chosen.control != "pid":
            remedy = "choose gains of the law: tuned, designed, tutorial, or a file"
            raise InvalidArgumentError("gains", "are a drive's, which has no file", value=chosen.name, remedy=remedy)
        out = self.out or Path(f"out/{robot.path.stem}{FILES[self.to]}")
        out = Outputs(force=self.force).path("out", out, (Path(FILES[self.to]).suffix,))
        exported = self._exported(robot, chosen.params)
        differences = list(exported.differences)
        if robot.coupling is not None:
            followers = [name for name, own in zip(robot.joint_names, robot.independent, strict=True) if not own]
            place = "joints of their own in the file; ignore their efforts" if self.to == "c" else "not in the file"
            differences.append(f"{', '.join(followers)}: followers are {place}")
        if self.strict and differences:
            raise InvalidArgumentError("to", "; ".join(differences), value=self.to, remedy="leave out --strict")
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, exported.text)
        for each in differences:
            print(f"differs: {each}")
        print(f"written: {out}: {chosen.name} gains of {robot.dof} joints at {1 / self.timestep:g} Hz")

    def _exported(self, robot: Robot, params: bp.PIDParams) -> Exported:
        """Return the file of the target."""
        from batchpid.export import to_c, to_ros2_control

        if self.to == "c":
            guard = robot.guard() if self.limits else None
            return to_c(params, self.timestep, joint_names=robot.joint_names, guard=guard, prefix=self.prefix)
        joints = [name for name, own in zip(robot.joint_names, robot.independent, strict=True) if own]
        params = params.for_joints(robot.independent)
        exported = to_ros2_control(
            params, joints, self.timestep, controller=self.controller, name=self.prefix, inertia=_inertia(robot)
        )
        unlimited = ("guard: setpoints are not limited in the controller",) if self.limits else ()
        return exported._replace(differences=(*exported.differences, *unlimited))


def _inertia(robot: Robot) -> np.ndarray:
    """Return the inertia of the independent joints (poses, joints) at the start pose, then at sampled poses."""
    matrices = robot.mass_matrix(np.vstack([robot.start, robot.sample(POSES)]))
    if robot.coupling is not None:
        matrices = robot.coupling.mass_matrix(matrices)
    return np.diagonal(matrices, axis1=1, axis2=2)[:, robot.independent]
