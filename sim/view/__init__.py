"""A page on localhost that shows robots as they move; see docs/view.md.

Nothing here touches the simulation's loop: link poses are computed beside it, from qpos.
"""

from .live import Live
from .playback import Playback
from .session import View

__all__ = ["Live", "Playback", "View"]
