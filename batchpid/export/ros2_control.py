"""Gains as parameters of ros2_control: a joint_trajectory_controller on effort.

It runs control_toolbox's PID (ros-controls/control_toolbox 6, src/pid.cpp; ros2_controllers, their
parameter files). With the error e and its rate e'::

    u      = p e + I + d e'
    effort = min(max(u, u_clamp_min), u_clamp_max) + ff_velocity_scale r' + desired effort
    I     <- I + dt i e                        none
    I     <- I + dt (i e + (clamped u - u) / tracking_time_constant)   back_calculation, where i > 0
    I     <- I + dt i e unless clamped and e u > 0                     conditional_integration
    I     <- min(max(I, i_clamp_min), i_clamp_max)

I stays where |e| <= error_deadband. The controller takes e' from the measured velocity and the
trajectory's. A derivative weight c is ff_velocity_scale = d (c - 1), as kd (c r' - y') = kd (r' -
y') + kd (c - 1) r'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Document
from batchpid.errors import InvalidArgumentError
from batchpid.export.differences import Differences, Exported, strategies
from batchpid.io import documents
from batchpid.law.params import FIELDS, PIDParams

TYPE = "joint_trajectory_controller/JointTrajectoryController"
LEAVES = {
    "p": "kp",
    "i": "ki",
    "d": "kd",
    "u_clamp_max": "effort_max",
    "u_clamp_min": "effort_min",
    "i_clamp_max": "integral_max",
    "i_clamp_min": "integral_min",
    "error_deadband": "deadband",
}
"""Gains of the controller, and the option of make_params that each is."""


def to_ros2_control(
    params: PIDParams,
    joint_names: Sequence[str],
    dt: float,
    *,
    name: str = "joint_trajectory_controller",
    inertia: ArrayLike | None = None,
) -> Exported:
    """Return the YAML of a controller manager with one controller, and its differences from the
    law.

    Parameters
    ----------
    params
        Of one env: (1, joints).
    joint_names
        Names of the joints in the robot's URDF.
    dt
        Time step of the controller manager [s]; its ``update_rate`` is a whole number of hertz.
    name
        Of the controller.
    inertia
        Diagonal of the mass matrix (joints,) [kg m^2 or kg], with which gains per mass matrix are
        converted.

    Raises
    ------
    InvalidArgumentError
        Params for several envs, gains per mass matrix without ``inertia``, or limits that the
        target refuses.
    """
    law = Differences(params, joint_names, dt, inertia)
    gains = {joint: _gains(law, at) for at, joint in enumerate(law.joints)}
    # The manager counts in whole hertz; a difference is reported below.
    rate = round(1 / law.dt)
    _compare(law)
    _compare_anti_windup(law)
    text = f"the update rate is a whole number: {rate} Hz instead of {1 / law.dt:.6g} Hz"
    law.add(
        "dt",
        text,
        not math.isclose(rate * law.dt, 1.0, rel_tol=1e-9),
    )
    body = {
        "joints": law.joints,
        "command_interfaces": ["effort"],
        "state_interfaces": ["position", "velocity"],
        "gains": gains,
    }
    manager = {"update_rate": rate, name: {"type": TYPE}}
    document = {
        "controller_manager": {"ros__parameters": manager},
        name: {"ros__parameters": body},
    }
    return Exported(f"{law.opening('PID gains')}{documents.render(document, 'yaml')}", tuple(law))


def _gains(law: Differences, at: int) -> Document:
    """Return the gains of joint number ``at``, by name."""
    params = law.params
    gains = Document()
    for key, option in LEAVES.items():
        leaf = getattr(params, option)
        if leaf is None:
            gains[key] = FIELDS[option].neutral
        else:
            gains[key] = documents.plain(leaf[:, at])
    # The target would refuse the whole file when it starts.
    if gains["u_clamp_min"] >= gains["u_clamp_max"]:
        problem = "must be below effort_max for control_toolbox"
        value = gains["u_clamp_min"]
        raise InvalidArgumentError(
            "effort_min", problem, joint=law.joints[at], value=value, remedy="widen the limits"
        )
    # control_toolbox refuses limits that exclude 0.
    gains["i_clamp_min"] = min(gains["i_clamp_min"], 0.0)
    gains["i_clamp_max"] = max(gains["i_clamp_max"], 0.0)
    strategy = strategies(params)[at]
    tracks = strategy == "back_calculation"
    if strategy == "conditional":
        strategy = "conditional_integration"
    gains["antiwindup_strategy"] = strategy
    gains["tracking_time_constant"] = 0.0
    if tracks:
        gains["tracking_time_constant"] = documents.plain(params.tracking_time[:, at])
    weight = params.setpoint_weight_derivative
    gains["ff_velocity_scale"] = 0.0
    # The target's D acts on the whole rate of the error, c = 1; a feedforward makes up the rest.
    if weight is not None:
        gains["ff_velocity_scale"] = gains["d"] * (documents.plain(weight[:, at]) - 1.0)
    return gains


def _compare(law: Differences) -> None:
    """Add the differences between the law and control_toolbox's, but for anti-windup."""
    # A joint without kd does not show how its derivative is taken.
    acts = law.value("kd") > 0
    text = "u_clamp limits the PID alone, not its sum with a feedforward such as gravity"
    law.add("effort_limit", f"{text} compensation", law.limited)
    law.lack_weights()
    # The weight of a given rate: differences of setpoints do not enter.
    weight = law.value("setpoint_weight_derivative", 1.0)
    text = "a feedforward of the desired velocity, after u_clamp; setpoints"
    law.add(
        "setpoint_weight_derivative", f"{text} are not differentiated", acts & (weight != 1), weight
    )
    time = law.value("derivative_filter_time")
    law.add("derivative_filter_time", "no filter", acts & (time > 0), time, "s")
    text = "the derivative is the measured velocity, not a difference"
    law.add("measurement_rate", text, acts & (law.params.measurement_rate is None))
    law.lack("deadband", "stops the integral alone, and P acts on the whole error", 0.0, "rad or m")
    text = "the effort is NaN, or not written, after an input that is not finite"
    law.add("non_finite", text, law.params.non_finite is not None)
    text = "taken from the type of the joint in robot_description"
    law.add("continuous", text, law.value("continuous") > 0)


def _compare_anti_windup(law: Differences) -> None:
    """Add the differences of the integral's limits and of anti-windup."""
    low, high = law.ends("integral")
    law.add("integral_min", "at most 0 in the target", low > 0, low)
    law.add("integral_max", "at least 0 in the target", high < 0, high)
    if law.params.ki is None:
        return
    strategy = np.array(strategies(law.params))
    integrates = law.value("ki") > 0
    back = strategy == "back_calculation"
    low, high = law.ends("effort")
    text = "conditional integration uses the sign of the effort, wrong where the limits"
    excludes = (low > 0) | (high < 0)
    law.add("anti_windup", f"{text} exclude 0", (strategy == "conditional") & excludes)
    law.add("anti_windup", "without ki the integral does not track", back & ~integrates)
    text = "back-calculation is left out in a step with an error of exactly 0"
    law.add("anti_windup", text, law.limited & back & integrates)
    times = law.value("tracking_time", math.inf)
    text = "below dt the integral over-corrects"
    law.add("tracking_time", text, back & (times < law.dt), times, "s")
