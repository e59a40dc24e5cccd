"""Actuators and sensors between the controller and the joints: delay, lag, envelope, strength,
resolution.

Build parameters with :func:`make_actuators`; thread a state through :func:`advance_measurement` and
:func:`advance_effort`::

    actuators = bp.make_actuators(joints=7, command_delay=0.005, strength=0.9)
    state = bp.motors.init(actuators, qpos, dt)
    k = bp.motors.discretise(actuators, state, dt)
    state, measured, rate = bp.motors.advance_measurement(k, state, qpos, qvel)
    state, effort = bp.motors.advance_effort(k, state, effort, qvel)

See docs/actuators.md.
"""

from batchpid.arrays.elementwise import replace_envs as reset
from batchpid.motors.actuator_dynamics import (
    MotorCoefficients,
    advance_effort,
    advance_measurement,
    command_limits,
    discretise,
    init,
    measurement_noise,
)
from batchpid.motors.actuators import (
    DRIVEN,
    JOINT_SIDE,
    Actuators,
    ActuatorState,
    dumps_actuators,
    load_actuators,
    loads_actuators,
    make_actuators,
    save_actuators,
)
from batchpid.motors.coupling import Coupling, Follower

__all__ = [
    "DRIVEN",
    "JOINT_SIDE",
    "ActuatorState",
    "Actuators",
    "Coupling",
    "Follower",
    "MotorCoefficients",
    "advance_effort",
    "advance_measurement",
    "command_limits",
    "discretise",
    "dumps_actuators",
    "init",
    "load_actuators",
    "loads_actuators",
    "make_actuators",
    "measurement_noise",
    "reset",
    "save_actuators",
]
