"""Actuators of a robot: checked against its joints and the control."""

from __future__ import annotations

from pathlib import Path

import batchpid as bp
from batchpid.actuators import JOINT_SIDE, check_actuators
from batchpid.errors import InvalidArgumentError
from batchpid.validate import instance
from sim.robot.description import RobotDescription


def load_robot_actuators(source: bp.Actuators | str | Path, robot: RobotDescription) -> bp.Actuators:
    """Return actuators of ``robot``, given or in a file.

    Raises
    ------
    InvalidArgumentError
        They do not fit the robot, or the file cannot be read.
    FileNotFoundError
        The file does not exist.
    """
    if isinstance(source, str | Path):
        source, _ = bp.load_actuators(source, robot.joint_names)
    return fit_actuators(source, robot, 1, "pid")


def fit_actuators(actuators: bp.Actuators, robot: RobotDescription, num_envs: int, control: object) -> bp.Actuators:
    """Return ``actuators`` if they fit robot and control, with the robot's continuous joints.

    Followers have no motor: their bias, friction and armature are left out.

    Raises
    ------
    InvalidArgumentError
        They do not fit.
    """
    instance("actuators", actuators, bp.Actuators, "build them with make_actuators()")
    check_actuators(actuators, num_envs, robot.joint_names)
    if control == "drive" and (actuators.measures or actuators.delivers):
        raise InvalidArgumentError(
            "actuators",
            "act on efforts and measurements, and PhysX's drives bypass both",
            remedy=f"use control 'pid', or leave only {', '.join(JOINT_SIDE)}",
        )
    if actuators.num_joints is None:
        return actuators
    own = {name: getattr(actuators, name) for name in ("bias", *JOINT_SIDE)}
    own = {name: leaf * robot.independent for name, leaf in own.items() if leaf is not None}
    return actuators.replace(**own, continuous=robot.continuous)
