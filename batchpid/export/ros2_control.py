"""Gains as parameters of ros2_control: joint_trajectory_controller on effort, or pid_controller.

Both run control_toolbox's PID (ros-controls/control_toolbox 6, src/pid.cpp; ros2_controllers, their
parameter files). With the error e and its rate e'::

    u      = p e + I + d e'
    effort = min(max(u, u_clamp_min), u_clamp_max) + ff_velocity_scale r' + desired effort
    I     <- I + dt i e                        none
    I     <- I + dt (i e + (clamped u - u) / tracking_time_constant)   back_calculation, where i > 0
    I     <- I + dt i e unless clamped and e u > 0                     conditional_integration
    I     <- min(max(I, i_clamp_min), i_clamp_max)

I stays where |e| <= error_deadband. The trajectory controller takes e' from the measured velocity
and the trajectory's, the pid_controller with one interface from successive errors. A derivative
weight c is ff_velocity_scale = d (c - 1), as kd (c r' - y') = kd (r' - y') + kd (c - 1) r'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Bool, Document
from batchpid.checks.validate import choice
from batchpid.errors import InvalidArgumentError
from batchpid.export.differences import Differences, Exported, plain, strategies
from batchpid.io import documents
from batchpid.law.params import PIDParams

TYPES = {
    "joint_trajectory_controller": "joint_trajectory_controller/JointTrajectoryController",
    "pid_controller": "pid_controller/PidController",
}
NEUTRAL = {
    "p": 0.0,
    "i": 0.0,
    "d": 0.0,
    "u_clamp_max": math.inf,
    "u_clamp_min": -math.inf,
    "i_clamp_max": math.inf,
    "i_clamp_min": -math.inf,
    "antiwindup_strategy": "none",
    "tracking_time_constant": 0.0,
    "error_deadband": 0.0,
}
"""Gains that both controllers have, with their defaults."""
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
"""Gains that are an option of make_params."""


def to_ros2_control(
    params: PIDParams,
    joint_names: Sequence[str],
    dt: float,
    *,
    controller: str = "joint_trajectory_controller",
    name: str | None = None,
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
    controller
        ``"joint_trajectory_controller"``, or ``"pid_controller"``: with position and velocity for
        params with the measured rate, else with the position alone.
    name
        Of the controller. Default: ``controller``.
    inertia
        Diagonal of the mass matrix (joints,) or (poses, joints) [kg m^2 or kg]: gains per mass
        matrix are converted at the first pose.

    Raises
    ------
    InvalidArgumentError
        Params for several envs, gains per mass matrix without ``inertia``, or limits that the
        target refuses.
    """
    choice("controller", controller, TYPES)
    law = Differences(params, joint_names, dt, inertia)
    trajectory = controller == "joint_trajectory_controller"
    two = trajectory or law.params.measurement_rate is not None
    gains = _gains(law, trajectory, two)
    rate = round(1 / law.dt)
    if rate < 1:
        raise InvalidArgumentError(
            "dt", "is more than a second", value=dt, remedy="use a rate of at least 1 Hz"
        )
    law.add(
        "dtype",
        f"the target computes in float64, these params are {params.dtype}",
        params.dtype != np.float64,
    )
    _compare(law, two, trajectory)
    _compare_anti_windup(law)
    uneven = not math.isclose(rate * law.dt, 1.0, rel_tol=1e-9)
    law.add(
        "dt", f"the update rate is a whole number: {rate} Hz instead of {1 / law.dt:.6g} Hz", uneven
    )

    name = name or controller
    interfaces = ["position", "velocity"] if two else ["position"]
    body: Document
    if trajectory:
        body = {
            "joints": law.joints,
            "command_interfaces": ["effort"],
            "state_interfaces": interfaces,
        }
    else:
        body = {
            "dof_names": law.joints,
            "command_interface": "effort",
            "reference_and_state_interfaces": interfaces,
        }
    document = {
        "controller_manager": {
            "ros__parameters": {"update_rate": rate, name: {"type": TYPES[controller]}}
        },
        name: {"ros__parameters": {**body, "gains": gains}},
    }
    return Exported(f"{law.opening('PID gains')}{documents.render(document, 'yaml')}", tuple(law))


