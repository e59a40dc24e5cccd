"""Engines by name. An engine's packages are imported at its first use."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from sys import modules

from batchpid.checks.validate import choice
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.sim.engine.protocol import Engine

MODULES = {
    "sapien": "batchpid.sim.engine.sapien.sapien_engine",
    "mujoco": "batchpid.sim.engine.mujoco.mujoco_engine",
}
"""Module of each engine; its constant ENGINE is the engine."""


def load_engine(name: str = "sapien") -> Engine:
    """Return an engine.

    Raises
    ------
    InvalidArgumentError
        No engine has this name, or SAPIEN is not installed.
    MissingDependencyError
        MuJoCo is too old.
    """
    module = MODULES[choice("engine", name, MODULES)]
    if name == "mujoco" and module not in modules:
        _require_mujoco()
    if name == "sapien" and module not in modules and find_spec("sapien") is None:
        problem = "is not installed: SAPIEN is for Linux on x86-64"
        raise InvalidArgumentError("engine", problem, value=name, remedy="use 'mujoco'")
    engine: Engine = import_module(module).ENGINE
    return engine


def _require_mujoco() -> None:
    try:
        import_module("mujoco.batch")
    except ImportError as error:
        raise MissingDependencyError("mujoco>=3.17", "the engine 'mujoco'") from error
