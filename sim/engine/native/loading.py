"""The native extensions that native calls need, loaded by :mod:`batchpid.native.extensions`."""

from __future__ import annotations

from typing import Any

from batchpid.native.extensions import load, load_all
from batchpid.native.operations import PROGRAM
from batchpid.sim.engine.native.interface import EXTENSIONS


def extension(name: str) -> Any:
    """Return the extension ``name`` of :data:`interface.EXTENSIONS`; errors as :func:`batchpid.native.extensions.load`.

    It does not depend on the verdict.
    """
    return load(EXTENSIONS[name])


def extensions() -> list[Any]:
    """Return all extensions, the one for programs included; errors as :func:`batchpid.native.extensions.load_all`."""
    return load_all((*EXTENSIONS.values(), PROGRAM))
