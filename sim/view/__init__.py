"""A page on localhost that shows robots as they move; see docs/view.md.

Nothing here touches the simulation's loop: link poses are computed beside it, from qpos.
"""

from sim.view.playback import Playback
from sim.view.session import View
from sim.view.simulation import Live

__all__ = ["Live", "Playback", "View"]
