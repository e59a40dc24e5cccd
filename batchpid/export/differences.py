"""Results of exports, and the table of differences between the law and its targets.

A target's file holds the law in effort units (:class:`Law`); :func:`differences` compares it with
the target's own law. C is not in the table: its header is this law, bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Bool, Conditional, Document, Float64
from batchpid.checks import array, at_least, instance, names, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.law.coefficients import as_explicit
from batchpid.law.computed_torque import check_gain_units
from batchpid.law.params import LAW_FIELDS, PIDParams
from batchpid.motors.actuators import ACTUATOR_FIELDS, Actuators


class Difference(NamedTuple):
    """Effect of an option in the targets, at the joints at which it is on; "" for the law's."""

    option: str
    ros2_control: str
    mjcf: str
    when: str = ""
    """Name of a condition in :func:`_conditions`; "" if the option is on."""


NO_RATE = "the change of the effort is not limited"
WHOLE = "P acts on the whole setpoint (b = 1), so steps overshoot more"
NO_FILTER = "no filter"
MEASURED = "the derivative is the measured velocity, not a difference"
WRITTEN = {"armature", "viscous", "coulomb", "effort_limit"}
"""Effects of motors that an MJCF file has, as properties of its joints."""
DIFFERENCES = (
    Difference("effort_rate_limit", NO_RATE, NO_RATE),
    Difference("setpoint_weight", WHOLE, WHOLE),
    Difference("derivative_filter_time", NO_FILTER, NO_FILTER),
    Difference(
        "setpoint_weight_derivative",
        "a feedforward of the desired velocity, after u_clamp; setpoints are not differentiated",
        "setpoints have no velocity",
        "weighs",
    ),
    Difference("measurement_rate", MEASURED, MEASURED, "differentiates"),
    Difference("ki", "", "no integral"),
    Difference(
        "deadband",
        "stops the integral alone, and P acts on the whole error",
        "none: P acts on the whole error",
    ),
    Difference(
        "continuous",
        "taken from the type of the joint in robot_description",
        "errors are not taken the short way round",
    ),
    Difference(
        "effort_limit",
        "u_clamp limits the PID alone, not its sum with a feedforward such as gravity compensation",
        "",
        "limited",
    ),
    Difference("integral_limit", "limits contain 0 in the target", "", "begins_outside"),
    Difference(
        "anti_windup", "conditional integration is wrong where limits exclude 0", "", "misled"
    ),
    Difference("anti_windup", "without ki the integral does not track", "", "only_tracks"),
    Difference(
        "anti_windup", "back-calculation is left out at an error of exactly 0", "", "left_out"
    ),
    Difference("tracking_time", "below dt the integral over-corrects", "", "early"),
    *(
        Difference(effect, "", "none in the target")
        for effect in ACTUATOR_FIELDS
        if effect not in WRITTEN
    ),
)
"""Every difference of a target from the law and its motors. C has none."""


NEUTRAL = {
    name: float(field.neutral)
    for fields in (LAW_FIELDS, ACTUATOR_FIELDS)
    for name, field in fields.items()
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
    """Explicit law of one env in effort units, with its motors."""

    joints: list[str]
    dt: float
    """Time step [s]."""
    params: PIDParams
    actuators: Actuators
    conversions: tuple[str, ...]
    """Differences by the conversion to this law."""

    def column(self, option: str) -> Float64:
        """Return an option of the law or its motors (joints,), neutral where it is off."""
        record = self.params if option in self.params._fields else self.actuators
        leaf = getattr(record, option)
        if leaf is None:
            return np.full(len(self.joints), NEUTRAL[option])
        return np.asarray(leaf[0], np.float64)

    def has(self, option: str) -> Bool:
        """Return the mask of the joints at which an option is on."""
        mask: Bool = self.column(option) != NEUTRAL[option]
        return mask

    @property
    def effort_range(self) -> Float64:
        """Limits of the efforts, of law and motor (2, joints) [N m or N]."""
        limit = self.column("effort_limit")
        low = np.maximum(self.column("effort_min"), -limit)
        return np.array([low, np.minimum(self.column("effort_max"), limit)])


def export_law(
    params: PIDParams,
    joint_names: Sequence[str],
    dt: float,
    inertia: ArrayLike | None,
    actuators: Actuators | None = None,
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
    law = Law(joints, dt, explicit, motors, tuple(conversions))
    low, high = law.effort_range
    if (low >= high).any():
        # Other programs refuse such a file when they read it.
        at = int(np.argmax(low >= high))
        problem = "must be below effort_max in other programs"
        remedy = "widen the limits"
        raise InvalidArgumentError(
            "effort_min",
            problem,
            joint=joints[at],
            value=low[at],
            remedy=remedy,
        )
    return law


def differences(
    law: Law, target: Literal["ros2_control", "mjcf"], driven: ArrayLike = True
) -> list[str]:
    """Return sentences ``"option: difference"`` on the target's law, each with its joints unless it
    concerns all.

    The mask ``driven`` has the joints that the target drives.
    """
    sentences = list(law.conversions)
    conditions = _conditions(law)
    for row in DIFFERENCES:
        mask = conditions[row.when] if row.when else law.has(row.option)
        joints = np.array(law.joints)[mask & np.asarray(driven)]
        text = getattr(row, target)
        if not text or not len(joints):
            continue
        here = "" if len(joints) == len(law.joints) else f"; here {', '.join(joints)}"
        sentences.append(f"{row.option}: {text}{here}")
    return sentences


def _conditions(law: Law) -> dict[str, Bool]:
    """Return the joints at which several options together make a difference, by its name."""
    params = law.params
    integrates = law.has("ki")
    derives = law.has("kd")
    limited = law.has("effort_min") | law.has("effort_max")
    excludes = (law.column("effort_min") > 0) | (law.column("effort_max") < 0)
    tracks = law.has("tracking_time")
    return {
        "weighs": derives & (params.setpoint_weight_derivative is not None),
        "differentiates": derives & (params.measurement_rate is None),
        "limited": limited,
        "begins_outside": (law.column("integral_min") > 0) | (law.column("integral_max") < 0),
        "misled": isinstance(params.anti_windup, Conditional) & excludes,
        "only_tracks": tracks & ~integrates,
        "left_out": tracks & integrates & limited,
        "early": tracks & (law.column("tracking_time") < law.dt),
    }
