"""Params of the controller of SAPIEN's tutorial."""

from __future__ import annotations

from typing import Any

from batchpid.arrays.array_types import Array
from batchpid.law.params import PIDParams, make_params


def tutorial(
    joints: int,
    kp: Array = 0.0,
    ki: Array = 0.0,
    kd: Array = 0.0,
    **options: Any,
) -> PIDParams:
    """Return params of SimplePID of SAPIEN's tutorial "Drive Robot with PID Controller", for
    ``joints`` joints.

    The derivative acts on the error, and nothing is limited. SimplePID differs in two ways: it
    integrates before it computes its output, which adds ki dt to kp, and its first derivative
    starts from an error of 0, which kicks. ``options`` are further options of
    :func:`batchpid.make_params`.
    """
    return make_params(joints, kp, ki, kd, **{"setpoint_weight_derivative": 1.0, **options})
