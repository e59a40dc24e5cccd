"""Results of exports, and the differences between the law and a target, with the figures of this
law.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Array, Bool, Document, Float64
from batchpid.checks.validate import array, at_least, instance, names, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.law.anti_windup import named
from batchpid.law.computed_torque import check_gain_units
from batchpid.law.implicit import as_explicit
from batchpid.law.params import PIDParams
from batchpid.motors.actuators import FIELDS, Actuators


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


class Differences(list[str]):
    """Sentences ``"option: difference"`` about params in effort units, for a target.

    ``params`` are those given, of one env, converted to efforts at ``inertia`` if they were per
    unit of it, and to the explicit law at ``dt`` if they were implicit; ``joints`` their names;
    ``dt`` the time step [s].
    """

    def __init__(
        self,
        params: PIDParams,
        joint_names: Sequence[str],
        dt: float,
        inertia: ArrayLike | None,
    ) -> None:
        super().__init__()
        check_one_env(params)
        self.joints = names("joint_names", joint_names, params.num_joints)
        self.dt = time_step("dt", dt)
        params.check(1, self.joints)
        check_gain_units(params)
        self.params = self._in_efforts(self._explicit(params), inertia)

    def _explicit(self, params: PIDParams) -> PIDParams:
        """Return the params of the explicit law at this time step."""
        # No target has the implicit law, but all can have its gains at one time step.
        explicit = as_explicit(params, self.dt)
        if explicit is not params:
            text = f"gains of the explicit law at dt = {self.dt:g} s only"
            if params.ki is not None and np.any(params.ki > 0):
                text += "; the integral leads by dt times the rate of the setpoint"
            self.append(f"discretization: {text}")
        return explicit

    def _in_efforts(self, params: PIDParams, inertia: ArrayLike | None) -> PIDParams:
        """Return the params with gains in effort units."""
        if inertia is not None:
            inertia = _inertia(inertia, self.joints)
        if params.gain_units is None:
            return params
        if inertia is None:
            problem = "is missing for gains per mass_matrix"
            remedy = "pass inertia=, the diagonal of the mass matrix, or gains in effort units"
            raise InvalidArgumentError("inertia", problem, remedy=remedy)
        text = f"gains in efforts, for one inertia: {self.listed(inertia)} kg m^2"
        self.append(f"gain_units: {text} or kg; joints disturb each other")
        scaled: Document = {"gain_units": None}
        for name, leaf in params.leaves().items():
            if name in ("kp", "ki", "kd", "integral_min", "integral_max"):
                scaled[name] = (leaf * inertia).astype(params.dtype)
        return params._replace(**scaled)

    def value(self, option: str, off: float = 0.0) -> Float64:
        """Return an option of the params (joints,), ``off`` where it is off."""
        return joint_values(getattr(self.params, option), len(self.joints), off)

    def ends(self, limit: str) -> tuple[Float64, Float64]:
        """Return the lower and the upper limit (joints,) of the "effort" or the "integral"."""
        return self.value(f"{limit}_min", -math.inf), self.value(f"{limit}_max", math.inf)

    @property
    def limited(self) -> Bool:
        """Mask of the joints with an effort limit."""
        low, high = self.ends("effort")
        return np.isfinite(low) | np.isfinite(high)

    def listed(self, values: ArrayLike, where: ArrayLike = True) -> str:
        """Return one value for each joint of the mask ``where``, as text: one figure where all are
        the same.
        """
        chosen = np.broadcast_to(where, len(self.joints))
        texts = [f"{value:.4g}" for value in np.asarray(values)]
        if chosen.all() and len(set(texts)) == 1:
            return texts[0]
        named = [f"{joint} {text}" for joint, text in zip(self.joints, texts, strict=True)]
        return ", ".join(np.array(named)[chosen])

    def add(
        self,
        option: str,
        problem: str,
        where: ArrayLike,
        values: ArrayLike | None = None,
        unit: str = "",
    ) -> None:
        """Add a difference of ``option``, if any joint is in the mask ``where``, with this law's
        ``values`` there.
        """
        if np.any(where):
            figures = ""
            if values is not None:
                figures = f"; here {self.listed(values, where)} {unit}".rstrip()
            self.append(f"{option}: {problem}{figures}")

    def lack(
        self,
        option: str,
        problem: str,
        off: float,
        unit: str = "",
    ) -> None:
        """Add an option that the target lacks, where it is on."""
        values = self.value(option, off)
        self.add(option, problem, values != off, values, unit)

    def lack_weights(self) -> None:
        """Add the limit of the effort's rate and the weight of the setpoint in P."""
        text = "the change of the effort is not limited"
        self.lack("effort_rate_limit", text, math.inf, "N m/s or N/s")
        text = "P acts on the whole setpoint (b = 1), so steps overshoot more"
        self.lack("setpoint_weight", text, 1.0)

    def opening(self, title: str) -> str:
        """Return the comments that open a file: its title, and the differences."""
        lines = [f"# {title}, generated by batchpid.\n"]
        lines += [f"# differs: {' '.join(sentence.split())}\n" for sentence in self]
        return "".join(lines)


