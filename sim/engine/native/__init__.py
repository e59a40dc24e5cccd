"""Native extension: programs on arrays, dynamics of many robots, and calls into the engines.

Where it is not used, and with the environment variable ``BATCHPID_NATIVE=0``, Python does the same
work. C++ headers alone describe the structures, and :func:`structure` reads them. ``setup.py``
imports this module, so it may import only the controller, NumPy and the standard library.
"""

from __future__ import annotations

import ctypes
from functools import cache
from types import ModuleType
from typing import Any

from batchpid.native import array_program
from batchpid.native.array_program import SWITCH
from batchpid.native.extensions import (
    PROGRAMS,
    RIGID_BODIES,
    ROUNDED,
    VECTORIZED_ONLY,
    Extension,
    load,
)

__all__ = [
    "EXTENSIONS",
    "FARTHEST",
    "SWITCH",
    "WIDTH",
    "extension",
    "number",
    "obstacle",
    "structure",
]

WIDTH = 8
"""Number of robots in a vector."""
FARTHEST = 1e6
"""Largest position of a joint [rad or m]. A robot beyond it has failed: its state is float32."""


@cache
def structure(name: str) -> Any:
    """Return a structure of the C++ headers that is marked FOR_PYTHON, as a type of ctypes.

    ``setup.py`` finds the names of the fields, and the extension has their types.
    """
    fields = load(EXTENSIONS["_gateway"]).fields
    members = [row[1:4] for row in fields if row[0] == name]
    types = [
        (field, count * _TYPES[kind] if count > 1 else _TYPES[kind])
        for field, kind, count in members
    ]
    return type(name, (ctypes.Structure,), {"_fields_": types})


def number(name: str, entry: str) -> int:
    """Return the number of an entry of an enumeration of the C++ headers."""
    value: int = load(EXTENSIONS["_gateway"]).numbers[f"{name}.{entry}"]
    return value


def obstacle() -> str:
    """Return why native code is not used, "" if it is; further reasons are
    :meth:`Engine.native_obstacle`.
    """
    return array_program.obstacle(*EXTENSIONS.values())


def extension(name: str) -> ModuleType:
    """Return the extension ``name`` of :data:`EXTENSIONS`; errors as
    :func:`batchpid.native.extensions.load`.

    It does not depend on :func:`obstacle`.
    """
    return load(EXTENSIONS[name])


_TYPES: dict[str, Any] = {
    "P": ctypes.c_void_p,
    "d": ctypes.c_double,
    "q": ctypes.c_int64,
    "i": ctypes.c_int32,
    "c": ctypes.c_char,
}
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
    *("sim_step.h", "tick.h", "structures.h", "passes.h", "__init__.py"),
)

EXTENSIONS = {
    "_gateway": Extension(
        "batchpid.sim.engine.native._gateway",
        (*(f"batchpid/sim/engine/native/{name}" for name in _NAMES), *RIGID_BODIES, *PROGRAMS),
        (*ROUNDED, *VECTORIZED_ONLY, "-pthread", "-Wno-psabi"),
    ),
}
