"""Data of a page: a running simulation or a recorded run, whose robots are numbered group by group."""

from dataclasses import replace

import numpy as np

from batchpid.sim.robot.unsettled import unsettled_findings
from batchpid.sim.view.playback import Playback
from batchpid.sim.view.simulation import LiveSimulation

ViewData = LiveSimulation | Playback
PATIENCE = 2.0
"""Time after a change of the setpoint from which a robot should have settled [s]."""


def cause(data: ViewData, robot: int) -> str:
    """Return a sentence on why a robot, numbered over all groups, has not settled since its setpoint last changed.

    Empty if it has, or within :data:`PATIENCE`.
    """
    past = data.history().for_envs([robot])
    changes = np.flatnonzero((past.setpoint != past.setpoint[-1]).any((1, 2)))
    since = past.for_ticks(slice(int(changes[-1]) + 1 if changes.size else 0, None))
    if len(since.time) < 3 or since.time[-1] - since.time[0] < PATIENCE:
        return ""
    since = replace(since, info=replace(data.info_of(robot), start=since.qpos[0].astype(float)))
    return next((str(found).partition(": ")[2] for found in unsettled_findings(since, data.robot)), "")
