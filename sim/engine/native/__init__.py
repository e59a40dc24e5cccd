"""Native extensions: programs on arrays, dynamics of many robots, and calls into the engines.

Where they are not used, and with the environment variable ``BATCHPID_NATIVE=0``, Python does the
same work.
"""

from __future__ import annotations

from types import ModuleType

from batchpid.native import array_program
from batchpid.native.array_program import SWITCH
from batchpid.native.extensions import load
from batchpid.sim.engine.native.interface import EXTENSIONS

__all__ = ["SWITCH", "describe_calls", "extension", "obstacle"]


def obstacle() -> str:
    """Return why native code is not used, "" if it is; further reasons are
    :meth:`Engine.native_obstacle`.
    """
    return array_program.obstacle(*EXTENSIONS.values())


def describe_calls(engine: str, obstacle: str) -> str:
    """Return the kind of the calls into ``engine``, with the ``obstacle`` to native ones."""
    if obstacle:
        return f"Python calls into {engine} ({obstacle})"
    return f"native calls into {engine}"


def extension(name: str) -> ModuleType:
    """Return the extension ``name`` of :data:`interface.EXTENSIONS`; errors as
    :func:`batchpid.native.extensions.load`.

    It does not depend on :func:`obstacle`.
    """
    return load(EXTENSIONS[name])
