"""Data of a page: a running simulation or a recorded run, whose robots are numbered group by group."""

from batchpid.sim.view.playback import Playback
from batchpid.sim.view.simulation import LiveSimulation

ViewData = LiveSimulation | Playback
