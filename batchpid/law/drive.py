"""Integral action for a drive without it: a simulator's implicit PD, whose target the integral moves."""

from __future__ import annotations

from typing import Any

from batchpid.arrays.elementwise import namespace
from batchpid.law.params import PIDParams
from batchpid.law.pid import step_terms
from batchpid.law.state import PIDState


def drive_target(
    params: PIDParams, state: PIDState, setpoint: Any, measurement: Any, dt: Any, **inputs: Any
) -> tuple[PIDState, Any]:
    """Return ``(state, target)``: the position target that makes a PD drive of stiffness kp act as a PID::

        target = setpoint + I / kp          so that kp (target - y) - kd dy/dt = P + I + D

    The drive (SAPIEN's ``set_drive_property(stiffness=kp, damping=kd)``) integrates P and D implicitly and is as
    stable as without I. I evolves as in :func:`batchpid.step`, whose effort predicts the drive's effort:
    ``effort_min`` and ``effort_max`` are the drive's force limit, and anti-windup works against it. Where kp is 0 the
    target is the setpoint.

    Arrays and the optional ``inputs`` measurement_rate, setpoint_rate and feedforward (an effort added to
    the drive's, inside the same limit) are as in :func:`batchpid.step`. The idea is from the SAPIEN authors' answer
    in haosulab/SAPIEN#178.
    """
    state, terms = step_terms(params, state, setpoint, measurement, dt, **inputs)
    xp = namespace(*params, terms.i, setpoint)
    driven = params.kp > 0
    return state, setpoint + xp.where(driven, terms.i, 0) / xp.where(driven, params.kp, 1)
