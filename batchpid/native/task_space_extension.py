"""The extension for kinematics and operational space of many robots, and the headers of rigid
bodies.

``setup.py`` imports this module without its package: it may import the standard library and the
module of extensions.
"""

from __future__ import annotations

from batchpid.native.extensions import LANES_ONLY, ROUNDED, Extension

BODY = {"rotation": 9, "position": 3, "mass": 1, "center": 3, "tensor": 9}
"""Numbers in a row of constants of a body, as BodyRow in rigid_body.h."""
KINEMATICS = ("qpos", "qvel", "tool", "pose", "jacobian", "jacobian_rate", "mass_matrix", "bias")
"""Arrays of ``kinematics`` in task_space.cpp, after the tree and the body of the tool; those after
the tool are results.
"""
LAW = (
    *("pose", "jacobian", "jacobian_rate", "mass_matrix", "bias", "chain"),
    *("setpoint", "qpos", "qvel", "twist", "acceleration", "wrench", "feedforward"),
    *("damping", "added_inertia", "left", "posture", "integral"),
    *("kp", "kd", "c", "acceleration_share", "ki_dt", "ki_dt2", "posture_kp", "posture_kd"),
    *("limit_kp", "limit_kd", "limit_margin", "limit_low", "limit_high", "integral_limit"),
    *("position_error_limit", "rotation_error_limit", "smallest_eigenvalue", "axes", "force_axes"),
    *("effort_min", "effort_max", "turns"),
    *(
        "effort",
        "next_integral",
        "limited",
        "error",
        "force",
        "task",
        "posture_effort",
        "unsaturated",
    ),
    *("task_share", "posture_share", "near_singular"),
)
"""Arrays of ``law``: dynamics, inputs and state, coefficients, and results from the effort on."""
SEARCH = ("goal", "tool", "lower", "upper", "tolerances", "qpos", "errors", "steps")
"""Arrays of ``search`` in pose_search.h; those after the tolerances are results. ``qpos`` holds the
starts first.
"""
MOVE = ("qpos", "qvel", "matrix", "effort", "added", "low", "high")
"""Arrays of ``move``; the first two are changed."""

RIGID_BODIES = (
    "batchpid/native/lanes.h",
    "batchpid/native/rigid_body.h",
    "batchpid/native/task_space_extension.py",
)
_NAMES = (
    "task_space.cpp",
    "extension.h",
    "mobility.h",
    "osc_law.h",
    "pose_search.h",
    "tables.h",
    "tool.h",
)

TASK_SPACE = Extension(
    "batchpid.native._task_space",
    (*(f"batchpid/native/{name}" for name in _NAMES), *RIGID_BODIES),
    (*ROUNDED, *LANES_ONLY),
)
EXTENSIONS = {"_task_space": TASK_SPACE}
