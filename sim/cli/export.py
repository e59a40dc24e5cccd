"""``batchpid export``: gains as a file for another program."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import Outputs

if TYPE_CHECKING:
    import batchpid as bp
    from batchpid.export import Exported

FILES = {"c": "-pid.h", "ros2_control": "-controllers.yaml", "urdf": "-repaired.urdf"}
"""End of the default file name of each target."""
USED = {
    "c": ("gains", "timestep", "limits", "prefix"),
    "ros2_control": ("gains", "timestep", "limits", "prefix", "controller"),
    "urdf": (),
}
"""Flags that have an effect for each target, of those that some have."""
POSES = 64
"""Sampled poses, for the range of the inertia."""


@dataclass(frozen=True)
class ExportCommand:
    """Write a robot's gains, or the robot itself, as a file for another program.

    Target "c" is a C99 header without dependencies: the law with its gains, bit-identical to batchpid's. "ros2_control"
    is the YAML of a controller. "urdf" is the robot with its repairs. Differences between the file and batchpid's law
    or the robot's file are printed, one line each.
    """

    robot: flags.RobotName = "panda"
    gains: flags.Gains = None
    to: Literal["c", "ros2_control", "urdf"] = "c"
    """Target: "c", a header; "ros2_control", parameters of a controller; "urdf", the repaired robot."""
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
        from batchpid.sim.robot.urdf_export import to_urdf
        from batchpid.sim.tuning.gain_sets import gain_set

        for field in fields(self):
            unused = field.name in USED["ros2_control"] and field.name not in USED[self.to]
            if unused and (value := getattr(self, field.name)) != field.default:
                problem = f"has no effect with --to {self.to}"
                raise InvalidArgumentError(field.name, problem, value=value, remedy="leave it out")
        robot = Robot.load(self.robot, missing_meshes=self.missing_meshes)
        out = self.out or Path(f"out/{robot.path.stem}{FILES[self.to]}")
        out = Outputs(force=self.force).path("out", out, (Path(FILES[self.to]).suffix,))
        if self.to == "urdf":
            exported = to_urdf(robot, out.absolute().parent)
            content = f"{robot.name}, {robot.dof} joints, without need of repair"
        else:
            chosen = gain_set(robot, self.gains)
            if chosen.control != "pid":
                remedy = "choose gains of the law: tuned, designed, tutorial, or a file"
                problem = "are a drive's, which has no file"
                raise InvalidArgumentError("gains", problem, value=chosen.name, remedy=remedy)
            exported = self._exported(robot, chosen.params)
            content = f"{chosen.name} gains of {robot.dof} joints at {1 / self.timestep:g} Hz"
        differences = exported.differences
        if self.strict and differences:
            raise InvalidArgumentError("to", "; ".join(differences), value=self.to, remedy="leave out --strict")
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, exported.text)
        for each in differences:
            print(f"differs: {each}")
        print(f"written: {out}: {content}")

    def _exported(self, robot: Robot, params: bp.PIDParams) -> Exported:
        """Return the file of a target for gains."""
        from batchpid.export import to_c, to_ros2_control

        followers = [name for name, own in zip(robot.joint_names, robot.independent, strict=True) if not own]
        place = "joints of their own in the file; ignore their efforts" if self.to == "c" else "not in the file"
        notes = [f"{', '.join(followers)}: followers are {place}"] if followers else []
        if self.to == "c":
            guard = robot.guard() if self.limits else None
            exported = to_c(params, self.timestep, joint_names=robot.joint_names, guard=guard, prefix=self.prefix)
        else:
            if self.limits:
                notes.append("guard: setpoints are not limited in the controller")
            joints = [name for name in robot.joint_names if name not in followers]
            params = params.for_joints(robot.independent)
            options = {"controller": self.controller, "name": self.prefix}
            exported = to_ros2_control(params, joints, self.timestep, inertia=_inertia(robot), **options)
        return exported._replace(differences=(*exported.differences, *notes))


def _inertia(robot: Robot) -> np.ndarray:
    """Return the inertia of the independent joints (poses, joints) at the start pose, then at sampled poses."""
    matrices = robot.mass_matrix(np.vstack([robot.start, robot.sample(POSES)]))
    if robot.coupling is not None:
        matrices = robot.coupling.mass_matrix(matrices)
    return np.diagonal(matrices, axis1=1, axis2=2)[:, robot.independent]
