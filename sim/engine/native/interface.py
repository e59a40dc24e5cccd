"""Interface between Python and the native extensions: files, flags and tables.

The C++ code repeats these tables: see :mod:`batchpid.native.extensions`. ``setup.py`` imports this
module without its package, so it may import only that module, others that it lists before this one,
and the standard library.
"""

from __future__ import annotations

import ctypes
from typing import Any

from batchpid.native.extensions import PROGRAMS, RIGID_BODIES, ROUNDED, VECTORIZED_ONLY, Extension

SYMBOLS = (
    "_ZN6sapien5physx17PhysxArticulation7getQposEv",
    "_ZN6sapien5physx17PhysxArticulation7getQvelEv",
    "_ZN6sapien5physx17PhysxArticulation19computePassiveForceEbb",
    "_ZN6sapien5physx17PhysxArticulation5setQfERKN5Eigen6MatrixIfLin1ELi1ELi0ELin1ELi1EEE",
    "_ZN6sapien5physx14PhysxSystemCpu4stepEv",
    "_ZN6sapien5physx22PhysxArticulationJoint22setDriveTargetPositionEf",
    "_ZN6sapien5physx22PhysxArticulationJoint22setDriveTargetVelocityEf",
    "_ZN6sapien5physx17PhysxArticulation11getRootPoseEv",
    "_ZN6sapien5physx17PhysxArticulation22getRootAngularVelocityEv",
)
"""Functions of SAPIEN, in the order of Functions in gateway.h."""
WIDTH = 8
"""Number of robots in a vector, as in lanes.h."""
CONTACT = ("none", "some", "unknown")
"""What is known about the contacts of a robot, as Contact in free_motion.h."""
BASES = ("fixed", "free", "held")
"""Kinds of the base of a :class:`ModelStruct`, as Base in model.h."""
STATUS = ("not_finite", "too_fast", "failed", "no_noise", "sense")
"""Bits of the status of a sim step: reasons to stop a loop over sim steps, as Status in
sim_step.h.
"""
STAGES = (
    "program",
    "passive force",
    "inertia",
    "mass matrix",
    "controller",
    "targets",
    "constraint",
    "engine",
)
"""Kinds of a :class:`Stage`."""
TRANSFERS = ("read", "write_floats", "write_bytes")
"""Kinds of a :class:`Transfer`."""
FARTHEST = 1e6
"""Largest position of a joint [rad or m], as in sim_step.h. A robot beyond it has failed: its state
is float32.
"""


def _all(kind: Any, *names: str) -> list[tuple[str, Any]]:
    """Return fields of one type."""
    return [(name, kind) for name in names]


class Group(ctypes.Structure):
    """Group of robots, as Group in sim_step.h."""

    _fields_ = [
        *_all(
            ctypes.c_void_p,
            "functions",
            "articulations",
            "systems",
            "qf",
            "skip",
            "speed_limit",
            "mujoco",
            "constraint",
            "joints",
        ),
        *_all(ctypes.c_int64, "robots", "dof"),
        *_all(ctypes.c_int32, "gravity", "coriolis", "senses"),
        ("message", ctypes.c_char * 256),
    ]


class Clearance(ctypes.Structure):
    """Shapes of robots in MuJoCo, and their clearances, as Clearance in clearance.h."""

    _fields_ = [
        *_all(
            ctypes.c_void_p,
            "kinematics",
            "models",
            "places",
            "turns",
            "kinds",
            "sizes",
            "radii",
            "hulls",
            "vertices",
            "pairs",
            "bodies",
            "arms",
            "travel",
            "last",
            "poses",
            "moved",
            "left",
            "rate",
            "shares",
            "wait",
            "age",
            "brief",
            "open",
            "no_shapes",
            "some_types",
        ),
        *_all(
            ctypes.c_int64, "number", "ways", "size", "flags", "counts", "types_at", "affinities_at"
        ),
        *_all(ctypes.c_int32, "contact", "unused"),
    ]


class FreeMotion(ctypes.Structure):
    """Robots on fixed bases that step without MuJoCo where nothing touches, as FreeMotion in
    free_motion.h.
    """

    _fields_ = [
        *_all(
            ctypes.c_void_p,
            "model",
            "qpos",
            "qvel",
            "acceleration",
            "bias",
            "mass",
            "armature",
            "weight",
            "gravity",
            "low",
            "high",
            "contact",
            "time",
            "ctrl",
            "position_gain",
            "drive_rate_gain",
            "drive_limit",
        ),
        ("robots", ctypes.c_int64),
        *_all(ctypes.c_double, "stiffness", "rate_gain", "least", "most", "width", "timestep"),
        *_all(ctypes.c_int32, "has_pairs", "unused"),
    ]


