"""The law on plain Python numbers, one joint at a time: the slow, obvious oracle of the array
law.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from batchpid import PIDParams


@dataclass
class ScalarPID:
    """One PID loop of one joint; the options are as in :func:`batchpid.make_params`, each a number
    or a name.
    """

    kp: float
    ki: float = 0.0
    kd: float = 0.0
    effort_min: float = -math.inf
    effort_max: float = math.inf
    effort_rate_limit: float = math.inf
    integral_min: float = -math.inf
    integral_max: float = math.inf
    derivative_filter_time: float = 0.0
    setpoint_weight: float = 1.0
    setpoint_weight_derivative: float | None = None
    deadband: float = 0.0
    anti_windup: str = "none"
    tracking_time: float = math.inf
    continuous: bool = False
    non_finite: str = "propagate"

    def start(self, measurement: float) -> None:
        """Forget the past; the next step is the first after this measurement."""
        self.integral = min(max(0.0, self.integral_min), self.integral_max)
        self.measurement = measurement
        self.derivative = 0.0
        self.setpoint: float | None = None
        self.effort = self.size = 0.0
        self.origin = measurement

    def step(
        self,
        setpoint: float,
        measurement: float,
        dt: float,
        measurement_rate: float | None = None,
        setpoint_rate: float | None = None,
        feedforward: float | None = None,
    ) -> float:
        """Return the effort after ``dt`` more seconds."""
        inputs = [setpoint, measurement, measurement_rate, setpoint_rate, feedforward]
        if self.non_finite != "propagate" and not all(
            math.isfinite(x) for x in inputs if x is not None
        ):
            return self.effort if self.non_finite == "hold" else 0.0

        error = self.difference(setpoint, measurement)
        if abs(error) <= self.deadband:
            error = 0.0
        else:
            error -= math.copysign(self.deadband, error)

        moved = self.difference(measurement, self.measurement)
        self.origin += (measurement - self.measurement) - moved
        weight = self.setpoint_weight
        proportional = self.kp * (weight * error - (1 - weight) * (measurement - self.origin))
        self.origin += dt * (setpoint_rate or 0.0)

        rate = -(moved / dt) if measurement_rate is None else -measurement_rate
        if setpoint_rate is not None:
            weight = (
                1.0 if self.setpoint_weight_derivative is None else self.setpoint_weight_derivative
            )
            rate += weight * setpoint_rate
        elif self.setpoint_weight_derivative is not None and self.setpoint is not None:
            rate += self.setpoint_weight_derivative * self.difference(setpoint, self.setpoint) / dt
        time = self.derivative_filter_time
        self.derivative = (time * self.derivative + dt * rate) / (time + dt)

        before = self.integral
        self.integral += self.ki * error * dt
        terms = proportional, before, self.kd * self.derivative, feedforward or 0.0
        self.size = sum(map(abs, terms))
        self.unsaturated = proportional + before + self.kd * self.derivative + (feedforward or 0.0)
        change = self.effort_rate_limit * dt
        effort = min(max(self.unsaturated, self.effort - change), self.effort + change)
        effort = min(max(effort, self.effort_min), self.effort_max)
        self.saturated = effort != self.unsaturated

        if self.anti_windup == "conditional" and (self.unsaturated - effort) * error > 0:
            self.integral = before
        if self.anti_windup == "back_calculation":
            self.integral += min(
                dt / self.tracking_time if self.tracking_time > 0 else 1.0, 1.0
            ) * (effort - self.unsaturated)
        self.integral = min(max(self.integral, self.integral_min), self.integral_max)

        self.measurement, self.setpoint, self.effort = measurement, setpoint, effort
        return effort

    def difference(self, a: float, b: float) -> float:
        """Return a - b, the short way round on a continuous joint."""
        return math.remainder(a - b, 2 * math.pi) if self.continuous else a - b


def scalar_pids(params: PIDParams, num_envs: int) -> list[list[ScalarPID]]:
    """Return one :class:`ScalarPID` per env and joint with the options of ``params``."""
    known = {field.name for field in fields(ScalarPID)}
    if params.ki is None:  # without an integral there is nothing to limit
        known -= {"integral_min", "integral_max", "anti_windup", "tracking_time"}
    options = {name: value for name, value in params.options().items() if name in known}

    def pick(value: Any, env: int, joint: int) -> Any:
        return (
            value
            if isinstance(value, str)
            else value.tolist()[env if value.shape[0] > 1 else 0][joint]
        )

    return [
        [
            ScalarPID(**{name: pick(value, env, joint) for name, value in options.items()})
            for joint in range(params.num_joints)
        ]
        for env in range(num_envs)
    ]
