"""The view names the reason for which the watched robot has not settled."""

import numpy as np
import pytest

from batchpid.sim import Runner
from batchpid.sim.view.panel import cause
from batchpid.sim.view.playback import Playback
from batchpid.sim.view.simulation import LiveSimulation

BELOW = np.array([0, 1.7, 0, -1.2, 0, 1.5, 0, 0.02, 0.02])


def advance(live, seconds):
    for _ in range(round(seconds / live.period)):
        live.advance()


def test_a_robot_that_is_moved_into_the_ground(panda):
    live = LiveSimulation(panda, 2, workers=0, engine="mujoco", spread=0.0)
    try:
        advance(live, 2.2)
        assert cause(live, 0) == ""
        live.set_setpoint(BELOW, env=1)
        advance(live, 1.0)
        assert cause(live, 1) == ""  # it may be on its way
        advance(live, 1.2)
        assert cause(live, 0) == ""
        assert "is pressed into the ground" in cause(live, 1)
        assert "env 0" in cause(live, 1)
    finally:
        live.close()


def test_a_target_out_of_reach(panda):
    live = LiveSimulation(panda, 1, controls=("osc",), workers=0, engine="mujoco", spread=0.0)
    try:
        live.set_target([2.0, 0.0, 0.5, 0.0, 1.0, 0.0, 0.0])
        advance(live, 2.2)
        assert "no pose within the joint limits" in cause(live, 0)
    finally:
        live.close()


@pytest.mark.parametrize("env", [0, 1])
def test_a_recorded_run(panda, env):
    setpoints = np.tile([panda.start, BELOW], (210, 1, 1))
    with Runner(panda, 2, workers=0, engine="mujoco", substeps=20) as runner:
        playback = Playback(runner.rollout(setpoints), panda)
    playback.seek(playback.duration)
    assert ("is pressed into the ground" in cause(playback, env)) == (env == 1)
