"""Functions of SAPIEN's shared library that the gateway calls."""

from __future__ import annotations

import ctypes
import warnings
from functools import cache
from importlib.util import find_spec
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
    """Return the path of SAPIEN's shared library, which comes with its Python package; that is not imported."""
    spec = find_spec("sapien")
    packages = [] if spec is None else [Path(folder) for folder in spec.submodule_search_locations or ()]
    folders = [folder for package in packages for folder in (package, package.parent / "sapien.libs")]
    paths = [path for folder in folders for path in folder.glob("libsapien*.so*")]
    if len(paths) != 1:
        raise OSError("SAPIEN's shared library is not installed, or more than once")
    return paths[0]


@cache
def functions() -> tuple[int, ...]:
    """Return the addresses of the exported functions; AttributeError names one that is missing."""
    import_sapien()
    library = ctypes.CDLL(str(sapien_library()))
    return tuple(ctypes.cast(getattr(library, symbol), ctypes.c_void_p).value or 0 for symbol in SYMBOLS)
