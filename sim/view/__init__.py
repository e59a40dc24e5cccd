"""Page on localhost that shows robots as they move, and films of recorded runs; see
docs/files.md.
"""

from batchpid.sim.view.page import View
from batchpid.sim.view.view_data import LiveSimulation, Playback

__all__ = ["LiveSimulation", "Playback", "View"]
