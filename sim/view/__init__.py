"""Page on localhost that shows robots as they move, and films of recorded runs; see docs/view.md."""

from sim.view.page import View
from sim.view.playback import Playback
from sim.view.simulation import LiveSimulation

__all__ = ["LiveSimulation", "Playback", "View"]
