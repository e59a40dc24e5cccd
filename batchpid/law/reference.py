"""SimplePID of SAPIEN's tutorial "Drive Robot with PID Controller": the baseline of benchmarks, and an oracle."""

from __future__ import annotations


class SimplePID:
    """u = kp e + ki I + kd (e - e') / dt, with I += e dt before, and e' = 0 at the start, hence a first kick."""

    def __init__(self, kp: float = 0.0, ki: float = 0.0, kd: float = 0.0) -> None:
        self.kp, self.ki, self.kd = kp, ki, kd
        self.integral = self.last_error = 0.0

    def compute(self, error: float, dt: float) -> float:
        """Return the effort for this error, ``dt`` seconds after the last."""
        self.integral += error * dt
        derivative = (error - self.last_error) / dt
        self.last_error = error
        return self.kp * error + self.ki * self.integral + self.kd * derivative
