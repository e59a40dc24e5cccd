"""Results of exports, and the tables of differences between the law and its targets.

A target's file holds the law in effort units (:class:`Law`); :func:`differences` compares it with
the target's own law. C is in no table: its header is this law, bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Bool, Document, Float64
from batchpid.checks import array, at_least, instance, names, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.law.coefficients import as_explicit
from batchpid.law.computed_torque import check_gain_units
from batchpid.law.params import LAW_FIELDS, PIDParams, strategy_names
from batchpid.motors.actuators import ACTUATOR_FIELDS, Actuators
from batchpid.motors.guard import GUARD_FIELDS, Guard

SAME = {
    "effort_rate_limit": "the change of the effort is not limited",
    "setpoint_weight": "P acts on the whole setpoint (b = 1), so steps overshoot more",
    "derivative_filter_time": "no filter",
}
LOST_OPTIONS = {
    "ros2_control": SAME
    | {
        "deadband": "stops the integral alone, and P acts on the whole error",
        "continuous": "taken from the type of the joint in robot_description",
        "non_finite": "the effort is NaN, or not written, after an input that is not finite",
    },
    "mjcf": SAME
    | {
        "deadband": "none: P acts on the whole error",
        "continuous": "errors are not taken the short way round",
        "non_finite": "inputs are not checked",
    },
}
"""Options of the law without an equal in a target, and what it does instead."""
QUOTIENT = "measurement_rate: the derivative is the measured velocity, not a difference"
WRITTEN = {"armature", "viscous", "coulomb", "command_delay", "lag"}
WRITTEN |= {"effort_limit", "saturation_effort", "no_load_speed"}
"""Effects of motors in an MJCF beside the law; without one there are strength and bias, too."""


NEUTRAL = {
    name: float(field.neutral)
    for fields in (LAW_FIELDS, ACTUATOR_FIELDS, GUARD_FIELDS)
    for name, field in fields.items()
    if name != "anti_windup"
}
"""Value of each option with which it is off."""


def check_one_env(params: PIDParams) -> None:
    """Raise InvalidArgumentError unless these are params of one env."""
    instance("params", params, PIDParams, "build them with make_params()")
    if params.num_envs > 1:
        remedy = "choose one env: params.for_envs(slice(k, k + 1))"
        raise InvalidArgumentError("params", f"are for {params.num_envs} envs", remedy=remedy)


class Exported(NamedTuple):
    """Text of a file for a target, and the differences of the target's law from
    :func:`batchpid.step`.
    """

    text: str
    differences: tuple[str, ...] = ()
    """One sentence each; empty where the target computes the same law."""


class Law(NamedTuple):
    """Explicit law of one env in effort units, with its motors and the guard of its setpoints."""

    joints: list[str]
    dt: float
    """Time step [s]."""
    params: PIDParams
    actuators: Actuators
    guard: Guard
    conversions: tuple[str, ...]
    """Differences by the conversion to this law."""
    is_law: bool
    """False for motors without a law."""

    def column(self, option: str) -> Float64:
        """Return an option of the law, its motors or its guard (joints,), neutral where it is off;
        1 for a choice that is on.
        """
        records = (self.params, self.actuators, self.guard)
        record = next(record for record in records if option in record._fields)
        leaf = getattr(record, option)
        if leaf is None:
            return np.full(len(self.joints), NEUTRAL.get(option, 0.0))
        if isinstance(leaf, tuple):
            return np.ones(len(self.joints))
        return np.asarray(leaf[0], np.float64)

    def has(self, option: str) -> Bool:
        """Return the mask of the joints at which an option is on."""
        mask: Bool = self.column(option) != NEUTRAL.get(option, 0.0)
        return mask

    @property
    def strategies(self) -> list[str]:
        """Strategy of anti-windup of each joint, by the names of make_params."""
        params = self.params
        rows = strategy_names(params.num_joints, params.tracking_time, params.conditional)
        return [str(strategy) for strategy in rows[0]]

    @property
    def begins_outside(self) -> Bool:
        """Mask of the joints whose integral begins at a limit, since the limits exclude 0."""
        return (self.column("integral_min") > 0) | (self.column("integral_max") < 0)

    @property
    def effort_range(self) -> Float64:
        """Limits of the efforts, of law and motor (2, joints) [N m or N]."""
        limit = self.column("effort_limit")
        low = np.maximum(self.column("effort_min"), -limit)
        return np.array([low, np.minimum(self.column("effort_max"), limit)])

    @property
    def has_line(self) -> Bool:
        """Mask of the motors with a torque-speed line; one without strength has no effort."""
        return np.isfinite(self.column("saturation_effort")) & (self.column("strength") > 0)

    @property
    def is_dcmotor(self) -> Bool:
        """Mask of the joints whose motor is MuJoCo's ``<dcmotor>``: its PID has neither a line nor
        a lag.
        """
        return self.has_line | (self.is_law & (self.column("lag") > 0))


def export_law(
    params: PIDParams,
    joint_names: Sequence[str],
    dt: float,
    inertia: ArrayLike | None,
    actuators: Actuators | None = None,
    guard: Guard | None = None,
    is_law: bool = True,
) -> Law:
    """Return the law that targets are given: gains converted to efforts at ``inertia`` (joints,)
    [kg m^2 or kg] if they are per unit of it, and to the explicit law at ``dt`` [s] if implicit.

    Raises
    ------
    InvalidArgumentError
        Params or actuators of several envs or of other joints, or gains per mass matrix without
        ``inertia``.
    """
    check_one_env(params)
    joints = names("joint_names", joint_names, params.num_joints)
    dt = time_step("dt", dt)
    params.check(1, joints)
    check_gain_units(params)
    motors = Actuators() if actuators is None else actuators
    instance("actuators", motors, Actuators, "build them with make_actuators()")
    motors.check(1, joints)
    conversions = []
    # No target has the implicit law, but all can have its gains at one time step.
    explicit = as_explicit(params, dt)
    if explicit is not params:
        text = f"gains of the explicit law at dt = {dt:g} s only"
        if np.any(explicit.ki):
            text += "; the integral leads by dt times the rate of the setpoint"
        conversions.append(f"discretization: {text}")
    if inertia is not None:
        inertia = array("inertia", inertia, (len(joints),), joints)
        inertia = at_least("inertia", inertia, np.finfo(float).tiny, joints)
    if explicit.gain_units is not None:
        if inertia is None:
            problem = "is missing for gains per mass_matrix"
            remedy = "pass inertia=, the diagonal of the mass matrix, or gains in effort units"
            raise InvalidArgumentError("inertia", problem, remedy=remedy)
        conversions.append(
            "gain_units: gains in efforts, for one inertia; joints disturb each other"
        )
        scaled: Document = {"gain_units": None}
        for name, leaf in explicit.leaves().items():
            if name in ("kp", "ki", "kd", "integral_min", "integral_max"):
                scaled[name] = (leaf * inertia).astype(explicit.dtype)
        explicit = explicit._replace(**scaled)
    guard = Guard() if guard is None else guard
    return Law(
        joints,
        dt,
        explicit,
        motors,
        guard,
        tuple(conversions),
        is_law,
    )


def differences(
    law: Law, target: Literal["ros2_control", "mjcf"], driven: ArrayLike = True
) -> list[str]:
    """Return sentences ``"option: difference"`` on the target's law, each with its joints unless it
    concerns all.

    The mask ``driven`` has the joints that the target drives.
    """
    rows = _mjcf(law) if target == "mjcf" else _ros2_control(law)
    for option, text in LOST_OPTIONS[target].items():
        rows[f"{option}: {text}"] = law.has(option)
    sentences = list(law.conversions)
    for sentence, mask in rows.items():
        joints = np.array(law.joints)[mask & np.asarray(driven)]
        if len(joints) == len(law.joints):
            sentences.append(sentence)
        elif len(joints):
            sentences.append(f"{sentence}; here {', '.join(joints)}")
    return sentences


def _ros2_control(law: Law) -> dict[str, Bool]:
    """Return differences by several options, and the joints that have them."""
    params = law.params
    integrates = law.has("ki")
    limited = law.has("effort_min") | law.has("effort_max")
    weighs = law.has("kd") & (params.setpoint_weight_derivative is not None)
    differentiates = law.has("kd") & (params.measurement_rate is None)
    excludes = (law.column("effort_min") > 0) | (law.column("effort_max") < 0)
    strategy = np.array(law.strategies)
    misled = (strategy == "conditional") & excludes
    tracks = strategy == "back_calculation"
    early = tracks & (law.column("tracking_time") < law.dt)
    weight = (
        "a feedforward of the desired velocity, after u_clamp; setpoints are not differentiated"
    )
    clamp = "u_clamp limits the PID alone, not its sum with a feedforward such as gravity"
    left_out = tracks & integrates & limited
    return {
        f"setpoint_weight_derivative: {weight}": weighs,
        QUOTIENT: differentiates,
        f"effort_limit: {clamp} compensation": limited,
        "integral_limit: limits contain 0 in the target": law.begins_outside,
        "anti_windup: conditional integration is wrong where limits exclude 0": misled,
        "anti_windup: without ki the integral does not track": tracks & ~integrates,
        "anti_windup: back-calculation is left out at an error of exactly 0": left_out,
        "tracking_time: below dt the integral over-corrects": early,
    }


def _mjcf(law: Law) -> dict[str, Bool]:
    """Return differences by several options or of motors, and the joints that have them."""
    params = law.params
    derives = law.has("kd")
    integrates = law.has("ki")
    bounded = law.has("integral_min") | law.has("integral_max")
    line, is_dcmotor = law.has_line, law.is_dcmotor
    one_sided = -law.column("integral_min") != law.column("integral_max")
    clamps = integrates & bounded & (~is_dcmotor | one_sided)
    weighs = derives & (params.setpoint_weight_derivative is not None)
    late = law.is_law & law.has("command_delay")
    saturates = np.isfinite(law.effort_range).any(0) | line
    winds = saturates & (np.array(law.strategies) != "none")
    weak = np.abs(law.effort_range).min(0) < law.column("effort_limit")
    places = law.has("lower") | law.has("upper")
    guarded = derives & (places | law.has("rate"))
    turns = np.zeros(len(law.joints)) if law.guard.turns is None else law.guard.turns[0]
    written = WRITTEN if law.is_law else WRITTEN | {"strength", "bias"}
    lacking = [effect for effect in ACTUATOR_FIELDS if effect not in written]
    return {
        "setpoint_weight_derivative: acts on the target's velocity alone (c = 1)": weighs,
        QUOTIENT: derives & (params.measurement_rate is None),
        "integral_limit: the integral begins at 0, outside its limits": law.begins_outside,
        "integral_limit: symmetric, and in a <pid> exceeded by up to one step": clamps,
        "anti_windup: the integral grows during saturation, up to its limit": integrates & winds,
        "command_delay: delays the inputs, 0 at first, and not the effort": late,
        "bias: none in a dcmotor": (not law.is_law) & is_dcmotor & law.has("bias"),
        "saturation_effort: none without strength": law.has("saturation_effort") & ~line,
        "saturation_effort: beyond its line a motor brakes within the law's limits": line & weak,
        "lag: acts before the limits of the effort, not after them": law.has("lag") & saturates,
        "guard: the acceleration of the setpoint is not limited": law.has("acceleration"),
        "guard: a dcmotor has no limits of the position alone": is_dcmotor & places,
        "guard: setpoints do not go the short way round": law.has("rate") & (turns > 0),
        "guard: limits the position input, not the velocity input": guarded,
    } | {f"{effect}: none in the target": law.has(effect) for effect in lacking}
