"""Params that behave as other libraries' task-space controllers do by default.

Every preset takes further options of :func:`batchpid.task_space.make_osc_params`. Differences that remain are named.
"""

from __future__ import annotations

import math
from typing import Any

from batchpid.task_space.osc_params import OSCParams, make_osc_params
from batchpid.task_space.rigid_tree import RigidTree

_UNLIMITED = {"position_error_limit": math.inf, "rotation_error_limit": math.inf}


def robosuite(tree: RigidTree, **options: Any) -> OSCParams:
    """Return params of robosuite's OSC_POSE: stiffness 150, damping ratio 1, partial decoupling, posture stiffness 10.

    robosuite leaves out J' q', and truncates singular values below 2.5e-4 where this law bounds their inverses. Its
    actions are changes of the setpoint from the present pose, at most 0.05 m and 0.5 rad, at 20 Hz.
    """
    own = {"decoupling": "partial", "smallest_eigenvalue": 2.5e-4, **_UNLIMITED}
    return make_osc_params(tree, **{**own, **options})


def isaac_lab(tree: RigidTree, **options: Any) -> OSCParams:
    """Return params of Isaac Lab's OperationalSpaceController: stiffness 100, damping ratio 1, gains as forces.

    By default it has neither decoupling nor posture, nor compensation of gravity: the latter is an option of the
    runner, ``compensate="none"``. Its quaternions are (x, y, z, w).
    """
    own = {"decoupling": "none", "stiffness": 100.0, "damping": 20.0, "posture_stiffness": 0.0, **_UNLIMITED}
    return make_osc_params(tree, **{**own, **options})
