"""Playback of recorded runs."""

import numpy as np
import pytest

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Runner
from batchpid.sim.view import Playback


@pytest.fixture(scope="module")
def rollout(panda):
    with Runner(panda, 2, params=panda.params(), workers=0) as runner:
        return runner.rollout(np.broadcast_to(panda.target, (30, panda.dof)))


def test_a_rollout_plays_from_the_first_row_to_the_last_and_starts_over(panda, rollout):
    playback = Playback(rollout)
    assert playback.robot.name == panda.name
    frames = [playback.observation]
    while playback.time < playback.duration - 1e-9:
        playback.advance()
        frames.append(playback.observation)
    np.testing.assert_array_equal(frames[0].qpos, rollout.qpos[0])
    np.testing.assert_array_equal(frames[-1].qpos, rollout.qpos[-1])
    assert len(frames) == pytest.approx(playback.duration / playback.period, abs=2)
    playback.advance()
    assert playback.time == 0.0


def test_a_rollout_of_another_robot_is_refused(jaco2, rollout):
    with pytest.raises(InvalidArgumentError, match="joints"):
        Playback(rollout, jaco2)
