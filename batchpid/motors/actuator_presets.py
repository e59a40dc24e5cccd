"""Actuators with the parameters of other simulators' models, by their names.

Each returns :class:`batchpid.Actuators` and takes further options of :func:`batchpid.make_actuators`. The PD laws of
these models are params of the law. Their delays are of setpoint and feedforward, and their laws are not late; a
``command_delay`` is of the effort, the law's reaction included, so that it takes phase margin as well.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Document
from batchpid.checks.validate import integer, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.motors.actuators import Actuators, make_actuators


def dc_motor(
    joints: int, saturation_effort: Array, velocity_limit: Array, effort_limit: Array = math.inf, **options: Any
) -> Actuators:
    """Return the motor of DCMotor of Isaac Lab (isaaclab/actuators/actuator_pd.py), with the names of DCMotorCfg.

    ``saturation_effort`` is the effort at stall [N m or N], ``velocity_limit`` the speed without load [rad/s or m/s],
    and ``effort_limit`` the continuous effort [N m or N]. Its ``armature`` has the same name here.
    """
    line = {"saturation_effort": saturation_effort, "no_load_speed": velocity_limit, "effort_limit": effort_limit}
    return make_actuators(joints, **line, **options)


def delayed_pd(
    joints: int, timestep: float, min_delay: int, max_delay: int, effort_limit: Array = math.inf, **options: Any
) -> Actuators:
    """Return the delay of DelayedPDActuator of Isaac Lab, with the names of DelayedPDActuatorCfg; here of the effort.

    Its resets draw whole steps from ``min_delay`` to ``max_delay``, the same for all joints of an env. The delay here
    is ``min_delay`` steps of ``timestep`` [s], with histories for ``max_delay``. The steps to add to it are drawn by a
    runner's randomization of ``command_delay`` (docs/randomization.md).
    """
    time_step("timestep", timestep)
    low, high = integer("min_delay", min_delay, 0, 10**6), integer("max_delay", max_delay, min_delay, 10**6)
    delay: Document = {"command_delay": low * timestep, "max_delay": high * timestep}
    return make_actuators(joints, **delay, effort_limit=effort_limit, **options)


def remotized(joints: int, joint_parameter_lookup: Array, **options: Any) -> Actuators:
    """Return the limit of RemotizedPDActuator of Isaac Lab: rows of angle, transmission ratio and largest effort.

    ``joint_parameter_lookup`` is (points, 3) [rad, 1, N m]; the ratio has no effect there either.
    """
    table = np.asarray(joint_parameter_lookup, float)
    return make_actuators(joints, position_limit=(table[:, 0], table[:, 2]), **options)


def isaac_joint(
    joints: int,
    *,
    armature: Array = None,
    friction: Array = None,
    dynamic_friction: Array = None,
    viscous_friction: Array = None,
    **options: Any,
) -> Actuators:
    """Return the joint side of Isaac Lab, with the names of ActuatorBaseCfg, as Isaac Sim 5.0 and later takes it.

    ``friction`` is static and ``dynamic_friction`` Coulomb friction, both efforts [N m or N]. They are added to what
    the robot's description has.
    """
    own = {"armature": armature, "static": friction, "coulomb": dynamic_friction, "viscous": viscous_friction}
    return make_actuators(joints, **own, **options)


def newton(
    joints: int,
    *,
    delay_steps: Array = None,
    timestep: float | None = None,
    max_effort: Array = math.inf,
    saturation_effort: Array = None,
    velocity_limit: Array = None,
    max_motor_effort: Array = math.inf,
    lookup_positions: Array = None,
    lookup_efforts: Array = None,
    **options: Any,
) -> Actuators:
    """Return stages of newton.actuators: Delay, and clamping by MaxEffort, DCMotor and PositionBased.

    Each may be left out. ``delay_steps`` are of ``timestep`` [s], and delay the effort here. Up to the speed
    v0 (1 + L / S) the clamps are the same; beyond it, ClampingDCMotor brakes with more than ``max_motor_effort``, and
    these actuators do not.

    Raises
    ------
    InvalidArgumentError
        There are ``delay_steps`` without ``timestep``, or a number is out of range.
    """
    if delay_steps is not None and timestep is None:
        raise InvalidArgumentError("timestep", "is missing", remedy="give the time step of the delay_steps [s]")
    step = None if timestep is None else time_step("timestep", timestep)
    delay = None if step is None or delay_steps is None else np.multiply(delay_steps, step)
    limit = np.minimum(max_effort, max_motor_effort)
    line = {"saturation_effort": saturation_effort, "no_load_speed": velocity_limit, "effort_limit": limit}
    table = None if lookup_positions is None else (lookup_positions, lookup_efforts)
    return make_actuators(joints, command_delay=delay, position_limit=table, **line, **options)


def mujoco_joint(
    joints: int,
    *,
    armature: Array = None,
    frictionloss: Array = None,
    damping: Array = None,
    forcerange: Array = None,
    dynprm: Array = None,
    **options: Any,
) -> Actuators:
    """Return a joint of MuJoCo with its motor, by the names of its XML.

    ``armature``, ``frictionloss`` and ``damping`` are added to the values of the robot's description. ``forcerange`` is
    symmetric: the largest effort [N m or N]. ``dynprm`` is the time constant [s] of dyntype filterexact with actearly.
    """
    own = {"armature": armature, "coulomb": frictionloss, "viscous": damping, "effort_limit": forcerange, "lag": dynprm}
    return make_actuators(joints, **own, **options)
