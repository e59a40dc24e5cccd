"""SAPIEN's shared library: whether native code can call it, and the functions that the gateway
calls.
"""

from __future__ import annotations

import ctypes
import warnings
from functools import cache
from pathlib import Path
from typing import Any

from batchpid.sim.engine import native
from batchpid.sim.engine.native.interface import SYMBOLS

TESTED = ("3.0.3",)
"""Versions of SAPIEN that native code calls; tests/sim/test_conformance.py must pass with each.

The gateway repeats the layout of two types of SAPIEN (gateway.h). No header promises it, and the
names of the functions do not contain the type that they return: a version that changes it would
corrupt memory.
"""


def import_sapien() -> Any:
    """Return the module ``sapien``, imported without its warnings about things that are not used
    here.
    """
    with warnings.catch_warnings():
        # Without a system Vulkan SAPIEN warns that it falls back to its own; nothing here renders.
        warnings.filterwarnings("ignore", message=".*libvulkan.*")
        warnings.filterwarnings("ignore", message=".*pkg_resources.*")
        import sapien
    return sapien


def obstacle() -> str:
    """Return why native code cannot call SAPIEN; "" if it can."""
    if reason := native.obstacle():
        return reason
    if (version := import_sapien().__version__) not in TESTED:
        return f"native calls are not tested with SAPIEN {version}; install sapien=={TESTED[-1]}"
    try:
        functions()
    except (OSError, AttributeError) as error:
        return f"SAPIEN {version} has another library: {error}; install sapien=={version} from PyPI"
    return ""


@cache
def functions() -> tuple[int, ...]:
    """Return the addresses of the exported functions; AttributeError names one that is missing."""
    folder = Path(import_sapien().__file__).parent
    paths = [
        path
        for place in (folder, folder.parent / "sapien.libs")
        for path in place.glob("libsapien*.so*")
    ]
    if len(paths) != 1:
        raise OSError("libsapien.so is missing, or there is more than one")
    library = ctypes.CDLL(str(paths[0]))
    return tuple(
        ctypes.cast(getattr(library, symbol), ctypes.c_void_p).value or 0 for symbol in SYMBOLS
    )