def joint_values(leaf: Array, joints: int, off: float) -> Float64:
    """Return a leaf of one env (joints,), ``off`` where it is None."""
    if leaf is None:
        return np.full(joints, off)
    return np.asarray(leaf[0], np.float64)


def strategies(params: PIDParams) -> list[str]:
    """Return the anti-windup strategy of each joint of params of one env, by the names of
    make_params.
    """
    names = named(params.num_joints, params.tracking_time, params.conditional)
    return [str(name) for name in names[0]]


def _inertia(inertia: ArrayLike, joints: list[str]) -> Float64:
    """Return inertias (joints,) > 0."""
    row = array("inertia", inertia, (len(joints),), joints)
    return at_least("inertia", row, np.finfo(float).tiny, joints)


EFFECTS = {
    name: field for name, field in FIELDS.items() if name not in ("no_load_speed", "effort_limit")
}
"""Effects of actuators that a target may lack."""
_PROBLEMS = {
    "saturation_effort": "no torque-speed line",
    "static": "friction at rest as in motion",
    "load_friction": "friction does not grow with the effort",
}


class Drive(Differences):
    """Gains of a drive on the measured velocity, and its motors, with their differences."""

    def __init__(
        self,
        params: PIDParams,
        joint_names: Sequence[str],
        dt: float,
        inertia: ArrayLike | None,
        actuators: Actuators | None,
    ) -> None:
        super().__init__(params, joint_names, dt, inertia)
        motors = Actuators() if actuators is None else actuators
        self.actuators = instance(
            "actuators", motors, Actuators, "build them with make_actuators()"
        )
        if motors.num_envs > 1 or motors.num_joints not in (0, len(self.joints)):
            problem = f"are for {motors.num_envs} envs and {motors.num_joints} joints"
            remedy = f"give them for one env and {len(self.joints)} joints"
            raise InvalidArgumentError("actuators", problem, remedy=remedy)
        self._compare()

    def motor(self, effect: str, off: float = 0.0) -> Float64:
        """Return an effect of the actuators (joints,), ``off`` where it is off."""
        return joint_values(getattr(self.actuators, effect), len(self.joints), off)

    @property
    def integral_limit(self) -> Float64:
        """Symmetric limit of the integral (joints,) [N m or N]; infinite without a limit."""
        low, high = self.ends("integral")
        return np.maximum(np.minimum(-low, high), 0.0)

    def lack_motors(self, has: Collection[str]) -> None:
        """Add the effects of the actuators that are on and not in ``has``."""
        for effect, field in EFFECTS.items():
            values = self.motor(effect, field.neutral)
            off = field.neutral
            if effect not in has:
                text = _PROBLEMS.get(effect, "none in the target")
                self.add(effect, text, values != off, values, field.unit.removeprefix("1"))

    def compare_integral(self, clamps: ArrayLike) -> None:
        """Add the differences of a target that limits its integral alone, symmetrically.

        The target passes the limit by up to one step, except at the joints of the mask ``clamps``.
        """
        # A joint without ki has no integral that could differ.
        integrates = self.value("ki") > 0
        limits = self.integral_limit
        low, high = self.ends("integral")
        passes = np.isfinite(limits) & ~np.asarray(clamps)
        motors = [self.motor(effect, math.inf) for effect in ("effort_limit", "saturation_effort")]
        winds = self.limited | np.isfinite(motors).any(0)
        winds &= np.array(strategies(self.params)) != "none"
        rows = (
            ("anti_windup", "the integral grows during saturation, up to its limit", winds),
            ("integral_limit", "the same in both directions", (-low != high) & clamps),
            ("integral_limit", "exceeded by up to one step, ki dt |e|", passes),
        )
        for option, text, where in rows:
            self.add(option, text, integrates & where, limits, "N m or N")

    def _compare(self) -> None:
        # Options of the derivative matter where there is one, and come last.
        params = self.params
        low, high = self.ends("integral")
        excluded = ((low > 0) | (high < 0)) & (params.ki is not None)
        self.add("integral_limit", "the integral begins at 0, outside its limits", excluded)
        self.lack_weights()
        self.lack("deadband", "none: P acts on the whole error", 0.0, "rad or m")
        turns = params.continuous is not None
        self.add("continuous", "errors are not taken the short way round", turns)
        self.add("non_finite", "inputs are not checked", params.non_finite is not None)
        if params.kd is None:
            return
        weight = self.value("setpoint_weight_derivative")
        has_weight = params.setpoint_weight_derivative is not None
        text = "acts on the target's velocity alone (c = 1)"
        self.add("setpoint_weight_derivative", text, has_weight, weight)
        self.lack("derivative_filter_time", "no filter", 0.0, "s")
        text = "the derivative is the simulator's velocity, not a difference"
        self.add("measurement_rate", text, params.measurement_rate is None)
