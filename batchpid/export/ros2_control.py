"""Gains as parameters of ros2_control: joint_trajectory_controller on effort, or pid_controller.

Both run control_toolbox's PID (ros-controls/control_toolbox 6, src/pid.cpp; ros2_controllers, their parameter files).
With the error e and its rate e'::

    u      = p e + I + d e'
    effort = min(max(u, u_clamp_min), u_clamp_max) + ff_velocity_scale r' + desired effort
    I     <- I + dt i e                        none
    I     <- I + dt (i e + (clamped u - u) / tracking_time_constant)   back_calculation, where i > 0
    I     <- I + dt i e unless clamped and e u > 0                     conditional_integration
    I     <- min(max(I, i_clamp_min), i_clamp_max)

I stays where |e| <= error_deadband. The trajectory controller takes e' from the measured velocity and the trajectory's,
the pid_controller with one interface from successive errors. A derivative weight c is
ff_velocity_scale = d (c - 1), as kd (c r' - y') = kd (r' - y') + kd (c - 1) r'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Array, Document
from batchpid.arrays.choices import MeasuredRate
from batchpid.checks.validate import choice
from batchpid.errors import InvalidArgumentError
from batchpid.export.differences import Differences, Exported, plain, strategies
from batchpid.io import documents
from batchpid.law.params import PIDParams

TYPES = {
    "joint_trajectory_controller": "joint_trajectory_controller/JointTrajectoryController",
    "pid_controller": "pid_controller/PidController",
}
STRATEGIES = {
    "none": "none",
    "back_calculation": "back_calculation",
    "conditional": "conditional_integration",
}
"""Anti-windup of make_params, and what control_toolbox calls it."""
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
    """Return the YAML of a controller manager with one controller, and its differences from the law.

    Parameters
    ----------
    params
        Of one env: (1, joints).
    joint_names
        Names of the joints in the robot's URDF.
    dt
        Time step of the controller manager [s]; its ``update_rate`` is a whole number of hertz.
    controller
        ``"joint_trajectory_controller"``, or ``"pid_controller"``: with position and velocity for params with the
        measured rate, else with the position alone.
    name
        Of the controller. Default: ``controller``.
    inertia
        Diagonal of the mass matrix (joints,) or (poses, joints) [kg m^2 or kg]: gains per unit of inertia are converted
        at the first pose, and differences of phase are given at its crossover.

    Raises
    ------
    InvalidArgumentError
        Params for several envs, gains per inertia without ``inertia``, or limits that the target refuses.
    """
    choice("controller", controller, TYPES)
    found = Differences(params, joint_names, dt, inertia)
    if params.dtype != np.float64:
        found.append(f"dtype: the target computes in float64, these params are {params.dtype}")
    given = found.params
    trajectory = controller == "joint_trajectory_controller"
    two = trajectory or isinstance(given.measurement_rate, MeasuredRate)
    gains = _gains(found, "ff_velocity_scale" if trajectory else "feedforward_gain", two)
    if given.continuous is not None and not trajectory:
        for joint, wraps in zip(found.joints, given.continuous[0] > 0, strict=True):
            gains[joint]["angle_wraparound"] = bool(wraps)
    _compare(found, two, trajectory)
    rate = round(1 / found.dt)
    if not math.isclose(rate * found.dt, 1.0, rel_tol=1e-9):
        found.append(f"dt: the update rate is a whole number: {rate} Hz instead of {1 / found.dt:.6g} Hz")
    if rate < 1:
        raise InvalidArgumentError("dt", "is more than a second", value=dt, remedy="use a rate of at least 1 Hz")
    name = name or controller
    interfaces = ["position", "velocity"] if two else ["position"]
    body: Document
    if trajectory:
        body = {"joints": found.joints, "command_interfaces": ["effort"], "state_interfaces": interfaces}
    else:
        body = {"dof_names": found.joints, "command_interface": "effort", "reference_and_state_interfaces": interfaces}
    document = {
        "controller_manager": {"ros__parameters": {"update_rate": rate, name: {"type": TYPES[controller]}}},
        name: {"ros__parameters": {**body, "gains": gains}},
    }
    return Exported(f"{found.opening('PID gains')}{documents.render(document, 'yaml')}", tuple(found))


def _gains(found: Differences, feedforward: str, two: bool) -> dict[str, Document]:
    """Return the gains of each joint, by name."""
    params, gains = found.params, {}
    for at, (joint, strategy) in enumerate(zip(found.joints, strategies(found.params), strict=True)):
        own: Document = dict(NEUTRAL)
        for key, leaf in LEAVES.items():
            if (values := getattr(params, leaf)) is not None:
                own[key] = plain(values, at)
        if own["u_clamp_min"] >= own["u_clamp_max"]:
            problem, value = "must be below effort_max for control_toolbox", own["u_clamp_min"]
            raise InvalidArgumentError("effort_min", problem, joint=joint, value=value, remedy="widen the limits")
        own["i_clamp_min"], own["i_clamp_max"] = min(own["i_clamp_min"], 0.0), max(own["i_clamp_max"], 0.0)
        if strategy == "back_calculation":
            own["tracking_time_constant"] = plain(params.tracking_time, at)
        own["antiwindup_strategy"] = STRATEGIES[strategy]
        if two:
            weight = params.setpoint_weight_derivative
            own[feedforward] = 0.0 if weight is None else own["d"] * (plain(weight, at) - 1.0)
        gains[joint] = own
    return gains


def _compare(found: Differences, two: bool, trajectory: bool) -> None:
    """Add the differences between the law and control_toolbox's."""
    params = found.params
    low, high = found.value("effort_min", -math.inf), found.value("effort_max", math.inf)
    limited = np.isfinite(low) | np.isfinite(high)
    weight = found.value("setpoint_weight_derivative", 1.0 if two else 0.0)  # of the rate given, or of a difference
    acts = found.value("kd") > 0
    if limited.any():
        text = "u_clamp limits the PID alone, not its sum with a feedforward such as gravity compensation"
        found.append(f"effort_limit: {text}")
    found.lack("effort_rate_limit", "the change of the effort is not limited", math.inf, "N m/s or N/s")
    found.lack("setpoint_weight", "P acts on the whole setpoint (b = 1), so steps overshoot more", 1.0)
    if two and (acts & (weight != 1)).any():
        text = "written as a feedforward of the desired velocity, which differences of setpoints do not enter"
        found.append(f"setpoint_weight_derivative: {text}{', added after u_clamp' if limited.any() else ''}")
    elif not two and (acts & (weight != 1)).any():
        weights = found.listed(weight, acts)
        text = f"the derivative acts on the whole error (c = 1), so a step of the setpoint kicks it; here c = {weights}"
        found.append(f"setpoint_weight_derivative: {text}")
    if params.derivative_filter_time is not None and acts.any():
        values = found.value("derivative_filter_time")
        phase = found.phase(params._replace(derivative_filter_time=None))
        times = found.listed(values, values > 0)
        found.append(f"derivative_filter_time: the derivative is not filtered: {times} s{phase}")
    if two and acts.any() and not isinstance(params.measurement_rate, MeasuredRate):
        phase = found.phase(params._replace(measurement_rate=MeasuredRate()))
        found.append(f"measurement_rate: the derivative is the measured velocity, not a difference{phase}")
    half = found.value("deadband")
    if (half > 0).any():
        more = found.listed(found.value("kp") * half, half > 0)
        found.append(f"deadband: it only stops the integral; P is larger by up to {more} N m or N")
    if params.integration is not None and found.value("ki").any():
        phase = found.phase(params._replace(integration=None))
        found.append(f"integration: the present error enters the integral after the output, a step later{phase}")
    if params.first_derivative is not None and params.setpoint_weight_derivative is not None:
        found.append(f"first_derivative: no kick: {'rates are given' if two else 'the first setpoint is the position'}")
    if params.non_finite is not None:
        found.append("non_finite: the effort is NaN, or not written, after an input that is not finite")
    if params.continuous is not None and trajectory:
        found.append("continuous: taken from the type of the joint in robot_description")
    elif params.continuous is not None and not two and acts.any():
        found.append("continuous: where the error wraps, the derivative has a spike of kd 2 pi / dt")
    _compare_anti_windup(found, low, high, limited)


