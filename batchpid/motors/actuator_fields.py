"""Fields of :class:`batchpid.Actuators`, grouped by the quantity that they modify."""

from __future__ import annotations

import math

NEUTRAL: dict[str, float] = {
    "command_delay": 0.0,
    "sensor_delay": 0.0,
    "lag": 0.0,
    "strength": 1.0,
    "bias": 0.0,
    "saturation_effort": math.inf,
    "no_load_speed": math.inf,
    "effort_limit": math.inf,
    "coulomb": 0.0,
    "static": 0.0,
    "viscous": 0.0,
    "armature": 0.0,
    "backlash": 0.0,
    "position_resolution": 0.0,
    "velocity_resolution": 0.0,
    "position_noise": 0.0,
    "velocity_noise": 0.0,
}
"""Numbers of a joint, with the value that is off."""
TABLE = "limit_efforts"
"""Numbers of each point of a joint's position-dependent limit."""
JOINT_SIDE = ("coulomb", "static", "viscous", "armature")
"""Fields that act on the joint and not on the signals: :class:`batchpid.sim.Runner` gives them to the simulator."""
SENSOR_SIDE = (
    "sensor_delay",
    "backlash",
    "position_resolution",
    "velocity_resolution",
    "position_noise",
    "velocity_noise",
)
"""Fields between the joint's state and its measurement."""
MOTOR_SIDE = (
    "command_delay",
    "lag",
    "strength",
    "bias",
    "saturation_effort",
    "no_load_speed",
    "effort_limit",
    "limit_positions",
    "limit_efforts",
)
"""Fields between the effort asked for and the effort delivered."""
MAX_DELAY = 1.0
"""Longest delay [s]."""
