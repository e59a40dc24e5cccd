"""Differences of simulators' drives: stiffness, damping and an effort limit, with or without an integral."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.choices import MeasuredRate
from batchpid.checks.validate import instance
from batchpid.errors import InvalidArgumentError
from batchpid.export.differences import Differences
from batchpid.law.params import PIDParams
from batchpid.motors.actuators import Actuators

Float64 = NDArray[np.float64]
LACKING = {
    "sensor_delay": "s",
    "lag": "s",
    "strength": "",
    "bias": "N m or N",
    "backlash": "rad or m",
    "position_resolution": "rad or m",
    "velocity_resolution": "rad/s or m/s",
    "position_noise": "rad or m",
    "velocity_noise": "rad/s or m/s",
}
"""Effects of actuators that no PD target has, with their units."""


class Drive(Differences):
    """Gains of a drive with their differences.

    ``implicit``: the simulator integrates the drive implicitly. ``whole``: it has an integral and two limits of the
    total effort, which the caller compares.
    """

    def __init__(
        self,
        params: PIDParams,
        joint_names: Sequence[str],
        dt: float,
        inertia: ArrayLike | None,
        actuators: Actuators | None,
        implicit: bool,
        whole: bool = False,
    ) -> None:
        super().__init__(params, joint_names, dt, inertia, implicit)
        self._damps_more = implicit and params.discretization is None
        self.actuators = (
            Actuators()
            if actuators is None
            else instance("actuators", actuators, Actuators, "build them with make_actuators()")
        )
        if self.actuators.num_envs > 1 or self.actuators.num_joints not in (None, len(self.joints)):
            problem = f"are of {self.actuators.num_envs} envs and {self.actuators.num_joints} joints"
            remedy = f"give those of one env and {len(self.joints)} joints"
            raise InvalidArgumentError("actuators", problem, remedy=remedy)
        self._compare(implicit, whole)

    def motor(self, effect: str, off: float = 0.0) -> Float64:
        """Return an effect of the actuators (joints,), ``off`` where it is off."""
        leaf = getattr(self.actuators, effect)
        return np.full(len(self.joints), off) if leaf is None else np.asarray(leaf[0], np.float64)

    @property
    def effort_limit(self) -> Float64:
        """Symmetric effort limit (joints,) [N m or N] of law and motor; infinite without a limit."""
        low, high = self.value("effort_min", -math.inf), self.value("effort_max", math.inf)
        return np.minimum(np.maximum(np.minimum(-low, high), 0.0), self.motor("effort_limit", math.inf))

    def lack_motor(self, effect: str, problem: str, unit: str = "", off: float = 0.0) -> None:
        """Add an effect of the actuators that the target lacks, where it is on."""
        values = self.motor(effect, off)
        if (on := values != off).any():
            self.append(f"{effect}: {problem}; here {self.listed(values, on)} {unit}".rstrip())

    def _compare(self, implicit: bool, whole: bool) -> None:
        params, kp, ki = self.params, self.value("kp"), self.value("ki")
        if ki.any() and not whole:
            soft = np.divide(1.0, kp, out=np.full(len(kp), math.inf), where=kp > 0)
            left = self.listed(soft, ki > 0)
            self.append(f"ki: no integral: a load of 1 N m or N leaves an error of {left} rad or m")
        low, high = self.value("effort_min", -math.inf), self.value("effort_max", math.inf)
        if not whole and (uneven := -low != high).any():
            limit = self.listed(self.effort_limit, uneven)
            self.append(f"effort_limit: one number for both directions: {limit} N m or N")
        elif implicit and np.isfinite(high).any():
            self.append("effort_limit: of the drive alone, not of its sum with a feedforward")
        self.lack("effort_rate_limit", "the change of the effort is not limited", math.inf, "N m/s or N/s")
        self.lack("setpoint_weight", "P acts on the whole setpoint (b = 1), so steps overshoot more", 1.0)
        if params.kd is not None:
            if params.setpoint_weight_derivative is not None:
                weights = self.listed(self.value("setpoint_weight_derivative"))
                self.append(
                    f"setpoint_weight_derivative: acts on the target's velocity alone (c = 1); here c = {weights}"
                )
            if params.derivative_filter_time is not None:
                times, phase = (
                    self.value("derivative_filter_time"),
                    self.phase(params._replace(derivative_filter_time=None)),
                )
                self.append(f"derivative_filter_time: no filter: {self.listed(times, times > 0)} s{phase}")
            if not isinstance(params.measurement_rate, MeasuredRate):
                phase = self.phase(params._replace(measurement_rate=MeasuredRate()))
                self.append(f"measurement_rate: the derivative is the simulator's velocity, not a difference{phase}")
        self.lack("deadband", "none: P acts on the whole error", 0.0, "rad or m")
        if params.continuous is not None:
            self.append("continuous: errors are not taken the short way round")
        if params.non_finite is not None:
            self.append("non_finite: inputs are not checked")
        if self._damps_more:
            self.append("law: stiffness and damping act at the end of a step, implicitly, which damps more")
        for effect, unit in LACKING.items():
            self.lack_motor(effect, "none in the target", unit, float(effect == "strength"))
        if self.actuators.limit_positions is not None:
            self.append("position_limit: no limit by position")
