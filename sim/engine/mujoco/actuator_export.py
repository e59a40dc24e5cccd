"""Actuators of an MJCF file: MuJoCo's PID, its DC motor, or a plain motor, for each independent
joint.

``<pid>`` (MuJoCo 3.12 and later), with position q, inputs r, r' and ff, setpoint g and integral A::

    c       = min(max(r, posrange_0), posrange_1)
    g       = min(max(c, g - dt slewmax), g + dt slewmax)
    effort  = kp (g - q) + ki A + kv (r' - q') + ff
    A      <- A + dt (g - q)        while |A| < imax, or towards 0

``<dcmotor>`` has the same effort u, without posrange, and clamps the integral: min(max(A, -Imax),
Imax). Its supply voltage is 1 V here. The stall effort S and the no-load speed v0 give the
torque-speed line, and the time constant T of the winding gives the lag::

    i       = min(max(u, S (-1 - q'/v0)), S (1 - q'/v0))
    effort <- effort + (1 - exp(-dt/T)) (i - effort)

A plain motor is a ``<general>`` actuator, where x is the delayed input u(t - delay), or that after
a first-order lag::

    effort  = gainprm x + biasprm

Limits of the effort are the joints' (``actuatorfrcrange``): each joint has one actuator. (MuJoCo's
documentation: XML reference, actuator; "DC Motor Model". All were compared with MuJoCo 4.0 step by
step.)
"""

from __future__ import annotations

import math

import numpy as np

from batchpid.arrays.array_types import Bool, Float64
from batchpid.errors import InvalidArgumentError
from batchpid.export.differences import Drive, joint_values
from batchpid.motors.guard import Guard

FAR = 1e10
"""Finite limit in place of an infinite one."""
_INPUTS = {"input": "pos vel ff"}


