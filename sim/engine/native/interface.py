"""Interface between Python and the native extensions: files, flags and tables.

The C++ code repeats these tables: see :mod:`batchpid.native.extensions`. ``setup.py`` imports this
module without its package, so it may import only that module, others that it lists before this one,
and the standard library.
"""

from __future__ import annotations

import ctypes

from batchpid.native.extensions import ROUNDED, VECTORIZED_ONLY, Extension
from batchpid.native.operations import PROGRAMS
from batchpid.native.task_space_extension import RIGID_BODIES

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


class Group(ctypes.Structure):
    """Group of robots, as Group in sim_step.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("gateway", "qf", "skip", "speed_limit")),
        *((name, ctypes.c_void_p) for name in ("mujoco", "constraint", "joints")),
        ("robots", ctypes.c_int64),
        ("dof", ctypes.c_int64),
        ("gravity", ctypes.c_int32),
        ("coriolis", ctypes.c_int32),
        ("velocities", ctypes.c_int32),
        ("senses", ctypes.c_int32),
        ("message", ctypes.c_char * 256),
    ]


class Clearance(ctypes.Structure):
    """Shapes of robots in MuJoCo, and their clearances, as Clearance in clearance.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("kinematics", "models", "places", "turns")),
        *((name, ctypes.c_void_p) for name in ("kinds", "sizes", "radii", "hulls", "vertices")),
        *(
            (name, ctypes.c_void_p)
            for name in ("pairs", "bodies", "arms", "arm_ways", "begins", "travel")
        ),
        *(
            (name, ctypes.c_void_p)
            for name in ("last", "moved", "left", "rate", "wait", "age", "brief", "near", "open")
        ),
        *((name, ctypes.c_void_p) for name in ("no_shapes", "some_types")),
        *((name, ctypes.c_int64) for name in ("number", "ways", "size")),
        *((name, ctypes.c_int64) for name in ("flags", "counts", "types_at", "affinities_at")),
        *((name, ctypes.c_int32) for name in ("contact", "floats")),
    ]


class Mujoco(ctypes.Structure):
    """Robots in MuJoCo, as Mujoco in mujoco_step.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("step1", "step2", "set_log_handler", "clock")),
        *((name, ctypes.c_void_p) for name in ("models", "data")),
        *(
            (name, ctypes.c_void_p)
            for name in ("qpos", "qvel", "applied", "bias", "qpos_at", "qvel_at", "qf")
        ),
        *((name, ctypes.c_void_p) for name in ("ctrl", "stiffness", "rate_gain")),
        *((name, ctypes.c_void_p) for name in ("clearance", "sensors", "sensed")),
        *((name, ctypes.c_int64) for name in ("sensor_size", "base_qpos", "base_qvel")),
    ]


class Constraint(ctypes.Structure):
    """Constraint of coupled joints, as Constraint in constraint.h."""

    _fields_ = [
        *(
            (name, ctypes.c_void_p)
            for name in ("response", "push", "passive", "followers", "leaders")
        ),
        *(
            (name, ctypes.c_void_p)
            for name in ("multiplier", "offset", "wraps", "unwrapped", "asked", "wrong", "free")
        ),
        *((name, ctypes.c_void_p) for name in ("model", "implicit", "force")),
        ("rate_gain", ctypes.c_double),
        ("position_gain", ctypes.c_double),
        ("size", ctypes.c_int64),
    ]


class ModelStruct(ctypes.Structure):
    """Rigid-body model of robots, as Model in model.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("tree", "rows", "inertias")),
        ("gravity", 3 * ctypes.c_double),
        ("dof", ctypes.c_int64),
        ("varies", ctypes.c_int32),
        ("base", ctypes.c_int32),
    ]


class Refresh(ctypes.Structure):
    """Constants of the friction model, as Refresh in refresh.h."""

    _fields_ = [
        *(
            (name, ctypes.c_void_p)
            for name in ("model", "armature", "coulomb", "viscous", "damping", "stiffness")
        ),
        *((name, ctypes.c_void_p) for name in ("leader", "multiplier")),
        ("timestep", ctypes.c_double),
        ("share", ctypes.c_double),
        ("steps", ctypes.c_int64),
    ]


class Stage(ctypes.Structure):
    """Stage of a sim step, as Stage in tick.h."""

    _fields_ = [
        *((name, ctypes.c_int32) for name in ("kind", "program")),
        ("noise", 2 * ctypes.c_int32),
        ("every", ctypes.c_int64),
    ]


class Tick(ctypes.Structure):
    """Stages and arrays of ticks, as Tick in tick.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("stages", "transfers")),
        *(
            (name, ctypes.c_void_p)
            for name in ("qpos", "qvel", "passive", "before", "pose", "rate", "qf")
        ),
        *((name, ctypes.c_void_p) for name in ("tree", "bodies", "armature", "damping")),
        *((name, ctypes.c_void_p) for name in ("leader", "multiplier", "matrix", "control")),
        *((name, ctypes.c_void_p) for name in ("measured_force", "read_force", "refresh")),
        *((name, ctypes.c_void_p) for name in ("gain", "memory", "age", "target", "target_rate")),
        *((name, ctypes.c_void_p) for name in ("base_pose", "base_twist", "left")),
        ("noise", 2 * ctypes.c_void_p),
        ("group", ctypes.c_void_p),
        ("timestep", ctypes.c_double),
        *((name, ctypes.c_int64) for name in ("dof", "stage_count", "transfer_count")),
        *((name, ctypes.c_int64) for name in ("tick", "step", "drawn", "ran")),
        *((name, ctypes.c_int32) for name in ("matrix_steps",)),
        *((name, ctypes.c_int32) for name in ("gravity", "coriolis", "late", "status", "unused")),
    ]


class Transfer(ctypes.Structure):
    """Copy between the arrays of a tick and a table with an entry for each tick, as Transfer in
    tick.h.
    """

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("table", "row")),
        *((name, ctypes.c_int64) for name in ("stride", "size")),
        *((name, ctypes.c_int32) for name in ("kind", "unused")),
    ]


_NAMES = (
    *(
        "gateway.cpp",
        "gateway.h",
        "model.h",
        "mujoco_step.h",
        "clearance.h",
        "constraint.h",
        "refresh.h",
    ),
    *("sim_step.h", "tick.h", "xla_call.h", "interface.py"),
)

EXTENSIONS = {
    "_gateway": Extension(
        "batchpid.sim.engine.native._gateway",
        (*(f"batchpid/sim/engine/native/{name}" for name in _NAMES), *RIGID_BODIES, *PROGRAMS),
        (*ROUNDED, *VECTORIZED_ONLY, "-pthread", "-Wno-psabi"),
    ),
}