class Mujoco(ctypes.Structure):
    """Robots in MuJoCo, as Mujoco in mujoco_step.h."""

    _fields_ = [
        *_all(
            ctypes.c_void_p,
            "step1",
            "step2",
            "set_log_handler",
            "clock",
            "models",
            "data",
            "qpos",
            "qvel",
            "applied",
            "bias",
            "warm",
            "contacts",
            "qpos_at",
            "qvel_at",
            "qf",
            "ctrl",
            "stiffness",
            "rate_gain",
            "clearance",
            "free",
            "sensors",
            "sensed",
        ),
        *_all(ctypes.c_int64, "sensor_size", "base_qpos", "base_qvel"),
    ]


class Constraint(ctypes.Structure):
    """Constraint of coupled joints, as Constraint in constraint.h."""

    _fields_ = [
        *_all(
            ctypes.c_void_p,
            "response",
            "push",
            "passive",
            "followers",
            "leaders",
            "multiplier",
            "offset",
            "wraps",
            "unwrapped",
            "asked",
            "wrong",
            "free",
            "model",
            "implicit",
            "force",
        ),
        *_all(ctypes.c_double, "rate_gain", "position_gain"),
        ("size", ctypes.c_int64),
    ]


class ModelStruct(ctypes.Structure):
    """Rigid-body model of robots, as Model in model.h."""

    _fields_ = [
        *_all(ctypes.c_void_p, "tree", "rows", "inertias"),
        ("gravity", 3 * ctypes.c_double),
        ("dof", ctypes.c_int64),
        *_all(ctypes.c_int32, "varies", "base"),
    ]


class Refresh(ctypes.Structure):
    """Constants of the friction model, as Refresh in refresh.h."""

    _fields_ = [
        *_all(
            ctypes.c_void_p,
            "model",
            "armature",
            "coulomb",
            "viscous",
            "damping",
            "stiffness",
            "leader",
            "multiplier",
        ),
        *_all(ctypes.c_double, "timestep", "share"),
        ("steps", ctypes.c_int64),
    ]


class Stage(ctypes.Structure):
    """Stage of a sim step, as Stage in tick.h."""

    _fields_ = [
        *_all(ctypes.c_int32, "kind", "program"),
        ("noise", 2 * ctypes.c_int32),
        ("every", ctypes.c_int64),
    ]


class Tick(ctypes.Structure):
    """Stages and arrays of ticks, as Tick in tick.h."""

    _fields_ = [
        *_all(
            ctypes.c_void_p,
            "stages",
            "transfers",
            "qpos",
            "qvel",
            "passive",
            "before",
            "pose",
            "rate",
            "qf",
            "tree",
            "bodies",
            "armature",
            "damping",
            "leader",
            "multiplier",
            "matrix",
            "control",
            "measured_force",
            "read_force",
            "refresh",
            "gain",
            "memory",
            "age",
            "target",
            "target_rate",
            "base_pose",
            "base_twist",
            "left",
        ),
        ("noise", 2 * ctypes.c_void_p),
        ("group", ctypes.c_void_p),
        ("timestep", ctypes.c_double),
        *_all(
            ctypes.c_int64, "dof", "stage_count", "transfer_count", "tick", "step", "drawn", "ran"
        ),
        *_all(ctypes.c_int32, "matrix_steps", "gravity", "coriolis", "late", "status", "unused"),
    ]


class Transfer(ctypes.Structure):
    """Copy between the arrays of a tick and a table with an entry for each tick, as Transfer in
    tick.h.
    """

    _fields_ = [
        *_all(ctypes.c_void_p, "table", "row"),
        *_all(ctypes.c_int64, "stride", "size", "step"),
        *_all(ctypes.c_int32, "kind", "unused"),
    ]


_NAMES = (
    *(
        "gateway.cpp",
        "gateway.h",
        "model.h",
        "mujoco_step.h",
        "clearance.h",
        "free_motion.h",
        "constraint.h",
        "refresh.h",
    ),
    *("sim_step.h", "tick.h", "interface.py"),
)

EXTENSIONS = {
    "_gateway": Extension(
        "batchpid.sim.engine.native._gateway",
        (*(f"batchpid/sim/engine/native/{name}" for name in _NAMES), *RIGID_BODIES, *PROGRAMS),
        (*ROUNDED, *VECTORIZED_ONLY, "-pthread", "-Wno-psabi"),
    ),
}
