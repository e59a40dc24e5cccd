"""The law on plain Python numbers, one joint at a time: the slow, obvious oracle of the array
law.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields


def within(value, low, high):
    return min(max(value, low), high)


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
    discretization: str = "explicit"

    def start(self, measurement, integral=0.0):
        """Forget the past; the next step is the first after this measurement."""
        self.integral = within(integral, self.integral_min, self.integral_max)
        self.measurement = self.origin = measurement
        self.derivative = self.effort = self.size = 0.0
        self.setpoint = None

    def step(self, setpoint, measurement, dt, **optional):
        """Return the effort after ``dt`` more seconds."""
        total = self.total(setpoint, measurement, dt, **optional)
        change = self.effort_rate_limit * dt
        effort = within(total, self.effort - change, self.effort + change)
        effort = within(effort, self.effort_min, self.effort_max)
        if self.anti_windup == "back_calculation":
            share = dt / self.tracking_time if self.tracking_time > 0 else 1.0
            self.integral += min(share, 1.0) * (effort - total)
        self.settle(effort, (total - effort) * self.error > 0)
        return effort

    def total(
        self,
        setpoint,
        measurement,
        dt,
        measurement_rate=None,
        setpoint_rate=None,
        feedforward=0.0,
    ):
        """Return the sum of the terms, without the limits of the effort."""
        error = self.difference(setpoint, measurement)
        self.error = error = math.copysign(max(abs(error) - self.deadband, 0.0), error)
        moved = self.difference(measurement, self.measurement)
        velocity = moved / dt if measurement_rate is None else measurement_rate
        weight = self.setpoint_weight_derivative
        if setpoint_rate is not None:
            wanted = (1.0 if weight is None else weight) * setpoint_rate
        elif weight is not None and self.setpoint is not None:
            wanted = weight * self.difference(setpoint, self.setpoint) / dt
        else:
            wanted = 0.0
        self.origin += (measurement - self.measurement) - moved
        late = dt * (setpoint_rate or 0.0)
        self.before, self.per_step = self.integral, 1.0
        if self.discretization == "explicit":
            weighted = self.weighted(error, measurement)
            time = self.derivative_filter_time
            self.derivative = (time * self.derivative + dt * (wanted - velocity)) / (time + dt)
            terms = [self.kp * weighted, self.kd * self.derivative]
            self.integral += self.ki * error * dt
        self.origin += late
        if self.discretization == "implicit":

            def law(acceleration):
                """Return the terms at the end of the step, but for the integral so far."""
                ahead = dt * (velocity + dt * acceleration)
                weighted = self.weighted(error - ahead, measurement + ahead)
                on_errors = self.ki * dt * (error - late + error - ahead)
                return self.kp * weighted + self.kd * (wanted - ahead / dt) + on_errors

            # A linear equation: law(a) = a.
            self.per_step = 1 / (1 + law(0.0) - law(1.0))
            terms = [law(0.0) * self.per_step]
            self.integral += self.ki * dt * (error - late) * self.per_step
        terms += [self.before, feedforward]
        self.size = sum(map(abs, terms))
        self.measurement, self.setpoint = measurement, setpoint
        return sum(terms)

    def weighted(self, error, measurement):
        """Return the error with the weight of the setpoint."""
        weight = self.setpoint_weight
        return weight * error - (1 - weight) * (measurement - self.origin)

    def settle(self, effort, deeper):
        """Finish a step that has given ``effort``; ``deeper`` says whether the integral would
        saturate it more.
        """
        if self.anti_windup == "conditional" and deeper:
            self.integral = self.before
        self.integral = within(self.integral, self.integral_min, self.integral_max)
        self.effort = effort

    def difference(self, a, b):
        """Return a - b, the short way round on a continuous joint."""
        return math.remainder(a - b, 2 * math.pi) if self.continuous else a - b


def step_of_robot(pids, dt, mass_matrix, inputs):
    """Return the efforts of the joints of one robot whose gains are per mass matrix; ``inputs``
    are numbers by name, for each joint.
    """
    added = [row.pop("feedforward", 0.0) for row in inputs]
    extra = [row.pop("setpoint_acceleration", 0.0) for row in inputs]
    accelerations = [
        pid.total(dt=dt, **row) + pid.per_step * more
        for pid, row, more in zip(pids, inputs, extra, strict=True)
    ]
    demand = mass_matrix @ accelerations
    # The largest share of the demand that every joint has room for, beside what is added.
    share = 1.0
    for pid, wanted, more in zip(pids, demand, added, strict=True):
        room = pid.effort_max - more if wanted > 0 else more - pid.effort_min
        if 0 < room < abs(wanted):
            share = min(share, room / abs(wanted))
    reached = [
        within(share * wanted + more, pid.effort_min, pid.effort_max)
        for pid, wanted, more in zip(pids, demand, added, strict=True)
    ]
    efforts = []
    for pid, acceleration, goal in zip(pids, accelerations, reached, strict=True):
        change = pid.effort_rate_limit * dt
        effort = within(goal, pid.effort - change, pid.effort + change)
        effort = within(effort, pid.effort_min, pid.effort_max)
        moved = within(pid.integral, pid.integral_min, pid.integral_max) - pid.before
        is_short = share < 1 and acceleration * moved > 0
        pid.settle(effort, is_short or (goal - effort) * moved > 0)
        efforts.append(effort)
    return efforts


def scalar_pids(params, num_envs):
    """Return one :class:`ScalarPID` per env and joint with the options of ``params``."""
    known = {field.name for field in fields(ScalarPID)}
    if params.ki is None:  # without an integral there is nothing to limit
        known -= {"integral_min", "integral_max", "anti_windup", "tracking_time"}
    options = {name: value for name, value in params.options().items() if name in known}

    def pick(value, env, joint):
        if isinstance(value, str):
            return value
        return value.tolist()[env if value.shape[0] > 1 else 0][joint]

    return [
        [
            ScalarPID(**{name: pick(value, env, joint) for name, value in options.items()})
            for joint in range(params.num_joints)
        ]
        for env in range(num_envs)
    ]
