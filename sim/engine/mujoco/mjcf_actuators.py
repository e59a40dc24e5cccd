"""Actuators of an MJCF file: MuJoCo's PID, its DC motor, or a plain motor, for each independent joint.

``<pid>`` (MuJoCo 3.12 and later), with position q, inputs r, r' and ff, setpoint g and integral A::

    c       = min(max(r, posrange_0), posrange_1)
    g       = min(max(c, g - dt slewmax), g + dt slewmax)
    u       = kp (g - q) + ki A + kv (r' - q') + ff
    effort  = min(max(u, forcerange_0), forcerange_1)
    A      <- A + dt (g - q)        while |A| < imax, or towards 0

``<dcmotor>`` has the same u, without posrange, and clamps the integral: min(max(A, -Imax), Imax). Its supply voltage is
1 V here. The stall effort S and the no-load speed v0 give the torque-speed line, and the time constant T of the winding
gives the lag::

    i       = min(max(u, S (-1 - q'/v0)), S (1 - q'/v0))
    x      <- x + (1 - exp(-dt/T)) (i - x)
    effort  = min(max(x, -saturation), saturation)

A plain motor is a ``<general>`` actuator, where x is the delayed input u(t - delay), or that after a first-order lag::

    effort  = min(max(gainprm x + biasprm, forcerange_0), forcerange_1)

(MuJoCo's documentation: XML reference, actuator; "DC Motor Model". All were compared with MuJoCo 4.0 step by step.)
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import InvalidArgumentError
from batchpid.export.pd_drive import Drive
from batchpid.motors.guard import Guard

FAR = 1e10
"""Finite limit in place of an infinite one."""
_INPUTS = {"input": "pos vel ff"}


class MjcfActuators:
    """Actuators of the joints: ``elements`` as (tag, attributes), and their differences, which are added to ``found``.

    ``has_rate``, ``has_lag`` and ``is_dcmotor`` are masks (joints,) of joints with a rate-limited setpoint, a lag and a
    DC motor. ``effort_range`` (joints, 2) [N m or N] holds the asymmetric effort limits of DC motors, which are
    written to the joint because ``<dcmotor>`` has only symmetric ones; other joints have infinite limits there.
    """

    def __init__(
        self, found: Drive, own: NDArray[np.bool_], controls: bool, guard: Guard | None, continuous: NDArray[np.bool_]
    ) -> None:
        self._found, self._own, self.controls = found, own, controls
        low, high = found.value("effort_min", -math.inf), found.value("effort_max", math.inf)
        limit = found.motor("effort_limit", math.inf)
        self._low, self._high = np.maximum(low, -limit), np.minimum(high, limit)
        self._stall, self._speed = found.motor("saturation_effort", math.inf), found.motor("no_load_speed", math.inf)
        self._lag, self._strength = found.motor("lag"), found.motor("strength", 1.0)
        has_line = np.isfinite(self._stall)
        self._line = has_line & (controls | (self._strength > 0))
        self.is_dcmotor = self._line | (controls & (self._lag > 0))
        self._slew, self._lower, self._upper = (
            np.full(len(own), off)
            if guard is None or (leaf := getattr(guard, name)) is None
            else np.asarray(leaf[0], float)
            for name, off in (("rate", math.inf), ("lower", -math.inf), ("upper", math.inf))
        )
        self.effort_range = np.array([self._low, self._high]).T
        self.effort_range[~self.is_dcmotor | (-self._low == self._high)] = -math.inf, math.inf
        self.elements = [self._element(int(at)) for at in np.flatnonzero(own)]
        self.has_rate, self.has_lag = own & np.isfinite(self._slew), own & (self._lag > 0)
        self._compare(has_line)
        if guard is not None:
            self._compare_guard(guard, continuous)

    def _element(self, at: int) -> tuple[str, dict[str, str]]:
        found, name = self._found, self._found.joints[at]
        common = {"name": name, "joint": name}
        if delay := found.motor("command_delay")[at]:
            nsample = math.ceil(delay / found.dt) + 2
            common |= {"delay": _text(delay), "nsample": str(nsample), "interp": "linear"}
        low, high = float(self._low[at]), float(self._high[at])
        limited = math.isfinite(low) or math.isfinite(high)
        if limited and low >= high:
            problem = "must be below effort_max for MuJoCo"
            raise InvalidArgumentError("effort_min", problem, joint=name, value=low, remedy="widen the limits")
        limits = {"forcerange": _text(*np.clip([low, high], -FAR, FAR))} if limited else {}
        if self.is_dcmotor[at]:
            return "dcmotor", common | self._dcmotor(at, low, high)
        if self.controls:
            return "pid", common | self._pid(at) | limits
        motor = {"gainprm": _text(self._strength[at]), "biastype": "affine", "biasprm": _text(found.motor("bias")[at])}
        if lag := self._lag[at]:
            motor |= {"dyntype": "filterexact", "dynprm": _text(lag), "actearly": "true"}
        return "general", common | motor | limits

    def _gains(self, at: int) -> tuple[float, float, float, float, float]:
        """Return kp, ki, kd, and the limits of the setpoint's rate and of the integral of the error, 0 for none."""
        found, limit = self._found, self._found.integral_limit[at]
        kp, ki, kd = (float(found.value(name)[at]) for name in ("kp", "ki", "kd"))
        integrates = ki > 0 and limit > 0
        imax = limit / ki if integrates and math.isfinite(limit) else 0.0
        slew = self._slew[at] if math.isfinite(self._slew[at]) else 0.0
        return kp, ki if integrates else 0.0, kd, slew, imax

    def _pid(self, at: int) -> dict[str, str]:
        kp, ki, kv, slew, imax = self._gains(at)
        figures = {"kp": kp, "kv": kv, "ki": ki, "imax": imax, "slewmax": slew}
        element = {key: _text(value) for key, value in figures.items() if value or key == "kp"} | _INPUTS
        ends = self._lower[at], max(self._upper[at], np.nextafter(self._lower[at], math.inf))  # MuJoCo: lower < upper
        if np.isfinite(ends).any():
            element["posrange"] = _text(*np.clip(ends, -FAR, FAR))
        return element

    def _dcmotor(self, at: int, low: float, high: float) -> dict[str, str]:
        arm = 1.0 if self.controls else float(self._strength[at])  # the gear: efforts of the motor are divided by it
        element, voltage = {}, 0.0
        if self._line[at]:
            voltage = 1.0
            element["nominal"] = _text(voltage, self._stall[at] / arm, self._speed[at] * arm)
        else:
            element |= {"motorconst": "1 1", "resistance": "1"}
        gains = self._gains(at) if self.controls else (0.0,) * 5
        element |= _INPUTS if self.controls else {"input": "ff"}
        element["controller"] = _text(*gains, voltage)
        if arm != 1:
            element["gear"] = _text(arm)
        if -low == high and math.isfinite(high):
            element["saturation"] = _text(high / arm, 0, 0)
        if lag := self._lag[at]:
            element["inductance"] = _text(0, lag)
        return element

    def _compare(self, has_line: NDArray[np.bool_]) -> None:
        """Add the differences of the actuators."""
        found, own = self._found, self._own
        has = {"armature", "viscous", "coulomb", "command_delay", "saturation_effort", "lag"}
        if self.controls:
            found.compare_integral(self.is_dcmotor)
            late = found.motor("command_delay") > 0
            found.add(
                "command_delay", "of the inputs, which are 0 at first, not of the effort: the law is not late", late
            )
        else:
            has |= {"strength", "bias"}
            if (lost := own & self.is_dcmotor & (found.motor("bias") != 0)).any():
                found.append(f"bias: none in a dcmotor; here {found.listed(found.motor('bias'), lost)} N m or N")
            if (lost := own & has_line & ~self._line).any():
                found.append(f"saturation_effort: none without strength: {found.listed(self._stall, lost)} N m or N")
        found.lack_motors(has)
        limited = np.isfinite(self._low) | np.isfinite(self._high)
        if (both := own & (self._lag > 0) & limited).any():
            text = "before effort_limit, not after it: an effort u times the limit holds it for ln(u) lags longer"
            found.append(f"lag: {text}; here {found.listed(self._lag, both)} s")
        if (both := own & self._line & (self._lag > 0)).any():
            with np.errstate(invalid="ignore"):
                excess = found.listed(self._lag * self._stall / self._speed, both)
            found.append(f"lag: an effort may pass the torque-speed line, by {excess} N m or N per rad/s^2 or m/s^2")
        limit = found.motor("effort_limit", math.inf)
        if (weak := own & self._line & ((self._low > -limit) | (self._high < limit))).any():
            least = np.maximum(np.minimum(-self._low, self._high), 0.0)
            fast = found.listed(self._speed * (1 + least / self._stall), weak)
            text = "beyond these speeds the motor brakes within the law's limits, not along its line"
            found.append(f"saturation_effort: {text}: {fast} rad/s or m/s")

    def _compare_guard(self, guard: Guard, continuous: NDArray[np.bool_]) -> None:
        """Add the differences of the setpoint's limits."""
        found, own = self._found, self._own
        if guard.acceleration is not None:
            most = np.asarray(guard.acceleration[0], float)
            with np.errstate(invalid="ignore"):
                lead = np.where(np.isfinite(self._slew), self._slew**2 / (2 * most), math.inf)
            if (on := own & np.isfinite(most)).any():
                text = f"the setpoint's acceleration is not limited; here {found.listed(most, on)} rad/s^2 or m/s^2"
                found.append(f"guard: {text}, a lag of up to {found.listed(lead, on)} rad or m")
        if (lost := own & self.is_dcmotor & (np.isfinite(self._lower) | np.isfinite(self._upper))).any():
            found.append(f"guard: a dcmotor has no limits of the position alone: {found.listed_names(lost)}")
        if (turns := own & continuous & np.isfinite(self._slew)).any():
            found.append(f"guard: setpoints do not go the short way round: {found.listed_names(turns)}")
        if (moves := own & (found.value("kd") > 0)).any():
            found.append(f"guard: of the position input; the velocity input is as given: {found.listed_names(moves)}")


def _text(*numbers: float) -> str:
    """Return numbers with all digits."""
    return " ".join(repr(float(number)) for number in numbers)
