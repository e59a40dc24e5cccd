"""Page on localhost that shows robots as they move, and films; see docs/view.md.

Link poses are computed from qpos by forward kinematics, so that showing robots does not slow the runner's loop.
"""

from sim.view.playback import Playback
from sim.view.session import View
from sim.view.simulation import LiveSimulation

__all__ = ["LiveSimulation", "Playback", "View"]