def _compare_anti_windup(found: Differences, low: Array, high: Array, limited: Any) -> None:
    params = found.params
    used = np.array(strategies(params))
    for key, sign in (("integral_min", 1), ("integral_max", -1)):
        values = found.value(key, -sign * math.inf)
        if (beyond := sign * values > 0).any():
            found.append(f"{key}: the integral's limits include 0: {found.listed(0 * values, beyond)}")
    if params.ki is None:
        return
    if (odd := (used == "conditional") & ((low > 0) | (high < 0))).any():
        text = "conditional integration takes the sign of the whole effort, wrong where the limits exclude 0"
        found.append(f"anti_windup: {text}: {found.listed(low, odd)}")
    back, ki = used == "back_calculation", found.value("ki")
    if (off := back & (ki == 0)).any():
        found.append(f"anti_windup: without ki the integral does not track: {found.listed(ki, off)}")
    if (limited & back & (ki > 0)).any():
        found.append("anti_windup: back-calculation is left out in a step with an error of exactly 0")
    if (short := back & (found.value("tracking_time", math.inf) < found.dt)).any():
        times = found.listed(found.value("tracking_time"), short)
        found.append(f"tracking_time: shorter than dt, the integral over-corrects: {times} s, dt {found.dt:g} s")
    if params.effort_rate_limit is not None and (used != "none").any():
        found.append("anti_windup: acts on u_clamp alone, not on a limit of the effort's rate")
