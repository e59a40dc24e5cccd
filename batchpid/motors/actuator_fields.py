"""Fields of :class:`batchpid.Actuators`, grouped by the quantity that they modify."""

from __future__ import annotations

import math

from batchpid.arrays.field_tables import Field

MAX_DELAY = 1.0
"""Longest delay [s]."""
MOTOR_SIDE = {
    "command_delay": Field("s", high=MAX_DELAY),
    "lag": Field("s"),
    "strength": Field("1", 1.0),
    "bias": Field("N m or N", low=-math.inf),
    "saturation_effort": Field("N m or N", math.inf, above=True),
    "no_load_speed": Field("rad/s or m/s", math.inf, above=True),
    "effort_limit": Field("N m or N", math.inf),
}
"""Numbers of a joint between the effort asked for and the effort delivered."""
JOINT_SIDE = {
    "coulomb": Field("N m or N"),
    "static": Field("N m or N"),
    "stribeck": Field("rad/s or m/s"),
    "load_friction": Field("1", high=1.0),
    "viscous": Field("N m s/rad or N s/m"),
    "armature": Field("kg m^2 or kg"),
}
"""Numbers that act on the joint and not on the signals: :class:`batchpid.sim.Runner` gives them to the simulator."""
DRIVEN = tuple(name for name in JOINT_SIDE if name != "load_friction")
"""Effects that joints under drives of the engine have; friction by load needs the motor's effort, which is unknown."""
SENSOR_SIDE = {
    "sensor_delay": Field("s", high=MAX_DELAY),
    "position_offset": Field("rad or m", low=-math.inf),
    "backlash": Field("rad or m"),
    "position_resolution": Field("rad or m"),
    "velocity_resolution": Field("rad/s or m/s"),
    "position_noise": Field("rad or m"),
    "velocity_noise": Field("rad/s or m/s"),
}
"""Numbers between the joint's state and its measurement."""
FIELDS = MOTOR_SIDE | JOINT_SIDE | SENSOR_SIDE
"""Numbers of a joint."""
TABLE = {"limit_efforts": Field("N m or N", math.inf)}
"""Numbers of each point of a joint's position-dependent limit."""
