"""``batchpid export``: gains as a file for another program."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from batchpid.arrays.field_tables import Field
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import FOLDER, OutputFiles

if TYPE_CHECKING:
    import batchpid as bp
    from batchpid.export import Exported

FILES = {
    "c": "-pid.h",
    "ros2_control": "-controllers.yaml",
    "mjcf": "-pid.xml",
    "urdf": "-repaired.urdf",
}
"""End of the default file name of each target."""
USED = {
    "c": ("gains", "timestep", "limits", "prefix", "dynamics"),
    "ros2_control": ("gains", "timestep", "limits", "prefix", "controller"),
    "mjcf": ("gains", "timestep", "limits", "actuators", "motors"),
    "urdf": (),
}
"""Flags that have an effect for each target, of those that only some have."""
COMMENTS = {"c": "/* {} */", "mjcf": "<!-- {} -->", "urdf": "<!-- {} -->"}
"""Comment of a target's language; of the others "# {}"."""
UNLIMITED = "guard: setpoints are not limited in the target"
POSES = 64
"""Sampled poses, for the range of the inertia."""


@dataclass(frozen=True)
class ExportCommand:
    """Write a robot's gains, or the robot itself, as a file for another program.

    Target "c" is a C99 header without dependencies: the law with its gains, bit-identical to
    batchpid's. "ros2_control" is the YAML of a controller. "mjcf" is the robot with the law in
    MuJoCo's own actuators, "urdf" the robot with its repairs. Differences between the file and
    batchpid's law or the robot's file are printed, one line each.
    """

    robot: flags.RobotName = "panda"
    gains: flags.Gains = None
    to: Literal["c", "ros2_control", "mjcf", "urdf"] = "c"
    """Target."""
    actuators: flags.Actuators = None
    controller: Literal["joint_trajectory_controller", "pid_controller"] = (
        "joint_trajectory_controller"
    )
    """Controller of ros2_control."""
    timestep: Annotated[float, Field("seconds, not a rate: 1/1000", low=1e-6, high=1.0)] = 1 / 1000
    """Time step of the control on the robot, or of the physics [s]."""
    limits: flags.Switch = False
    """Limit setpoints to the robot's joint limits and speeds before they reach the law."""
    prefix: str = "batchpid"
    """Beginning of every name in the file; in ros2_control the name of the controller."""
    dynamics: flags.Switch = False
    """In C, add the robot's mass matrix, gravity and bias as functions."""
    motors: flags.Switch = False
    """In MJCF, write the motors without the law: their inputs are the efforts asked for."""
    strict: flags.Switch = False
    """End with an error if the target's law differs."""
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    out: flags.OptionalPath = None
    """File to write. Default: out/ROBOT-pid.h, or another ending."""
    force: flags.Force = False

    imports = ("batchpid.sim.robot.robot_model", "batchpid.sim.tuning.gain_sets", "batchpid.export")

    def run(self) -> None:
        """Run the command."""
        from batchpid.errors import InvalidArgumentError
        from batchpid.io.files import write_atomically
        from batchpid.sim.robot.urdf_export import to_urdf
        from batchpid.sim.tuning.gain_sets import gain_set

        out = self.out or FOLDER / f"{Path(self.robot).stem}{FILES[self.to]}"
        out = OutputFiles(self).path("out", out, (Path(FILES[self.to]).suffix,))
        known = {name for names in USED.values() for name in names}
        unused = [
            entry.name for entry in fields(self) if entry.name in known.difference(USED[self.to])
        ]
        flags.refuse(self, unused, f"has no effect with --to {self.to}")
        robot = Robot.load(self.robot, actuators=self.actuators, **vars(self.meshes))
        if self.to == "urdf":
            exported = to_urdf(robot, out.absolute().parent)
            content = f"{robot.name}, {robot.dof} joints, without need of repair"
        elif self.motors:
            if self.gains is not None or self.limits:
                raise InvalidArgumentError(
                    "motors", "are written without a law", remedy="leave out --gains and --limits"
                )
            exported, content = (
                _mjcf(robot, None, self.timestep, False),
                f"motors of {robot.dof} joints",
            )
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
            raise InvalidArgumentError(
                "to", "; ".join(differences), value=self.to, remedy="leave out --strict"
            )
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, _with_differences(exported, COMMENTS.get(self.to, "# {}")))
        for difference in differences:
            print(f"differs: {difference}")
        print(f"written: {out}: {content}")

    def _exported(self, robot: Robot, params: bp.PIDParams) -> Exported:
        """Return the file of a target for gains."""
        from batchpid.export import to_c, to_ros2_control

        if self.to == "mjcf":
            return _mjcf(robot, params, self.timestep, self.limits)
        joints, followers = (
            [robot.joint_names[at] for at in np.flatnonzero(mask)]
            for mask in (robot.independent, ~robot.independent)
        )
        notes = list[str]()
        if followers:
            place = (
                "joints of their own in the file; ignore their efforts"
                if self.to == "c"
                else "not in the file"
            )
            notes.append(f"{', '.join(followers)}: followers are {place}")
        if self.to == "c":
            guard = robot.guard() if self.limits else None
            tree = robot.kinematic_tree() if self.dynamics else None
            exported = to_c(
                params,
                self.timestep,
                joint_names=robot.joint_names,
                guard=guard,
                prefix=self.prefix,
                tree=tree,
            )
        else:
            notes += [UNLIMITED] if self.limits else []
            exported = to_ros2_control(
                params.for_joints(robot.independent),
                joints,
                self.timestep,
                controller=self.controller,
                name=self.prefix,
                inertia=_inertia(robot)[:, robot.independent],
            )
        return exported._replace(differences=(*exported.differences, *notes))


def _with_differences(exported: Exported, comment: str) -> str:
    """Return the text, with a comment for each difference that it does not hold yet."""
    sentences = [
        " ".join(difference.split()).replace("--", "- -").replace("*/", "* /")
        for difference in exported.differences
    ]
    lines = "".join(
        f"{comment.format(f'differs: {each}')}\n" for each in sentences if each not in exported.text
    )
    declaration, end, rest = (
        exported.text.partition("?>\n") if exported.text.startswith("<?xml") else ("", "", "")
    )
    return f"{declaration}{end}{lines}{rest}" if end else f"{lines}{exported.text}"


def _mjcf(robot: Robot, params: bp.PIDParams | None, dt: float, limits: bool) -> Exported:
    """Return the MJCF of the robot with its motors."""
    from batchpid.sim.engine.protocol import load_engine

    load_engine("mujoco")  # raises without MuJoCo
    from batchpid.sim.engine.mujoco.mjcf_export import to_mjcf

    guard = robot.guard() if limits else None
    return to_mjcf(
        robot, params, dt, actuators=robot.actuators, guard=guard, inertia=_inertia(robot)
    )


def _inertia(robot: Robot) -> np.ndarray:
    """Return the inertia of the joints (poses, dof), 1 for followers, at the start pose, then at
    sampled poses.
    """
    matrices = robot.mass_matrix(np.vstack([robot.start, robot.sample(POSES)]))
    matrices = robot.coupling.mass_matrix(matrices)
    return np.diagonal(matrices, axis1=1, axis2=2)
