"""Differences of MuJoCo's PID: gains, motors, and an integral with a limit of its own."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import instance
from batchpid.errors import InvalidArgumentError
from batchpid.export.differences import Differences, joint_values, strategies
from batchpid.law.params import PIDParams
from batchpid.motors.actuators import FIELDS, Actuators

EFFECTS = {
    name: field for name, field in FIELDS.items() if name not in ("no_load_speed", "effort_limit")
}
"""Effects of actuators that a target may lack."""
_PROBLEMS = {
    "saturation_effort": "no torque-speed line",
    "static": "friction at rest is that of motion",
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
            problem = f"are of {motors.num_envs} envs and {motors.num_joints} joints"
            remedy = f"give those of one env and {len(self.joints)} joints"
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
            ("anti_windup", "the integral goes on at the effort's limit, up to its own", winds),
            ("integral_limit", "the same in both directions", (-low != high) & clamps),
            ("integral_limit", "passed by up to one step, ki dt |e|", passes),
        )
        for option, text, where in rows:
            self.add(option, text, integrates & where, limits, "N m or N")

    def _compare(self) -> None:
        # Options of the derivative matter where there is one, and come last.
        params = self.params
        low, high = self.ends("integral")
        excluded = ((low > 0) | (high < 0)) & (params.ki is not None)
        self.add("integral_limit", "an integral whose limits exclude 0 begins at 0", excluded)
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
