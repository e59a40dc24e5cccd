"""Page on localhost that shows robots as they move, and films of recorded runs; see
docs/files.md.
"""

from batchpid.sim.view.page import View
from batchpid.sim.view.playback import Playback
from batchpid.sim.view.simulation import LiveSimulation

__all__ = ["LiveSimulation", "Playback", "View"]
