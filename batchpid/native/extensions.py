"""Native extensions: their files, digests, and loading of those that were built from the present files.

C++ code repeats tables of the Python code, so an extension works only with the Python code that it was built
with. ``setup.py`` compiles a digest of the tables and one of the sources into each extension, and :func:`load`
compares them. ``setup.py`` imports this module without its package, before NumPy is installed: it may import the
standard library only. Modules that define extensions may import this one.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[2]
NOT_BUILT = "the extension was not built: it needs a C++ compiler when batchpid is installed"
ROUNDED = (
    *("-std=c++17", "-O3", "-g0", "-fvisibility=hidden"),
    *("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"),
)
"""Compiler flags under which each operation is rounded as in NumPy: operations are not fused."""
LANES_ONLY = (
    *("-O2", "-fvect-cost-model=dynamic", "-fno-tree-loop-vectorize", "-fpeel-loops", "-Wno-psabi"),
    *("--param=max-completely-peel-times=6", "--param=max-completely-peeled-insns=120"),
)
"""Flags for code that computes on Lanes (lanes.h), which are vectors already: compiled in about half the time of
-O3."""


class StaleExtensionError(ImportError):
    """Extension that was built from other sources or tables, or that cannot be loaded."""


class Extension(NamedTuple):
    """Extension module in C++."""

    module: str
    """Full name, e.g. "batchpid.native._program"."""
    files: tuple[str, ...]
    """Paths in the repository: the file to compile, and the headers that it includes."""
    flags: tuple[str, ...]
    """Compiler flags."""
    tables: Callable[[], Any]
    """Function that returns the tables which C++ and Python share."""

    @property
    def name(self) -> str:
        """Name within its package."""
        return self.module.rpartition(".")[2]

    def tables_digest(self) -> str:
        """Return a digest of the shared tables and of the compiler flags."""
        return _digest(repr((self.tables(), self.flags)).encode())

    def sources_digest(self, root: Path = ROOT) -> str | None:
        """Return a digest of the C++ files; None if some are missing: only a build needs them."""
        try:
            return _digest(*((root / file).read_bytes() for file in self.files))
        except OSError:
            return None


@cache
def load(extension: Extension) -> Any:
    """Return the module of an extension.

    Raises
    ------
    StaleExtensionError
        It was built from other sources or tables, or cannot be loaded.
    ModuleNotFoundError
        It was not built.
    """
    try:
        module = importlib.import_module(extension.module)
    except ModuleNotFoundError:
        raise ModuleNotFoundError(NOT_BUILT, name=extension.module) from None
    except ImportError as error:
        raise StaleExtensionError(f"cannot be loaded ({error})") from error
    if (changed := _changed(extension, module)) is not None:
        raise StaleExtensionError(f"was built from other {changed}")
    return module


def load_all(extensions: Iterable[Extension]) -> list[Any]:
    """Return the modules of extensions.

    Raises
    ------
    StaleExtensionError
        Some are stale; the message names all of these and the remedy.
    ModuleNotFoundError
        One was not built.
    """
    found, problems = [], []
    for extension in extensions:
        try:
            found.append(load(extension))
        except StaleExtensionError as error:
            problems.append(f"{extension.name} {error}")
    if problems:
        raise StaleExtensionError(f"{', '.join(problems)}; {_remedy(extensions)}")
    return found


def _remedy(extensions: Iterable[Extension]) -> str:
    """Return the remedy for a stale extension."""
    if all((ROOT / file).is_file() for file in ("setup.py", *(each.files[0] for each in extensions))):
        return f"run 'python setup.py build_ext --inplace --force' in {ROOT}"
    return "install batchpid again"


def _changed(extension: Extension, module: ModuleType) -> str | None:
    """Return "tables" or "sources" if these have changed since an extension was built, or None."""
    if getattr(module, "tables", None) != extension.tables_digest():
        return "tables"
    sources = extension.sources_digest()
    return None if sources in (None, getattr(module, "sources", None)) else "sources"


def _digest(*parts: bytes) -> str:
    """Return a hash of ``parts`` in order."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()
