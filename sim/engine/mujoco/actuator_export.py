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
from batchpid.export.differences import Law

FAR = 1e10
"""Finite limit in place of an infinite one."""
_INPUTS = {"input": "pos vel ff"}


class MjcfActuators:
    """Actuators of the ``driven`` joints (a mask), of a law or of its motors alone.

    Attributes
    ----------
    elements
        (tag, attributes) of each actuator.
    has_rate
        Mask (joints,) of the joints with a rate-limited setpoint.
    """

    def __init__(self, law: Law, driven: Bool) -> None:
        self._law = law
        self._rate = law.column("rate")
        self._is_dcmotor = law.is_dcmotor
        self.has_rate = driven & np.isfinite(self._rate)
        self.elements = [self._element(int(joint)) for joint in np.flatnonzero(driven)]

    def _element(self, joint: int) -> tuple[str, dict[str, str]]:
        law = self._law
        name = law.joints[joint]
        low, high = law.effort_range[:, joint].tolist()
        if low >= high:
            problem = "must be below effort_max for MuJoCo"
            raise InvalidArgumentError(
                "effort_min", problem, joint=name, value=low, remedy="widen the limits"
            )
        element = {"name": name, "joint": name}
        if delay := law.column("command_delay")[joint]:
            # MuJoCo interpolates between samples of the inputs: one more at either end.
            samples = math.ceil(delay / law.dt) + 2
            element |= {"delay": numbers_text(delay), "nsample": str(samples), "interp": "linear"}
        if self._is_dcmotor[joint]:
            return "dcmotor", element | self._dcmotor(joint)
        if law.is_law:
            return "pid", element | self._pid(joint)
        element |= {
            "gainprm": numbers_text(law.column("strength")[joint]),
            "biastype": "affine",
            "biasprm": numbers_text(law.column("bias")[joint]),
        }
        if lag := law.column("lag")[joint]:
            element |= {"dyntype": "filterexact", "dynprm": numbers_text(lag), "actearly": "true"}
        return "general", element

    def _gains(self, joint: int) -> dict[str, float]:
        """Return gains, and limits of the setpoint's rate and of the integral of the error; 0 for
        none.
        """
        kp, ki, kd, low, high = (
            float(self._law.column(option)[joint])
            for option in ("kp", "ki", "kd", "integral_min", "integral_max")
        )
        # MuJoCo limits the integral of the error, not its effort, symmetrically, and takes a limit
        # of 0 for none.
        limit = max(min(-low, high), 0.0)
        ki = ki if limit > 0 else 0.0
        imax = limit / ki if ki and math.isfinite(limit) else 0.0
        rate = float(self._rate[joint])
        slewmax = rate if math.isfinite(rate) else 0.0
        return {"kp": kp, "ki": ki, "kv": kd, "slewmax": slewmax, "imax": imax}

    def _pid(self, joint: int) -> dict[str, str]:
        element = {
            key: numbers_text(value)
            for key, value in self._gains(joint).items()
            if value or key == "kp"
        } | _INPUTS
        lower = self._law.column("lower")[joint]
        # MuJoCo needs a range of some width, also of a joint that is locked.
        ends = lower, max(self._law.column("upper")[joint], np.nextafter(lower, math.inf))
        if np.isfinite(ends).any():
            element["posrange"] = numbers_text(*np.clip(ends, -FAR, FAR))
        return element

    def _dcmotor(self, joint: int) -> dict[str, str]:
        law = self._law
        # The gear, by which the motor's efforts are divided: the strength of motors alone.
        arm = 1.0 if law.is_law else float(law.column("strength")[joint])
        element = {"motorconst": "1 1", "resistance": "1"}
        voltage = 0.0
        if law.has_line[joint]:
            voltage = 1.0
            stall = law.column("saturation_effort")[joint] / arm
            speed = law.column("no_load_speed")[joint] * arm
            element = {"nominal": numbers_text(voltage, stall, speed)}
        gains = self._gains(joint).values() if law.is_law else [0.0] * 5
        element |= _INPUTS if law.is_law else {"input": "ff", "gear": numbers_text(arm)}
        element["controller"] = numbers_text(*gains, voltage)
        if lag := law.column("lag")[joint]:
            element["inductance"] = numbers_text(0, lag)
        return element


def numbers_text(*numbers: Float64 | float) -> str:
    """Return numbers with all digits."""
    return " ".join(repr(float(number)) for number in numbers)
