"""Differences of simulators' drives: stiffness, damping and an effort limit, with or without an integral."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Float64
from batchpid.arrays.choices import IntegrateFirst, MeasuredRate
from batchpid.checks.validate import instance
from batchpid.errors import InvalidArgumentError
from batchpid.export.differences import Differences, strategies
from batchpid.law.params import PIDParams
from batchpid.motors.actuators import FIELDS, Actuators

EFFECTS = {name: field for name, field in FIELDS.items() if name not in ("no_load_speed", "effort_limit")}
"""Effects of actuators that a target may lack."""
_PROBLEMS = {
    "saturation_effort": "no torque-speed line",
    "static": "friction at rest is that of motion",
    "load_friction": "friction does not grow with the effort",
}


class Drive(Differences):
    """Gains of a drive with their differences.

    ``implicit``: the simulator integrates the drive implicitly. ``integrates``: it has an integral. ``two_sided``: its
    effort limits may differ by direction.
    """

    def __init__(
        self,
        params: PIDParams,
        joint_names: Sequence[str],
        dt: float,
        inertia: ArrayLike | None,
        actuators: Actuators | None,
        *,
        implicit: bool = False,
        integrates: bool = False,
        two_sided: bool = False,
    ) -> None:
        super().__init__(params, joint_names, dt, inertia, implicit)
        self._is_implicit = params.discretization is not None
        self.actuators = (
            Actuators()
            if actuators is None
            else instance("actuators", actuators, Actuators, "build them with make_actuators()")
        )
        if self.actuators.num_envs > 1 or self.actuators.num_joints not in (None, len(self.joints)):
            problem = f"are of {self.actuators.num_envs} envs and {self.actuators.num_joints} joints"
            remedy = f"give those of one env and {len(self.joints)} joints"
            raise InvalidArgumentError("actuators", problem, remedy=remedy)
        self._compare(implicit, integrates, two_sided)

    def motor(self, effect: str, off: float = 0.0) -> Float64:
        """Return an effect of the actuators (joints,), ``off`` where it is off."""
        leaf = getattr(self.actuators, effect)
        return np.full(len(self.joints), off) if leaf is None else np.asarray(leaf[0], np.float64)

    @property
    def effort_limit(self) -> Float64:
        """Symmetric effort limit (joints,) [N m or N] of law and motor; infinite without a limit."""
        low, high = self.value("effort_min", -math.inf), self.value("effort_max", math.inf)
        return np.minimum(np.maximum(np.minimum(-low, high), 0.0), self.motor("effort_limit", math.inf))

    def lack_motors(self, has: Collection[str], **problems: str) -> None:
        """Add the effects of the actuators that are on and not in ``has``; ``problems`` are other sentences."""
        problems = _PROBLEMS | problems
        for effect, field in EFFECTS.items():
            values = self.motor(effect, field.neutral)
            if effect not in has and (on := values != field.neutral).any():
                unit, problem = field.unit.removeprefix("1"), problems.get(effect, "none in the target")
                self.append(f"{effect}: {problem}; here {self.listed(values, on)} {unit}".rstrip())
        if self.actuators.limit_positions is not None and "position_limit" not in has:
            self.append("position_limit: no limit by position")

    def delays_setpoint(self, more: str = "") -> None:
        """Add the difference of a target that delays the setpoint; ``more`` is added to the sentence."""
        if (delay := self.motor("command_delay")).any():
            lag = self.degrees(delay)
            self.append(f"command_delay: of the setpoint, not of the effort: the law is not late{lag}{more}")

    def delay_steps(self) -> list[int]:
        """Return the delay of the setpoint of each joint in whole steps, and add its differences."""
        delay = self.motor("command_delay")
        steps = np.rint(delay / self.dt).astype(int)
        if (odd := np.abs(delay - steps * self.dt) > 1e-9).any():
            whole, here = self.listed(steps, odd), self.listed(delay, odd)
            self.append(f"command_delay: a whole number of steps of {self.dt:g} s: {whole}; here {here} s")
        self.delays_setpoint()
        return [int(each) for each in steps]

    @property
    def integral_limit(self) -> Float64:
        """Symmetric limit of the integral (joints,) [N m or N]; infinite without a limit."""
        low, high = self.value("integral_min", -math.inf), self.value("integral_max", math.inf)
        return np.maximum(np.minimum(-low, high), 0.0)

    def compare_integral(self, first: bool, clamps: ArrayLike = False) -> None:
        """Add the differences of a target that limits its integral alone, symmetrically.

        ``first``: the target integrates before it computes the output. Otherwise it integrates afterwards, and passes
        the limit by up to one step, except at the joints of the mask ``clamps``.
        """
        ki, used = self.value("ki"), np.array(strategies(self.params))
        limited = np.isfinite(self.value("effort_min", -math.inf)) | np.isfinite(self.value("effort_max", math.inf))
        limited |= np.isfinite(self.motor("effort_limit", math.inf))
        limited |= np.isfinite(self.motor("saturation_effort", math.inf))
        if (winds := (ki > 0) & limited & (used != "none")).any():
            ends = np.isfinite(self.integral_limit)
            limit = f"up to {self.listed(self.integral_limit, winds & ends)} N m or N" if (winds & ends).any() else ""
            free = f"without end: {self.listed_names(winds & ~ends)}" if (winds & ~ends).any() else ""
            how = "; ".join(each for each in (limit, free) if each)
            self.append(f"anti_windup: the integral goes on while the effort is at its limit, {how}")
        low, high = self.value("integral_min", -math.inf), self.value("integral_max", math.inf)
        uneven, ends, exact = -low != high, np.isfinite(low) | np.isfinite(high), np.asarray(clamps) | first
        both, passed = "the same in both directions", "passed by up to one step, ki dt |e|"
        for how, where in ((both, uneven & exact), (passed, ends & ~exact)):
            if (some := (ki > 0) & where).any():
                self.append(f"integral_limit: {self.listed(self.integral_limit, some)} N m or N, {how}")
        if isinstance(self.params.integration, IntegrateFirst) != first and ki.any():
            phase = self.phase(self.params._replace(integration=IntegrateFirst() if first else None))
            how = "before the output, a step earlier" if first else "after the output, a step later"
            self.append(f"integration: the present error enters the integral {how}{phase}")

    def _compare(self, implicit: bool, integrates: bool, two_sided: bool) -> None:
        params, kp, ki = self.params, self.value("kp"), self.value("ki")
        if ki.any() and not integrates:
            soft = np.divide(1.0, kp, out=np.full(len(kp), math.inf), where=kp > 0)
            left = self.listed(soft, ki > 0)
            self.append(f"ki: no integral: a load of 1 N m or N leaves an error of {left} rad or m")
        lowest, highest = self.value("integral_min", -math.inf), self.value("integral_max", math.inf)
        if params.ki is not None and (least := np.clip(0.0, lowest, highest)).any():
            size = self.listed(least, least != 0)
            self.append(
                f"integral_limit: an integral within limits that exclude 0 begins at {size} N m or N, here at 0"
            )
        low, high = self.value("effort_min", -math.inf), self.value("effort_max", math.inf)
        if not two_sided and (uneven := -low != high).any():
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
        if implicit:
            here = "here at the end of a step" if self._is_implicit else "which damps more"
            ends = "at the end of a step under PGS, of each position iteration's share of it under TGS"
            self.append(f"law: stiffness and damping act implicitly, {ends}, {here}")
