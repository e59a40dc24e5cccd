"""Laws of single actuators of a compiled MJCF file, in their own units.

A kind of actuator is read only if all its parts are known here: any other gain, bias, dynamics or
plugin is reported.

A DC motor with motor constant K, resistance R and supply voltage V has the stall effort K V / R and
the no-load speed V / K. (MuJoCo's documentation, "DC Motor Model".)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np

from batchpid.arrays.array_types import MjModel

_POSITION = 1
_VOLTAGE = 8
_NO_INPUT = 16
"""Inputs of an actuator: bits of ``mjtCtrlInput`` (3.12 and later)."""
_GAIN = mujoco.mjtGain
_BIAS = mujoco.mjtBias
_DYN = mujoco.mjtDyn


class Servo(NamedTuple):
    """Gains of an actuator in its own units, with limits of the integral of the error and of the
    setpoint's rate.

    ``rate`` is infinite without a limit.
    """

    kp: float
    kv: float
    ki: float = 0.0
    imax: float = math.inf
    rate: float = math.inf


class Line(NamedTuple):
    """Torque-speed line of a DC motor, infinite without one, its lag [s], and its damping if it has
    no inputs.
    """

    stall: float
    speed: float
    lag: float
    damping: float


def servo_of(model: MjModel, actuator: int) -> Servo | None:
    """Return the gains of a servo, of <pid> or the controller of <dcmotor>; None for other
    actuators.
    """
    gain, dynamics = model.actuator_gainprm[actuator], model.actuator_dynprm[actuator]
    if model.actuator_plugin[actuator] >= 0:
        return None
    if _is_dcmotor(model, actuator):
        return Servo(gain[4], gain[6], gain[5], dynamics[8] or math.inf, dynamics[7] or math.inf)
    if (
        model.actuator_biastype[actuator] != _BIAS.mjBIAS_AFFINE
        or not model.actuator_biasprm[actuator, 1:3].any()
    ):
        return None
    kp, kv = -model.actuator_biasprm[actuator, 1:3]
    if _is_pid(model, actuator) and model.actuator_dyntype[actuator] != _DYN.mjDYN_NONE:
        imax = dynamics[0] if dynamics[0] > 0 else math.inf
        return Servo(kp, kv, gain[0], imax, dynamics[1] or math.inf)
    scale = _velocity_scale(model, actuator, kp, kv)
    return Servo(kp, kv, rate=math.inf if scale is None else scale * _most(model, actuator, "ctrl"))


def _velocity_scale(model: MjModel, actuator: int, kp: float, kv: float) -> float | None:
    """Return the target velocity of a servo per unit of its input; None if its target is not a
    velocity.
    """
    gain = abs(float(model.actuator_gainprm[actuator, 0]))
    if kp > 0:
        return gain / kp if model.actuator_dyntype[actuator] == _DYN.mjDYN_INTEGRATOR else None
    return gain / kv if gain and kp == 0 and kv > 0 and not _is_pid(model, actuator) else None


def _most(model: MjModel, actuator: int, field: str) -> float:
    """Return the largest magnitude in an actuator's range "ctrl" or "act"; infinite without a
    range.
    """
    ends = _range(model, actuator, field)
    return math.inf if ends is None else float(np.abs(ends).max())


def _range(model: MjModel, actuator: int, field: str) -> Any | None:
    """Return the range of an actuator's (first) input, "ctrl", or of its state, "act"; None without
    one.
    """
    first = actuator
    if field == "ctrl" and hasattr(
        model, "actuator_ctrladr"
    ):  # older versions have one input for each actuator
        first = int(model.actuator_ctrladr[actuator])
    return (
        getattr(model, f"actuator_{field}range")[first]
        if getattr(model, f"actuator_{field}limited")[first]
        else None
    )


def input_range(model: MjModel, actuator: int) -> Any | None:
    """Return the range of the input of an actuator's gain: of its control, or of its state; None
    without a range.
    """
    filters = map(int, (_DYN.mjDYN_NONE, _DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT))
    return _range(
        model, actuator, "ctrl" if int(model.actuator_dyntype[actuator]) in filters else "act"
    )


def is_motor(model: MjModel, actuator: int) -> bool:
    """Return whether the force of an actuator is proportional to its input."""
    bias = model.actuator_biastype[actuator]
    unbiased = bias == _BIAS.mjBIAS_NONE or (
        bias == _BIAS.mjBIAS_AFFINE and not model.actuator_biasprm[actuator, :3].any()
    )
    fixed = model.actuator_gaintype[actuator] == _GAIN.mjGAIN_FIXED
    return bool(fixed and unbiased and model.actuator_plugin[actuator] < 0)


def line_of(model: MjModel, actuator: int) -> Line | None:
    """Return the torque-speed line of a DC motor at its supply voltage; None for other
    actuators.
    """
    return _line(model, actuator) if _is_dcmotor(model, actuator) else None


def _line(model: MjModel, actuator: int) -> Line:
    resistance, constant = (float(each) for each in model.actuator_gainprm[actuator, :2])
    if min(resistance, constant) <= 0:
        return Line(math.inf, math.inf, 0.0, 0.0)
    inputs, voltage = _inputs(model, actuator), float(model.actuator_gainprm[actuator, 7])
    if inputs == _VOLTAGE:
        ends = _range(model, actuator, "ctrl")
        voltage = 0.0 if ends is None else np.abs(ends).min()
    braked = constant**2 / resistance if inputs == _NO_INPUT else 0.0
    lag = float(model.actuator_dynprm[actuator, 0])
    if voltage <= 0 or inputs == _NO_INPUT:
        return Line(math.inf, math.inf, 0.0 if braked else lag, braked)
    return Line(constant * voltage / resistance, voltage / constant, lag, 0.0)


def unread(model: MjModel, actuator: int, servo: Servo | None) -> Iterator[tuple[str, str, str]]:
    """Yield the effects of an actuator that are not simulated, each as problem, remedy and
    figures.
    """
    bias, dynamics = model.actuator_biasprm[actuator], model.actuator_dynprm[actuator]
    kinds = [
        int(getattr(model, f"actuator_{each}type")[actuator]) for each in ("gain", "bias", "dyn")
    ]
    gain = float(model.actuator_gainprm[actuator, 0])
    if model.actuator_plugin[actuator] >= 0:
        yield (
            "is driven by a plugin, which is not simulated",
            "give the joint gains, or use <pid>",
            "",
        )
    elif _is_dcmotor(model, actuator):
        effects = {
            "cogging": bias[0],
            "friction (lugre)": dynamics[5],
            "heat": dynamics[2],
            "current_rate": dynamics[1],
        }
        if on := [name for name, value in effects.items() if value]:
            yield (
                f"has effects of a DC motor that are not simulated: {', '.join(on)}",
                "give make_actuators others",
                "",
            )
        if kinds[1] != _BIAS.mjBIAS_DCMOTOR or min(model.actuator_gainprm[actuator, :2]) <= 0:
            yield (
                "lacks a part of the law of a DC motor: a motor is simulated",
                "use <dcmotor> in the file",
                "",
            )
        elif _inputs(model, actuator) == _VOLTAGE and math.isinf(_line(model, actuator).stall):
            text = (
                "has no limit of its voltage, and so no torque-speed line: its back-EMF is not"
                " simulated"
            )
            yield text, "add ctrlrange= [V] to the file, or damping to the joint", ""
    else:
        if kinds[2] != _DYN.mjDYN_NONE and not _is_pid(model, actuator):
            yield (
                "has dynamics of its own, which are not simulated",
                "give lag= to make_actuators",
                "",
            )
        if kinds[0] != _GAIN.mjGAIN_FIXED and not _is_pid(model, actuator):
            yield (
                "has a force that is not proportional to its input: a motor is simulated",
                "check its limits",
                "",
            )
        if kinds[1] == _BIAS.mjBIAS_AFFINE and bias[0]:
            yield (
                "adds a constant force, which is not simulated",
                "give bias= to make_actuators",
                f"{bias[0]:g}",
            )
        if kinds[1] not in (int(_BIAS.mjBIAS_NONE), int(_BIAS.mjBIAS_AFFINE)):
            yield (
                "adds a force that depends on its length and speed, which is not simulated",
                "check its limits",
                "",
            )
        if kinds[0] == _GAIN.mjGAIN_FIXED and gain == 0 and (servo is None or servo.kp <= 0):
            yield (
                "has a gain of 0, so that its input has no effect: a motor is simulated",
                "check its gain",
                "",
            )
    if servo is not None and (least := min(servo.kp, servo.kv, servo.ki)) < 0:
        yield "has a negative gain, which is 0 here", "correct the file", f"{least:g}"
    if servo is not None and servo.kp > 0 and not _has_position(model, actuator):
        yield (
            "is a spring, as it has no position input: here the setpoint is its position",
            "set the setpoint to 0",
            "",
        )
    if servo is not None and _velocity_scale(model, actuator, *servo[:2]) and not servo.kp:
        text = (
            "is a velocity servo, and a setpoint is a position here: its gain kv is the gain kd,"
            " which damps"
        )
        yield (
            text,
            'add a <position> servo to the file, give the joint a kp, or use control="effort"',
            "",
        )
    if servo is not None and servo.rate == 0:
        yield (
            "keeps its setpoint, as its rate is limited to 0: the limit is not used",
            "correct the file",
            "",
        )
    group = int(model.actuator_group[actuator])
    if 0 <= group <= 30 and model.opt.disableactuator & (1 << group):
        yield (
            "is disabled in the file (actuatorgroupdisable): here it acts",
            "remove it from the file",
            "",
        )


def setpoint_range(model: MjModel, actuator: int, servo: Servo) -> tuple[float, float]:
    """Return the range to which a servo limits its setpoint, in its own units; infinite without a
    limit.
    """
    chosen = _is_pid(model, actuator) or _is_dcmotor(model, actuator)
    if servo.kp <= 0 or not _has_position(model, actuator):
        return -math.inf, math.inf
    ends = _range(model, actuator, "ctrl") if chosen else input_range(model, actuator)
    if ends is None:
        return -math.inf, math.inf
    gain = 1.0 if chosen else float(model.actuator_gainprm[actuator, 0]) / servo.kp
    low, high = sorted(float(gain * end) for end in ends)
    return low, high


def _has_position(model: MjModel, actuator: int) -> bool:
    """Return whether an input of a servo is its setpoint."""
    if _is_pid(model, actuator) or _is_dcmotor(model, actuator):
        return bool(_inputs(model, actuator) & _POSITION)
    return bool(model.actuator_gainprm[actuator, 0])


def _is_pid(model: MjModel, actuator: int) -> bool:
    """Return whether an actuator is MuJoCo's <pid> (3.12 and later)."""
    return bool(model.actuator_gaintype[actuator] == getattr(mujoco.mjtGain, "mjGAIN_PID", None))


def _is_dcmotor(model: MjModel, actuator: int) -> bool:
    """Return whether an actuator is MuJoCo's <dcmotor> whose gains give efforts (3.12 and
    later).
    """
    kind = getattr(mujoco.mjtGain, "mjGAIN_DCMOTOR", None)
    return bool(hasattr(model, "actuator_ctrlspec") and model.actuator_gaintype[actuator] == kind)


def _inputs(model: MjModel, actuator: int) -> int:
    """Return the inputs of an actuator as bits of ``mjtCtrlInput``; 0 for actuators without a
    choice.
    """
    return int(model.actuator_ctrlspec[actuator]) if hasattr(model, "actuator_ctrlspec") else 0
