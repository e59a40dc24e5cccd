"""Native extensions, loaded only if they were built from the present tables and sources."""

from __future__ import annotations

import importlib
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from sim.engine.native.interface import EXTENSIONS, FOLDER, sources_digest, tables_digest

ROOT = Path(__file__).parents[3]
NOT_BUILT = "the extension was not built: it needs a C++ compiler when batchpid is installed"


class StaleExtensionError(ImportError):
    """Extension that was built from other sources or tables, or that cannot be loaded."""


@cache
def extension(name: str) -> Any:
    """Return the extension ``name`` of :data:`interface.EXTENSIONS`.

    Raises
    ------
    StaleExtensionError
        It was built from other sources or tables, or cannot be loaded.
    ModuleNotFoundError
        It was not built.
    """
    full_name = f"{__package__}.{name}"
    try:
        module = importlib.import_module(full_name)
    except ModuleNotFoundError:
        raise ModuleNotFoundError(NOT_BUILT, name=full_name) from None
    except ImportError as error:
        raise StaleExtensionError(f"cannot be loaded ({error})") from error
    if (changed := _changed(name, module)) is not None:
        raise StaleExtensionError(f"was built from other {changed}")
    return module


def extensions() -> dict[str, Any]:
    """Return all extensions by name.

    Raises
    ------
    StaleExtensionError
        Some are stale; the message names all of these and the remedy.
    ModuleNotFoundError
        One was not built.
    """
    found, problems = {}, []
    for name in EXTENSIONS:
        try:
            found[name] = extension(name)
        except StaleExtensionError as error:
            problems.append(f"{name} {error}")
    if problems:
        raise StaleExtensionError(f"{', '.join(problems)}; {remedy()}")
    return found


def remedy() -> str:
    """Return the remedy for a stale extension, for messages."""
    if (ROOT / "setup.py").is_file() and (FOLDER / EXTENSIONS["_gateway"].unit).is_file():
        return f"run 'python setup.py build_ext --inplace --force' in {ROOT}"
    return "install batchpid again"


def _changed(name: str, module: ModuleType) -> str | None:
    """Return "tables" or "sources" if these have changed since an extension was built, or None."""
    if getattr(module, "tables", None) != tables_digest(name):
        return "tables"
    sources = sources_digest(name)
    return None if sources in (None, getattr(module, "sources", None)) else "sources"