class MjcfActuators:
    """Actuators of the ``independent`` joints, of the law or of its motors alone, with their
    differences in ``drive``.

    Attributes
    ----------
    elements
        (tag, attributes) of each actuator.
    effort_range
        Limits of the efforts (joints, 2) [N m or N].
    has_rate
        Mask (joints,) of the joints with a rate-limited setpoint.
    """

    def __init__(
        self,
        drive: Drive,
        independent: Bool,
        is_law: bool,
        guard: Guard | None,
    ) -> None:
        self._drive = drive
        self._independent = independent
        self.is_law = is_law
        limit = drive.motor("effort_limit", math.inf)
        low = drive.value("effort_min", -math.inf)
        high = drive.value("effort_max", math.inf)
        self.effort_range = np.array([np.maximum(low, -limit), np.minimum(high, limit)]).T
        self._stall = drive.motor("saturation_effort", math.inf)
        self._speed = drive.motor("no_load_speed", math.inf)
        self._lag = drive.motor("lag")
        self._strength = drive.motor("strength", 1.0)
        # Without strength a motor has no effort that a line could limit.
        self._has_line = np.isfinite(self._stall) & (self._strength > 0)
        # MuJoCo's PID has neither a line nor a lag.
        self._is_dcmotor = self._has_line | (is_law & (self._lag > 0))
        guard = Guard() if guard is None else guard
        joints = len(drive.joints)
        self._rate = joint_values(guard.rate, joints, math.inf)
        self._lower = joint_values(guard.lower, joints, -math.inf)
        self._upper = joint_values(guard.upper, joints, math.inf)
        self._acceleration = joint_values(guard.acceleration, joints, math.inf)
        self.has_rate = independent & np.isfinite(self._rate)
        self.elements = [self._element(int(joint)) for joint in np.flatnonzero(independent)]

    def _element(self, joint: int) -> tuple[str, dict[str, str]]:
        drive = self._drive
        name = drive.joints[joint]
        low, high = self.effort_range[joint].tolist()
        if low >= high:
            problem = "must be below effort_max for MuJoCo"
            raise InvalidArgumentError(
                "effort_min", problem, joint=name, value=low, remedy="widen the limits"
            )
        element = {"name": name, "joint": name}
        if delay := drive.motor("command_delay")[joint]:
            # MuJoCo interpolates between samples of the inputs: one more at either end.
            samples = math.ceil(delay / drive.dt) + 2
            element |= {"delay": numbers_text(delay), "nsample": str(samples), "interp": "linear"}
        if self._is_dcmotor[joint]:
            return "dcmotor", element | self._dcmotor(joint)
        if self.is_law:
            return "pid", element | self._pid(joint)
        bias = drive.motor("bias")[joint]
        element |= {
            "gainprm": numbers_text(self._strength[joint]),
            "biastype": "affine",
            "biasprm": numbers_text(bias),
        }
        if lag := self._lag[joint]:
            element |= {"dyntype": "filterexact", "dynprm": numbers_text(lag), "actearly": "true"}
        return "general", element

    def _gains(self, joint: int) -> dict[str, float]:
        """Return gains, and limits of the setpoint's rate and of the integral of the error; 0 for
        none.
        """
        drive = self._drive
        limit = drive.integral_limit[joint]
        rate = self._rate[joint]
        kp, ki, kv = (float(drive.value(name)[joint]) for name in ("kp", "ki", "kd"))
        # MuJoCo limits the integral of the error, not its effort, and takes a limit of 0 for none.
        ki = ki if limit > 0 else 0.0
        imax = limit / ki if ki and math.isfinite(limit) else 0.0
        return {
            "kp": kp,
            "ki": ki,
            "kv": kv,
            "slewmax": rate if math.isfinite(rate) else 0.0,
            "imax": imax,
        }

    def _pid(self, joint: int) -> dict[str, str]:
        element = {
            key: numbers_text(value)
            for key, value in self._gains(joint).items()
            if value or key == "kp"
        } | _INPUTS
        lower = self._lower[joint]
        # MuJoCo needs a range of some width, also of a joint that is locked.
        ends = lower, max(self._upper[joint], np.nextafter(lower, math.inf))
        if np.isfinite(ends).any():
            element["posrange"] = numbers_text(*np.clip(ends, -FAR, FAR))
        return element

    def _dcmotor(self, joint: int) -> dict[str, str]:
        # The gear, by which the motor's efforts are divided: the strength of motors alone.
        arm = 1.0 if self.is_law else float(self._strength[joint])
        element = {"motorconst": "1 1", "resistance": "1"}
        voltage = 0.0
        if self._has_line[joint]:
            voltage = 1.0
            element = {
                "nominal": numbers_text(voltage, self._stall[joint] / arm, self._speed[joint] * arm)
            }
        gains = self._gains(joint).values() if self.is_law else [0.0] * 5
        element |= _INPUTS if self.is_law else {"input": "ff", "gear": numbers_text(arm)}
        element["controller"] = numbers_text(*gains, voltage)
        if lag := self._lag[joint]:
            element["inductance"] = numbers_text(0, lag)
        return element

    def compare(self, continuous: Bool) -> None:
        """Add the differences of the actuators; ``continuous`` is a mask of the joints."""
        drive = self._drive
        line = self._has_line
        lags = self._lag > 0
        written = {"armature", "viscous", "coulomb", "command_delay", "saturation_effort", "lag"}
        if self.is_law:
            drive.compare_integral(self._is_dcmotor)
        drive.lack_motors(written if self.is_law else written | {"strength", "bias"})
        # Masks of the joints that have a limit, a guard or an effect at all.
        limit = drive.motor("effort_limit", math.inf)
        is_weak = np.abs(self.effort_range).min(1) < limit
        limited = np.isfinite(self.effort_range).any(1)
        places = np.isfinite([self._lower, self._upper]).any(0)
        guarded = self.has_rate | places
        turns = self.has_rate & continuous
        late = drive.motor("command_delay") > 0
        biased = drive.motor("bias") != 0
        law = np.full(len(limit), self.is_law)
        dcmotor = self._is_dcmotor
        # Effects that MuJoCo's elements lack or place elsewhere, each with a mask of its joints.
        for joints, text in (
            (
                law & late,
                ("command_delay: delays the inputs, 0 at first, and not the effort"),
            ),
            (dcmotor & biased & ~law, "bias: none in a dcmotor"),
            (np.isfinite(self._stall) & ~line, "saturation_effort: none without strength"),
            (
                lags & limited,
                (
                    "lag: acts before effort_limit, not after it: the effort stays at its limit"
                    " for longer"
                ),
            ),
            (
                lags & line,
                "lag: the lagging effort may exceed the torque-speed line",
            ),
            (
                line & is_weak,
                "saturation_effort: beyond its line the motor brakes within the law's limits alone",
            ),
            (
                np.isfinite(self._acceleration),
                "guard: the acceleration of the setpoint is not limited",
            ),
            (dcmotor & places, "guard: a dcmotor has no limits of the position alone"),
            (turns, "guard: setpoints do not go the short way round"),
            (
                guarded & (drive.value("kd") > 0),
                "guard: limits the position input, not the velocity input",
            ),
        ):
            if (joints := joints & self._independent).any():
                drive.append(f"{text}: {', '.join(np.array(drive.joints)[joints])}")


def numbers_text(*numbers: Float64 | float) -> str:
    """Return numbers with all digits."""
    return " ".join(repr(float(number)) for number in numbers)