def _gains(law: Differences, trajectory: bool, two: bool) -> dict[str, Document]:
    """Return the gains of each joint, by name."""
    params, gains = law.params, {}
    for at, (joint, strategy) in enumerate(zip(law.joints, strategies(params), strict=True)):
        entry: Document = dict(NEUTRAL)
        for key, leaf in LEAVES.items():
            if (values := getattr(params, leaf)) is not None:
                entry[key] = plain(values, at)
        if entry["u_clamp_min"] >= entry["u_clamp_max"]:
            problem, value = "must be below effort_max for control_toolbox", entry["u_clamp_min"]
            raise InvalidArgumentError(
                "effort_min", problem, joint=joint, value=value, remedy="widen the limits"
            )
        entry["i_clamp_min"], entry["i_clamp_max"] = (
            min(entry["i_clamp_min"], 0.0),
            max(entry["i_clamp_max"], 0.0),
        )
        if strategy == "back_calculation":
            entry["tracking_time_constant"] = plain(params.tracking_time, at)
        entry["antiwindup_strategy"] = (
            "conditional_integration" if strategy == "conditional" else strategy
        )
        if two:
            weight = params.setpoint_weight_derivative
            feedforward = "ff_velocity_scale" if trajectory else "feedforward_gain"
            entry[feedforward] = 0.0 if weight is None else entry["d"] * (plain(weight, at) - 1.0)
        if params.continuous is not None and not trajectory:
            entry["angle_wraparound"] = bool(params.continuous[0, at] > 0)
        gains[joint] = entry
    return gains


def _compare(law: Differences, two: bool, trajectory: bool) -> None:
    """Add the differences between the law and control_toolbox's, but for anti-windup."""
    acts, limited = law.value("kd") > 0, _limited(law)
    problem = (
        "u_clamp limits the PID alone, not its sum with a feedforward such as gravity compensation"
    )
    law.add("effort_limit", problem, limited)
    law.lack(
        "effort_rate_limit", "the change of the effort is not limited", math.inf, "N m/s or N/s"
    )
    law.lack(
        "setpoint_weight", "P acts on the whole setpoint (b = 1), so steps overshoot more", 1.0
    )
    # The weight of a given rate, or of a difference of setpoints.
    weight = law.value("setpoint_weight_derivative", 1.0 if two else 0.0)
    problem = "the derivative acts on the whole error (c = 1), so a step of the setpoint kicks it"
    if two:
        problem = (
            "a feedforward of the desired velocity, after u_clamp, which differences of setpoints"
            " do not enter"
        )
    law.add("setpoint_weight_derivative", problem, acts & (weight != 1), weight)
    filter_time = law.value("derivative_filter_time")
    law.add("derivative_filter_time", "no filter", acts & (filter_time > 0), filter_time, "s")
    differences = two and law.params.measurement_rate is None
    law.add(
        "measurement_rate",
        "the derivative is the measured velocity, not a difference",
        acts & differences,
    )
    law.lack("deadband", "stops the integral alone, and P acts on the whole error", 0.0, "rad or m")
    finite = law.params.non_finite is None
    law.add(
        "non_finite",
        "the effort is NaN, or not written, after an input that is not finite",
        not finite,
    )
    turns = law.value("continuous") > 0
    if trajectory:
        law.add("continuous", "taken from the type of the joint in robot_description", turns)
    elif not two:
        law.add(
            "continuous",
            "where the error wraps, the derivative has a spike of kd 2 pi / dt",
            turns & acts,
        )


def _compare_anti_windup(law: Differences) -> None:
    """Add the differences of the integral's limits and of anti-windup."""
    low, high = law.value("integral_min", -math.inf), law.value("integral_max", math.inf)
    law.add("integral_min", "0 at most in the target", low > 0, low)
    law.add("integral_max", "0 at least in the target", high < 0, high)
    if law.params.ki is None:
        return
    strategy = np.array(strategies(law.params))
    integrates = law.value("ki") > 0
    limited = _limited(law)
    back = strategy == "back_calculation"
    excluded = (law.value("effort_min", -math.inf) > 0) | (law.value("effort_max", math.inf) < 0)
    problem = (
        "conditional integration takes the sign of the whole effort, wrong where the limits"
        " exclude 0"
    )
    law.add("anti_windup", problem, (strategy == "conditional") & excluded)
    law.add("anti_windup", "without ki the integral does not track", back & ~integrates)
    problem = "back-calculation is left out in a step with an error of exactly 0"
    law.add("anti_windup", problem, limited & back & integrates)
    times = law.value("tracking_time", math.inf)
    law.add(
        "tracking_time",
        "shorter than dt, the integral over-corrects",
        back & (times < law.dt),
        times,
        "s",
    )
    rate_limited = np.isfinite(law.value("effort_rate_limit", math.inf))
    problem = "acts on u_clamp alone, not on a limit of the effort's rate"
    law.add("anti_windup", problem, rate_limited & (strategy != "none"))


def _limited(law: Differences) -> Bool:
    """Return a mask of the joints with an effort limit."""
    return np.isfinite(law.value("effort_min", -math.inf)) | np.isfinite(
        law.value("effort_max", math.inf)
    )
