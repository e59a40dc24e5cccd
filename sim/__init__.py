"""The SAPIEN multi-scene runner: load a URDF, run N of that robot under explicit joint control."""

from sim.engine.dynamics import robot_dynamics
from sim.engine.physics import Physics
from sim.loop.faults import Fault, FaultWarning
from sim.loop.snapshot import Snapshot
from sim.observation import Observation, Rollout
from sim.recording.reader import Recording, read_recording
from sim.recording.recorder import Recorder
from sim.robot.description import register_dynamics
from sim.robot.limits import SetpointWarning
from sim.robot.preflight import Finding
from sim.robot.robot import Robot
from sim.runner import Runner
from sim.workers.pool import RecoveryWarning

register_dynamics(robot_dynamics)

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
