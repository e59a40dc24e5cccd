"""Integral action for a drive that has none: a simulator's implicit PD, whose target the integral moves."""

from __future__ import annotations

from typing import Any

from batchpid.elementwise import namespace
from batchpid.law import step
from batchpid.params import PIDParams
from batchpid.state import PIDState


def drive_target(
    params: PIDParams,
    state: PIDState,
    setpoint: Any,
    measurement: Any,
    dt: Any,
    *,
    measurement_rate: Any = None,
    setpoint_rate: Any = None,
    feedforward: Any = None,
) -> tuple[PIDState, Any]:
    """Return ``(state, target)``: the position target that makes a PD drive of stiffness kp act as a PID::

        target = setpoint + I / kp          so that kp (target - y) - kd dy/dt = P + I + D

    The drive (SAPIEN's ``set_drive_property(stiffness=kp, damping=kd)``) integrates P and D implicitly and is as
    stable as without I. I evolves as in :func:`batchpid.step`, whose effort is what the drive is expected to give:
    ``effort_min`` and ``effort_max`` are the drive's force limit, and anti-windup works against it. ``feedforward`` is
    what acts beside the drive, inside the same limit. Where kp is 0 the target is the setpoint.

    Arrays are as in :func:`batchpid.step`; the idea is from the SAPIEN authors' answer in haosulab/SAPIEN#178.
    """
    state, _, shown = step(
        params,
        state,
        setpoint,
        measurement,
        dt,
        measurement_rate=measurement_rate,
        setpoint_rate=setpoint_rate,
        feedforward=feedforward,
        terms=True,
    )
    xp = namespace(*params, shown.i, setpoint)
    driven = params.kp > 0
    return state, setpoint + xp.where(driven, shown.i, 0) / xp.where(driven, params.kp, 1)
