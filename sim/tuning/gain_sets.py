"""Gain sets by name, as the command line takes them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.export.ros2_control_reader import from_ros2_control, is_ros2_control
from batchpid.io import documents
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner_keywords import ControlMode

NAMES = ("tuned", "designed", "tutorial", "mjcf", "drive")
"""Names of gain sets; "drive" is "drive:20,5"."""


class GainSet(NamedTuple):
    """Params with a name, and the control of :class:`batchpid.sim.Runner` that they are for."""

    name: str
    params: bp.PIDParams
    control: ControlMode = "pid"


def gain_set(robot: Robot, name: str | None = None) -> GainSet:
    """Return the gains of ``robot`` by name; default "tuned" where the robot has them, else "designed".

    "tuned" gains ship with the robot, "designed" is :meth:`batchpid.sim.Robot.designed`, "tutorial" are the gains in
    SAPIEN's tutorial, for a bundled robot, "mjcf" is :meth:`batchpid.sim.Robot.mjcf_gains`; "drive" or
    "drive:STIFFNESS,DAMPING" is the engine's internal drive. Other names are params files, or files of ros2_control,
    whose differences from the law are warnings.

    Raises
    ------
    InvalidArgumentError
        There is no such name or file, or the robot lacks these gains.
    """
    name = name or ("tuned" if robot.has_tuned else "designed")
    named = {"tuned": robot.tuned, "designed": robot.designed, "tutorial": robot.params, "mjcf": robot.mjcf_gains}
    if name in named:
        return GainSet(name, named[name]())
    if name.partition(":")[0] == "drive":
        try:
            stiffness, damping = map(float, (name.partition(":")[2] or "20,5").split(","))
        except ValueError:
            raise InvalidArgumentError(
                "gains", "is not a drive", value=name, remedy="write drive:STIFFNESS,DAMPING, e.g. drive:20,5"
            ) from None
        params = robot.params(kp=stiffness, ki=0.0, kd=damping, effort_limit=None)
        return GainSet(f"drive ({stiffness:g}, {damping:g})", params, "drive")
    path = Path(name)
    if not path.is_file():
        raise InvalidArgumentError(
            "gains", "is neither a name nor a file", value=name, remedy=f"use a file or {', '.join(NAMES)}"
        )
    if path.suffix.lower() != ".json" and is_ros2_control(documents.read(path)):
        return GainSet(path.name, _of_ros2_control(robot, path))
    return GainSet(path.name, bp.load_params(path, robot.joint_names)[0])


def _of_ros2_control(robot: Robot, path: Path) -> bp.PIDParams:
    """Return the params in a file of ros2_control; followers, which it does not name, get their leaders' gains."""
    own = robot.independent
    joints = [name for name, independent in zip(robot.joint_names, own, strict=True) if independent]
    found = from_ros2_control(path.read_text(), joints, continuous=robot.continuous[own])
    for each in found.differences:
        warnings.warn(f"{path}: {each}", stacklevel=3)
    return (
        found.params
        if robot.coupling is None
        else found.params.for_joints(robot.coupling.of_all(np.arange(len(joints))))
    )
