"""Sets of gains by name: those of a robot, of its file, of a drive, or of a params file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim.diagnosis.causes import table
from batchpid.sim.options.groups import ControlMode
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_options import tuned_file

DRIVE = (20.0, 5.0)
"""Stiffness [N m/rad] and damping [N m s/rad] of the drive in SAPIEN's tutorial."""


class GainSet(NamedTuple):
    """Params with a name, and the control of :class:`batchpid.sim.Runner` that they are for."""

    name: str
    params: bp.PIDParams
    control: ControlMode = "pid"


def gain_set(robot: Robot, name: str | None = None) -> GainSet:
    """Return the gains of ``robot`` by name; default "tuned" where the robot has them, else
    "designed".

    "tuned" gains ship with the robot, "designed" is :meth:`batchpid.sim.Robot.designed`, "sapien-tutorial"
    are the gains in SAPIEN's tutorial, for a bundled robot, "mjcf" is
    :meth:`batchpid.sim.Robot.mjcf_gains`; "drive" is the engine's internal drive with the stiffness and
    damping of :data:`DRIVE`. Other names are params files.

    Raises
    ------
    InvalidArgumentError
        There is no such name or file, or the robot lacks these gains.
    """
    if name is None:
        name = "designed" if tuned_file(robot) is None else "tuned"
    named = {
        "tuned": robot.tuned,
        "designed": robot.designed,
        "sapien-tutorial": robot.params,
        "mjcf": robot.mjcf_gains,
    }
    if name in named:
        return GainSet(name, named[name]())
    if name == "drive":
        stiffness, damping = DRIVE
        params = robot.params(kp=stiffness, ki=0.0, kd=damping, effort_limit=None)
        return GainSet(f"drive ({stiffness:g}, {damping:g})", params, "drive")
    path = Path(name)
    if not path.is_file():
        remedy = f"use {', '.join(named)}, drive, or a params file"
        raise InvalidArgumentError(
            "gains", "is neither a name nor a file", value=name, remedy=remedy
        )
    return GainSet(path.name, bp.load_params(path, robot.joint_names)[0])


def default_sets(robot: Robot) -> tuple[str, ...]:
    """Return the names of the sets that are compared by default."""
    if robot.settings:
        return ("tuned", "sapien-tutorial", "drive")
    return ("designed", "drive")


def gain_table(robot: Robot, params: bp.PIDParams) -> str:
    """Return a table of the gains as efforts per error at the robot's start pose, of the first
    env.

    Gains of accelerations are multiplied by the inertia of each joint.
    """
    inertia = np.ones(robot.dof)
    if params.gain_units is not None:
        inertia = np.diagonal(robot.mass_matrix(robot.start)[0])
    rows = []
    for index, joint in enumerate(robot.joints):
        cells = [f"{joint.name} [{joint.effort_unit}/{joint.unit}]"]
        for gains in (params.kp, params.ki, params.kd):
            gain = 0.0 if gains is None else inertia[index] * np.asarray(gains)[0, index]
            cells.append(f"{gain:.3g}")
        rows.append(cells)
    return table(rows, ("gains at the start pose", "kp", "ki, per s", "kd, s"), "lrrr")
