"""Functions of SAPIEN's shared library that the gateway calls."""

from __future__ import annotations

import ctypes
import warnings
from functools import cache
from pathlib import Path
from typing import Any

from batchpid.sim.engine.native.interface import SYMBOLS


def import_sapien() -> Any:
    """Return the module ``sapien``, imported without its warnings about things that are not used here."""
    with warnings.catch_warnings():
        # Without a system Vulkan SAPIEN warns that it falls back to its own; nothing here renders.
        warnings.filterwarnings("ignore", message=".*libvulkan.*")
        warnings.filterwarnings("ignore", message=".*pkg_resources.*")
        import sapien
    return sapien


@cache
def sapien_library() -> Path:
    """Return the path of SAPIEN's shared library, which is loaded with its Python package."""
    import_sapien()
    with open("/proc/self/maps", encoding="utf-8", errors="replace") as maps:
        paths = {line.split(maxsplit=5)[-1].strip() for line in maps if "libsapien" in line}
    if len(paths) != 1:
        raise OSError("SAPIEN's shared library is not loaded, or more than once")
    return Path(paths.pop())


@cache
def functions() -> tuple[int, ...]:
    """Return the addresses of the exported functions; AttributeError names one that is missing."""
    library = ctypes.CDLL(str(sapien_library()))
    return tuple(ctypes.cast(getattr(library, symbol), ctypes.c_void_p).value or 0 for symbol in SYMBOLS)
