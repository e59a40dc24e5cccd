"""Guard, friction, motors and sensors on plain Python numbers, one joint at a time: slow, obvious
oracles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np


def difference(a, b, continuous):
    """Return a - b, the short way round on a continuous joint."""
    return math.remainder(a - b, 2 * math.pi) if continuous else a - b


def within(value, low, high):
    return min(max(value, low), high)


@dataclass
class ScalarGuard:
    """Guard of one setpoint, at rest at ``setpoint``."""

    setpoint: float
    lower: float = -math.inf
    upper: float = math.inf
    rate: float = math.inf
    acceleration: float = math.inf
    continuous: bool = False
    speed: float = 0.0
    requested: float | None = None

    def step(self, asked, dt):
        target = asked if self.continuous else within(asked, self.lower, self.upper)
        last = self.setpoint if self.requested is None else self.requested
        wanted = difference(target, self.setpoint, self.continuous) / dt
        rest = difference(last, self.setpoint, self.continuous)
        change = self.acceleration * dt
        late = abs(rest) / dt - self.stop(abs(rest), dt)
        speed = within(wanted - math.copysign(late, rest), -self.rate, self.rate)
        if not self.continuous:
            speed = min(speed, self.stop(max(self.upper - self.setpoint, 0.0), dt))
            speed = max(speed, -self.stop(max(self.setpoint - self.lower, 0.0), dt))
        speed = within(speed, self.speed - change, self.speed + change)
        self.setpoint = target if speed == wanted else self.setpoint + dt * speed
        self.speed, self.requested = speed, target
        return self.setpoint

    def stop(self, distance, dt):
        change = self.acceleration * dt
        steps = 1
        while math.isfinite(distance) and change * dt * steps * (steps + 1) / 2 < distance:
            steps += 1
        return distance / (steps * dt) + (steps - 1) * (change / 2 if steps > 1 else 0.0)


@dataclass
class ScalarFriction:
    """Friction of one joint that moves at ``velocity`` under ``effort``; ``gain`` is K and
    ``share`` w.
    """

    velocity: float
    effort: float
    gain: float
    share: float
    coulomb: float = 0.0
    viscous: float = 0.0
    static: float = 0.0
    stribeck: float | None = None
    load: float = 0.0
    slides: bool = False

    def __post_init__(self):
        held = max(self.coulomb, self.static) + self.load * abs(self.effort)
        self.slides |= self.gain * abs(self.velocity) > held

    def step(self, effort, velocity):
        bound, rest = self.coulomb, max(self.coulomb, self.static)
        if not self.slides:
            bound = rest
        elif self.stribeck:
            bound += (rest - bound) / (1 + (velocity / self.stribeck) ** 2)
        bound += self.load * abs(effort)
        held = self.effort - self.gain * (velocity + self.share * (velocity - self.velocity))
        self.effort, self.velocity = within(held, effort - bound, effort + bound), velocity
        self.slides = self.effort != held
        return self.effort - self.viscous * velocity


def friction_gains(mass, viscous, rubs, dt):
    """Return K and w of the joints of one robot with a ``mass`` matrix; ``rubs`` says which joints
    have friction.
    """
    inverse, joints = np.linalg.inv(mass + dt * np.diag(viscous)), range(len(mass))
    gains = []
    for j in joints:
        correlations = [
            abs(inverse[i, j]) / math.sqrt(inverse[i, i] * inverse[j, j]) for i in joints if rubs[i]
        ]
        gains.append(0.7 / (dt * inverse[j, j] * sum(correlations)) if rubs[j] else 0.0)
    return gains, [1 - dt * viscous[j] * inverse[j, j] for j in joints]


@dataclass
class ScalarMotor:
    """Motor and sensor of one joint, at rest at ``start`` with an effort of 0."""

    start: float
    command_delay: float = 0.0
    sensor_delay: float = 0.0
    lag: float = 0.0
    strength: float = 1.0
    bias: float = 0.0
    saturation_effort: float = math.inf
    no_load_speed: float = math.inf
    effort_limit: float = math.inf
    position_offset: float = 0.0
    backlash: float = 0.0
    position_resolution: float = 0.0
    continuous: bool = False
    efforts: list = field(default_factory=list)
    measured: list = field(default_factory=list)
    delivered: float | None = None

    def ends(self, position, velocity):
        """Return the least and the largest effort that the motor delivers."""
        limit = self.effort_limit
        if math.isinf(self.saturation_effort):
            return -limit, limit
        lost = self.saturation_effort * velocity / self.no_load_speed
        stall = self.saturation_effort
        return within(-stall - lost, -limit, limit), within(stall - lost, -limit, limit)

    def deliver(self, effort, position, velocity, dt):
        low, high = self.ends(position, velocity)
        if self.delivered is None:
            self.delivered = within(self.bias, *self.ends(self.start, 0.0))
        self.efforts.append(effort)
        late = self.late(self.efforts, self.command_delay / dt, 0.0, lambda a, b: a - b)
        motor = within(self.strength * late + self.bias, low, high)
        if self.lag > 0:
            motor = within(
                self.delivered - math.expm1(-dt / self.lag) * (motor - self.delivered), low, high
            )
        self.delivered = motor
        return motor

    def measure(self, position, velocity, dt):
        if self.backlash > 0:
            behind = difference(
                self.measured[-1][0] if self.measured else self.start, position, self.continuous
            )
            offset = within(behind, -self.backlash / 2, self.backlash / 2)
            position, velocity = position + offset, (velocity if offset != behind else 0.0)
        self.measured.append((position, velocity))
        positions, velocities = ([each[at] for each in self.measured] for at in (0, 1))
        steps = self.sensor_delay / dt
        position = self.late(
            positions, steps, self.start, lambda a, b: difference(a, b, self.continuous)
        )
        velocity = self.late(velocities, steps, 0.0, lambda a, b: a - b)
        return (
            rounded(position + self.position_offset, self.position_resolution),
            velocity,
        )

    def late(self, values, steps, before, less):
        """Return the last of ``values`` as it was ``steps`` ago, interpolated; ``before`` the first
        it was that.
        """
        whole = math.floor(steps + 1e-5)
        near, far = (values[-1 - k] if k < len(values) else before for k in (whole, whole + 1))
        share = steps - whole
        return near if share < 1e-5 else near + share * less(far, near)


def rounded(value, step):
    return round(value / step) * step if step else value
