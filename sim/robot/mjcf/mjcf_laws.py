"""Laws of single actuators of a compiled MJCF file, in their own units.

A DC motor with motor constant K, resistance R and supply voltage V has the stall effort K V / R and the no-load
speed V / K. (MuJoCo's documentation, "DC Motor Model".)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np

_POSITION, _VOLTAGE, _NO_INPUT = 1, 8, 16
"""Inputs of an actuator: bits of ``mjtCtrlInput`` (3.12 and later)."""


class Servo(NamedTuple):
    """Gains of an actuator in its own units, with limits of the integral of the error and of the setpoint's rate."""

    kp: float
    kv: float
    ki: float = 0.0
    imax: float = math.inf
    rate: float = 0.0


class Line(NamedTuple):
    """Torque-speed line of a DC motor, infinite without one, its lag [s], and its damping if it has no inputs."""

    stall: float
    speed: float
    lag: float
    damping: float


def servo_of(model: Any, actuator: int) -> Servo | None:
    """Return the gains of a servo, of <pid> or of the controller of <dcmotor>; None for other actuators."""
    gain, dynamics = model.actuator_gainprm[actuator], model.actuator_dynprm[actuator]
    if _is_dcmotor(model, actuator):
        return Servo(gain[4], gain[6], gain[5], dynamics[8] or math.inf, dynamics[7])
    if model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_AFFINE:
        return None
    stiffness, rate = -model.actuator_biasprm[actuator, 1:3]
    if _is_pid(model, actuator) and model.actuator_dyntype[actuator] != mujoco.mjtDyn.mjDYN_NONE:
        return Servo(stiffness, rate, gain[0], dynamics[0] if dynamics[0] > 0 else math.inf, dynamics[1])
    return Servo(stiffness, rate)


def line_of(model: Any, actuator: int) -> Line | None:
    """Return the torque-speed line of a DC motor at its supply voltage; None for other actuators."""
    if not _is_dcmotor(model, actuator):
        return None
    resistance, constant = (float(each) for each in model.actuator_gainprm[actuator, :2])
    inputs, voltage = _inputs(model, actuator), float(model.actuator_gainprm[actuator, 7])
    first = int(model.actuator_ctrladr[actuator])
    if inputs == _VOLTAGE:
        voltage = np.abs(model.actuator_ctrlrange[first]).min() if model.actuator_ctrllimited[first] else 0.0
    braked = constant**2 / resistance if inputs == _NO_INPUT else 0.0
    lag = float(model.actuator_dynprm[actuator, 0])
    if voltage <= 0 or inputs == _NO_INPUT:
        return Line(math.inf, math.inf, 0.0 if braked else lag, braked)
    return Line(constant * voltage / resistance, voltage / constant, lag, 0.0)


def unread(model: Any, actuator: int, servo: Servo | None) -> Iterator[tuple[str, str, str]]:
    """Yield the effects of an actuator that are not simulated, each as problem, remedy and figures."""
    bias, dynamics = model.actuator_biasprm[actuator], model.actuator_dynprm[actuator]
    if _is_dcmotor(model, actuator):
        effects = {
            "cogging": bias[0],
            "friction (lugre)": dynamics[5],
            "heat": dynamics[2],
            "current_rate": dynamics[1],
        }
        if on := [name for name, value in effects.items() if value]:
            yield f"has effects of a DC motor that are not simulated: {', '.join(on)}", "give make_actuators others", ""
    else:
        if model.actuator_dyntype[actuator] != mujoco.mjtDyn.mjDYN_NONE and not _is_pid(model, actuator):
            yield "has dynamics of its own, which are not simulated", "give lag= to make_actuators", ""
        if model.actuator_gaintype[actuator] != mujoco.mjtGain.mjGAIN_FIXED and not _is_pid(model, actuator):
            yield "has a force that is not proportional to its input: a motor is simulated", "check its limits", ""
        if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE and bias[0]:
            yield "adds a constant force, which is not simulated", "give bias= to make_actuators", f"{bias[0]:g}"
    if servo is not None and min(servo.kp, servo.kv) < 0:
        yield "has a negative gain, which is 0 here", "correct the file", f"{min(servo.kp, servo.kv):g}"
    chosen = _is_pid(model, actuator) or _is_dcmotor(model, actuator)
    if chosen and servo is not None and servo.kp > 0 and not _inputs(model, actuator) & _POSITION:
        yield "is a spring, as it has no position input: here the setpoint is its position", "set the setpoint to 0", ""
    group = int(model.actuator_group[actuator])
    if 0 <= group <= 30 and model.opt.disableactuator & (1 << group):
        yield "is disabled in the file (actuatorgroupdisable): here it acts", "remove it from the file", ""


def setpoint_range(model: Any, actuator: int, servo: Servo) -> tuple[float, float]:
    """Return the range to which a servo limits its setpoint, in its own units; infinite without a limit."""
    chosen = _is_pid(model, actuator) or _is_dcmotor(model, actuator)
    if servo.kp <= 0 or (chosen and not _inputs(model, actuator) & _POSITION):
        return -math.inf, math.inf
    first = int(model.actuator_ctrladr[actuator]) if hasattr(model, "actuator_ctrladr") else actuator
    if not model.actuator_ctrllimited[first]:
        return -math.inf, math.inf
    gain = 1.0 if chosen else float(model.actuator_gainprm[actuator, 0]) / servo.kp
    low, high = sorted(float(gain * end) for end in model.actuator_ctrlrange[first])
    return low, high


def _is_pid(model: Any, actuator: int) -> bool:
    """Return whether an actuator is MuJoCo's <pid> (3.12 and later)."""
    return bool(model.actuator_gaintype[actuator] == getattr(mujoco.mjtGain, "mjGAIN_PID", None))


def _is_dcmotor(model: Any, actuator: int) -> bool:
    """Return whether an actuator is MuJoCo's <dcmotor> whose gains give efforts (3.12 and later)."""
    kind = getattr(mujoco.mjtGain, "mjGAIN_DCMOTOR", None)
    return bool(hasattr(model, "actuator_ctrlspec") and model.actuator_gaintype[actuator] == kind)


def _inputs(model: Any, actuator: int) -> int:
    """Return the inputs of an actuator as bits of ``mjtCtrlInput``; 0 for actuators without a choice."""
    return int(model.actuator_ctrlspec[actuator]) if hasattr(model, "actuator_ctrlspec") else 0
