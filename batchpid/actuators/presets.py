"""Actuators with the parameters of other simulators' models, by their names.

Each returns :class:`batchpid.Actuators` and takes further options of :func:`batchpid.make_actuators`. The PD laws of
these models are params of the law; their delays are of the setpoint, which whoever gives the setpoints can delay.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from batchpid.actuators.model import Actuators, make_actuators


def dc_motor(
    joints: int, saturation_effort: Any, velocity_limit: Any, effort_limit: Any = math.inf, **options: Any
) -> Actuators:
    """Return the motor of DCMotor of Isaac Lab (isaaclab/actuators/actuator_pd.py), with the names of DCMotorCfg.

    ``saturation_effort`` is the effort at stall [N m or N], ``velocity_limit`` the speed without load [rad/s or m/s],
    and ``effort_limit`` the continuous effort [N m or N]. Its ``armature`` has the same name here.
    """
    line = {"saturation_effort": saturation_effort, "no_load_speed": velocity_limit, "effort_limit": effort_limit}
    return make_actuators(joints, **line, **options)


def remotized(joints: int, joint_parameter_lookup: Any, **options: Any) -> Actuators:
    """Return the limit of RemotizedPDActuator of Isaac Lab: rows of angle, transmission ratio and largest effort.

    ``joint_parameter_lookup`` is (points, 3) [rad, 1, N m]; the ratio has no effect there either.
    """
    table = np.asarray(joint_parameter_lookup, float)
    return make_actuators(joints, position_limit=(table[:, 0], table[:, 2]), **options)


def newton(
    joints: int,
    *,
    max_effort: Any = math.inf,
    saturation_effort: Any = None,
    velocity_limit: Any = None,
    max_motor_effort: Any = math.inf,
    lookup_positions: Any = None,
    lookup_efforts: Any = None,
    **options: Any,
) -> Actuators:
    """Return the clamping stages of newton.actuators: MaxEffort, DCMotor and PositionBased, of which some may be left.

    Up to the speed v0 (1 + L / S) they are the same. Beyond it, ClampingDCMotor brakes with more than
    ``max_motor_effort``, and these actuators do not.
    """
    limit = np.minimum(max_effort, max_motor_effort)
    line = {"saturation_effort": saturation_effort, "no_load_speed": velocity_limit, "effort_limit": limit}
    table = None if lookup_positions is None else (lookup_positions, lookup_efforts)
    return make_actuators(joints, position_limit=table, **line, **options)


def mujoco_joint(
    joints: int,
    *,
    armature: Any = None,
    frictionloss: Any = None,
    damping: Any = None,
    forcerange: Any = None,
    **options: Any,
) -> Actuators:
    """Return the joint side of MuJoCo, with the names of its XML: armature, frictionloss, damping; and a motor's range.

    They are added to what the robot's description has. ``forcerange`` is symmetric: the largest effort [N m or N].
    """
    own = {"armature": armature, "coulomb": frictionloss, "viscous": damping, "effort_limit": forcerange}
    return make_actuators(joints, **own, **options)
