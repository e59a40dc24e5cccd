"""Actuators of a robot: checked against its joints and the control."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.checks.validate import instance
from batchpid.errors import InvalidArgumentError
from batchpid.motors import DRIVEN, JOINT_SIDE
from batchpid.sim.robot.description import RobotDescription

BAND = {"rad": 1e-4, "m": 2e-5}
"""Half width, by the joint's unit, of the band in which the compensation of friction is less than
the friction.
"""
FRICTION_SHARE = 0.8
"""Share of the robot's own actuators' Coulomb friction that is compensated.

Overcompensated friction lets a joint oscillate about its setpoint (C. Canudas de Wit, "Robust
control for servo-mechanisms under inexact friction compensation", Automatica 29, 1993). Friction
identified from a log is inexact; friction in the robot's description is exact, because the joint is
simulated with it.
"""


class KnownJoints(NamedTuple):
    """Joints as a controller knows them, in addition to the robot's description, (dof,)."""

    coulomb: NDArray[np.float64]
    """Coulomb friction to compensate [N m or N]."""
    viscous: NDArray[np.float64]
    """Viscous damping [N m s/rad or N s/m]."""
    armature: NDArray[np.float64]
    """Reflected inertia of the motors [kg m^2 or kg]."""


def known_joints(robot: RobotDescription) -> KnownJoints:
    """Return friction, damping and armature of the robot's own actuators, which its controller
    knows.
    """
    if robot.actuators is None:
        motors = bp.Actuators()
    else:
        motors = robot.actuators
    coulomb, viscous, armature = (
        np.zeros(robot.dof) if leaf is None else leaf[0].astype(float)
        for leaf in (motors.coulomb, motors.viscous, motors.armature)
    )
    return KnownJoints(FRICTION_SHARE * coulomb, viscous, armature)


def load_robot_actuators(
    source: bp.Actuators | str | Path, robot: RobotDescription
) -> bp.Actuators:
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


def fit_actuators(
    actuators: bp.Actuators, robot: RobotDescription, num_envs: int, control: object
) -> bp.Actuators:
    """Return ``actuators`` if they fit robot and control, with the robot's continuous joints.

    Followers have no motor: their bias, friction and armature are left out. Raises
    InvalidArgumentError if they do not fit.
    """
    instance("actuators", actuators, bp.Actuators, "build them with make_actuators()")
    actuators.check(num_envs, robot.joint_names)
    if control == "drive" and (
        actuators.measures or actuators.delivers or actuators.load_friction is not None
    ):
        raise InvalidArgumentError(
            "actuators",
            "act on efforts and measurements, or need the effort, and PhysX's drives bypass all"
            " three",
            remedy=f"use control 'pid', or leave only {', '.join(DRIVEN)}",
        )
    # Ideal ones have no leaf that a joint could change.
    if not actuators.num_joints:
        return actuators
    motors = {name: getattr(actuators, name) for name in ("bias", *JOINT_SIDE)}
    # The leader carries friction and armature of its followers.
    motors = {name: leaf * robot.independent for name, leaf in motors.items() if leaf is not None}
    return actuators.replace(**motors, continuous=robot.continuous)
