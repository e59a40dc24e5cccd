"""The SAPIEN multi-scene runner: load a URDF, run N of that robot under explicit joint control."""

from .check import Finding
from .physics import Physics
from .robot import Robot
from .runner import Observation, Rollout, Runner, SetpointWarning

__all__ = ["Finding", "Observation", "Physics", "Robot", "Rollout", "Runner", "SetpointWarning"]
