"""The SAPIEN multi-scene runner: load a URDF, run N of that robot under explicit joint control.

Importing it does not load SAPIEN; the first use of :class:`Runner` or of :meth:`Robot.dynamics` does.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

for _name in ("batchpid", "assets"):
    _origin = getattr(importlib.util.find_spec(_name), "origin", None)
    if _origin and Path(_origin) != Path(__file__).parents[1] / _name / "__init__.py":
        raise ImportError(f"{_origin} hides the package {_name!r} that sim needs; rename it or run in another folder")

import batchpid.startup  # noqa: F401 - checks the import path before NumPy is imported
from sim.cluster import ClusterWarning, Ray
from sim.command import CommandSpec
from sim.loop.contact_log import MissedContact, MissedContactWarning
from sim.loop.faults import Fault, FaultWarning
from sim.loop.snapshot import Snapshot
from sim.observation import Observation, Rollout, RunInfo
from sim.options import Controller, RunnerOptions
from sim.randomization.distributions import Choice, LogUniform, Normal, Uniform
from sim.randomization.randomization import Randomization
from sim.recording.files import RecordingError, read_recording, write_recording
from sim.recording.recorder import Recorder
from sim.robot.description import RobotFunctions, register_engine
from sim.robot.findings import Finding
from sim.robot.limits import SetpointWarning
from sim.robot.robot import Robot
from sim.robot.stability import StabilityWarning

if TYPE_CHECKING:
    from sim.engine.sapien.physics import Physics
    from sim.runner import Runner
    from sim.workers.pool import RecoveryWarning

__all__ = [
    "Choice",
    "ClusterWarning",
    "CommandSpec",
    "Controller",
    "Fault",
    "FaultWarning",
    "Finding",
    "LogUniform",
    "MissedContact",
    "MissedContactWarning",
    "Normal",
    "Observation",
    "Physics",
    "Randomization",
    "Ray",
    "Recorder",
    "RecordingError",
    "RecoveryWarning",
    "Robot",
    "Rollout",
    "RunInfo",
    "Runner",
    "RunnerOptions",
    "SetpointWarning",
    "Snapshot",
    "StabilityWarning",
    "Uniform",
    "read_recording",
    "write_recording",
]

_LOADS_SAPIEN = {"Physics": "sim.engine.sapien.physics", "Runner": "sim.runner", "RecoveryWarning": "sim.workers.pool"}


def __getattr__(name: str) -> Any:
    if name not in _LOADS_SAPIEN:
        raise AttributeError(f"module 'sim' has no attribute {name!r}")
    return getattr(importlib.import_module(_LOADS_SAPIEN[name]), name)


def _engine() -> RobotFunctions:
    from sim.engine.engines import load_engine

    return load_engine()


register_engine(_engine)
