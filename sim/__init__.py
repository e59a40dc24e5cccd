"""The SAPIEN multi-scene runner: load a URDF, run N of that robot under explicit joint control."""

from .check import Finding
from .faults import Fault, FaultWarning
from .limits import SetpointWarning
from .observation import Observation, Rollout
from .physics import Physics
from .pool import RecoveryWarning
from .recorded import Recording, read_recording
from .recording import Recorder
from .robot import Robot
from .runner import Runner
from .snapshot import Snapshot

__all__ = [
    "Fault",
    "FaultWarning",
    "Finding",
    "Observation",
    "Physics",
    "Recorder",
    "Recording",
    "RecoveryWarning",
    "Robot",
    "Rollout",
    "Runner",
    "SetpointWarning",
    "Snapshot",
    "read_recording",
]
