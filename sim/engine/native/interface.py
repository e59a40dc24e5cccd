"""Interface between Python and the native extensions: sources, flags, tables, and a digest of each.

The C++ code repeats these tables, so an extension works with the Python code that it was built with and with no other.
``setup.py`` compiles the digests into each extension, and :mod:`sim.engine.native.loading` compares them. ``setup.py``
runs this file by its path, before batchpid is installed: it may import the standard library only.
"""

from __future__ import annotations

import ctypes
import hashlib
from pathlib import Path
from typing import Any, NamedTuple

FOLDER = Path(__file__).parent


class Sources(NamedTuple):
    """Files of an extension in this folder, and its compiler flags."""

    unit: str
    headers: tuple[str, ...]
    flags: tuple[str, ...]


_GATEWAY_HEADERS = ("buffer.h", "extension.h", "gateway.h", "rigid_body.h", "sim_step.h", "xla_call.h")
_ROUNDED = ("-std=c++17", "-O3", "-ffp-contract=off", "-fno-math-errno")
"""Operations are not fused, so that each is rounded as in NumPy."""
EXTENSIONS = {
    "_gateway": Sources("gateway.cpp", _GATEWAY_HEADERS, ("-std=c++17", "-O2")),
    "_batch_dynamics": Sources(
        "batch_dynamics.cpp", ("buffer.h", "extension.h", "rigid_body.h"), (*_ROUNDED, "-Wno-psabi")
    ),
    "_law_program": Sources("law_program.cpp", ("extension.h",), _ROUNDED),
}

SYMBOLS = (
    "_ZN6sapien5physx17PhysxArticulation7getQposEv",
    "_ZN6sapien5physx17PhysxArticulation7getQvelEv",
    "_ZN6sapien5physx17PhysxArticulation19computePassiveForceEbb",
    "_ZN6sapien5physx17PhysxArticulation5setQfERKN5Eigen6MatrixIfLin1ELi1ELi0ELin1ELi1EEE",
    "_ZN6sapien5physx14PhysxSystemCpu4stepEv",
)
"""Functions of SAPIEN, in the order of Functions in gateway.h."""
STATUS = ("left_region", "contacts", "not_finite", "too_fast", "failed")
"""Bits of the status of a sim step: reasons for which a loop over sim steps has to stop, as Status in sim_step.h."""
BODY = {"rotation": 9, "position": 3, "mass": 1, "center": 3, "tensor": 9}
"""Numbers in a row of constants of a body, as BodyRow in rigid_body.h."""
DYNAMICS = ("qpos", "qvel", "payload", "matrix", "force", "payload_force")
"""Arrays of ``dynamics`` in batch_dynamics.cpp, after the tree."""
STEP = ("qpos", "qvel", "friction", "matrix", "effort", "added", "limit", "keep", "creep", "low", "high")
"""Arrays of ``step``, as Leaf in batch_dynamics.cpp."""
OPERATIONS = (
    *("add", "subtract", "multiply", "divide", "maximum", "minimum", "greater", "less", "not_equal", "and"),
    *("negative", "absolute", "rint", "isfinite", "where", "row_minimum", "matrix_vector"),
)
"""Operations of programs, as Code in law_program.cpp."""
OPERATION = ("code", "out", "first", "second", "third")
"""int32 numbers of an operation: its code, and registers; as Operation in law_program.cpp."""
FARTHEST = 1e6
"""Largest position of a joint [rad or m], as in sim_step.h. A robot beyond it has failed: its state is of float32."""
MOST_SUMMED = 128
"""Largest number of terms for which a sum has NumPy's order."""


class Group(ctypes.Structure):
    """Group of robots, as Group in sim_step.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("gateway", "qf", "skip", "system_of", "contacts", "watched")),
        *((name, ctypes.c_void_p) for name in ("bodies", "robot_of")),
        *((name, ctypes.c_void_p) for name in ("known", "places", "arms", "sizes", "used", "outside", "speed_limit")),
        ("pairs", ctypes.c_int64),
        ("bodies_size", ctypes.c_int64),
        ("gravity", ctypes.c_int32),
        ("coriolis", ctypes.c_int32),
        ("velocities", ctypes.c_int32),
        ("unused", ctypes.c_int32),
        ("message", ctypes.c_char * 256),
    ]


def tables_digest(name: str) -> str:
    """Return a digest of the tables that an extension shares with Python, and of its compiler flags."""
    group = [(field, getattr(Group, field).offset, getattr(Group, field).size) for field, *_ in Group._fields_]
    tables: dict[str, Any] = {
        "_gateway": (SYMBOLS, STATUS, FARTHEST, group, list(BODY.items())),
        "_batch_dynamics": (DYNAMICS, STEP, list(BODY.items())),
        "_law_program": (OPERATIONS, OPERATION, MOST_SUMMED),
    }
    return _digest(repr((tables[name], EXTENSIONS[name].flags)).encode())


def sources_digest(name: str, folder: Path = FOLDER) -> str | None:
    """Return a digest of an extension's C++ files; None if some are missing: only a build needs them."""
    unit, headers, _ = EXTENSIONS[name]
    try:
        return _digest(*((folder / file).read_bytes() for file in (unit, *headers)))
    except OSError:
        return None


def _digest(*parts: bytes) -> str:
    """Return a hash of ``parts`` in order."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()
