"""Engines by name. An engine's packages are imported at its first use."""

from __future__ import annotations

from importlib import import_module

from batchpid.checks.validate import choice
from batchpid.sim.engine.protocol import Engine, RobotModel
from batchpid.sim.engine.scene_spec import SceneSpec

MODULES = {"sapien": "batchpid.sim.engine.sapien.sapien_engine"}
"""Module of each engine; its constant ENGINE is the engine."""


def load_engine(name: str = "sapien") -> Engine:
    """Return an engine.

    Raises
    ------
    InvalidArgumentError
        No engine has this name.
    """
    engine: Engine = import_module(MODULES[choice("engine", name, MODULES)]).ENGINE
    return engine


def scene_dynamics(spec: SceneSpec) -> RobotModel:
    """Return the model of the robot of ``spec``, by its engine: the same object for equal specs."""
    return load_engine(spec.engine).scene_dynamics(spec)
