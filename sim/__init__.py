"""Many robots in SAPIEN or MuJoCo: load a URDF or MJCF file, run N copies under explicit joint
control.

Importing it loads nothing: a name loads its module when it is used, and the first :class:`Runner` or
:meth:`Robot.dynamics` its engine.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from batchpid.io.files import attributes_of

if TYPE_CHECKING:
    from batchpid.sim.diagnosis.loop_stability import StabilityWarning
    from batchpid.sim.engine.scene_spec import MujocoSolver, Physics
    from batchpid.sim.findings import Finding, RepairWarning
    from batchpid.sim.loop.arrays import Snapshot
    from batchpid.sim.loop.closed_loop import closed_loop
    from batchpid.sim.loop.faults import Fault, FaultWarning
    from batchpid.sim.options.groups import Controller
    from batchpid.sim.options.options import RunnerOptions
    from batchpid.sim.randomization.distributions import LogUniform, Normal, Uniform
    from batchpid.sim.randomization.randomization import Randomization
    from batchpid.sim.recording.recording_files import (
        RecordingError,
        read_recording,
        write_recording,
    )
    from batchpid.sim.robot.mjcf_export import to_mjcf
    from batchpid.sim.robot.robot import Robot
    from batchpid.sim.robot.urdf_export import to_urdf
    from batchpid.sim.rollout import Rollout, RunInfo
    from batchpid.sim.runner.runner import Runner
    from batchpid.sim.signals import CommandSpec, Observation
    from batchpid.sim.tool_space import OperationalSpace
    from batchpid.sim.workers.pool import RecoveryWarning

__all__ = [
    "CommandSpec",
    "Controller",
    "Fault",
    "FaultWarning",
    "Finding",
    "LogUniform",
    "MujocoSolver",
    "Normal",
    "Observation",
    "OperationalSpace",
    "Physics",
    "Randomization",
    "RecordingError",
    "RecoveryWarning",
    "RepairWarning",
    "Robot",
    "Rollout",
    "RunInfo",
    "Runner",
    "RunnerOptions",
    "Snapshot",
    "StabilityWarning",
    "Uniform",
    "closed_loop",
    "read_recording",
    "to_mjcf",
    "to_urdf",
    "write_recording",
]

_MODULES = ("gym", "identification", "plots", "tuning", "view")
"""Public modules, which are imported when they are used."""
_PLACES = {
    "CommandSpec": "batchpid.sim.signals",
    "Controller": "batchpid.sim.options.groups",
    "Fault": "batchpid.sim.loop.faults",
    "FaultWarning": "batchpid.sim.loop.faults",
    "Finding": "batchpid.sim.findings",
    "LogUniform": "batchpid.sim.randomization.distributions",
    "MujocoSolver": "batchpid.sim.engine.scene_spec",
    "Normal": "batchpid.sim.randomization.distributions",
    "Observation": "batchpid.sim.signals",
    "OperationalSpace": "batchpid.sim.tool_space",
    "Physics": "batchpid.sim.engine.scene_spec",
    "Randomization": "batchpid.sim.randomization.randomization",
    "RecordingError": "batchpid.sim.recording.recording_files",
    "RecoveryWarning": "batchpid.sim.workers.pool",
    "RepairWarning": "batchpid.sim.findings",
    "Robot": "batchpid.sim.robot.robot",
    "Rollout": "batchpid.sim.rollout",
    "RunInfo": "batchpid.sim.rollout",
    "Runner": "batchpid.sim.runner.runner",
    "RunnerOptions": "batchpid.sim.options.options",
    "Snapshot": "batchpid.sim.loop.arrays",
    "StabilityWarning": "batchpid.sim.diagnosis.loop_stability",
    "Uniform": "batchpid.sim.randomization.distributions",
    "closed_loop": "batchpid.sim.loop.closed_loop",
    "read_recording": "batchpid.sim.recording.recording_files",
    "to_mjcf": "batchpid.sim.robot.mjcf_export",
    "to_urdf": "batchpid.sim.robot.urdf_export",
    "write_recording": "batchpid.sim.recording.recording_files",
}
"""Modules of the public names."""


__getattr__ = attributes_of(__name__, _MODULES, _PLACES)


def __dir__() -> list[str]:
    return [*__all__, *_MODULES]
