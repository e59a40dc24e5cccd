"""Parts of a rollout have the same rows as the whole."""

import numpy as np
import pytest
from identical import assert_identical

from batchpid.sim import Rollout, Runner


@pytest.fixture(scope="module")
def rollout(panda):
    params = panda.params(kp=np.linspace(30.0, 50.0, 3)[:, None])
    with Runner(panda, 3, workers=0, params=params, substeps=2) as runner:
        return runner.rollout(np.tile(panda.settings.target, (6, 1)))


def test_some_envs_keep_their_rows_and_their_params(rollout):
    part = rollout.for_envs([2, 0])
    assert part.num_envs == 2
    np.testing.assert_array_equal(part.qpos, rollout.qpos[:, [2, 0]])
    np.testing.assert_array_equal(part.info.start, rollout.info.start[[2, 0]])
    np.testing.assert_array_equal(part.info.params.kp[:, 0], [50.0, 30.0])


def test_successive_parts_join_to_the_whole(rollout):
    parts = [rollout.for_ticks(slice(0, 2)), rollout.for_ticks(slice(2, None))]
    whole = Rollout.join(parts)
    assert_identical(whole, rollout)
    assert (whole.tick, whole.info.robot) == (rollout.tick, "panda")


def test_the_tick_does_not_depend_on_the_time_of_the_start(panda):
    with Runner(panda, 1, workers=0, substeps=3) as runner:
        first = runner.rollout(np.tile(panda.start, (2, 1)))
        runner.rollout(np.tile(panda.start, (50, 1)))
        later = runner.rollout(np.tile(panda.start, (2, 1)))
    assert first.tick == later.tick == 3 / 2000
    assert later.for_ticks(slice(None, None, 2)).tick == 2 * later.tick


def test_representations_are_one_line(rollout):
    for each in (rollout, rollout.info, rollout.for_ticks(slice(0, 0))):
        assert "\n" not in repr(each)
        assert len(repr(each)) < 100


def test_unknown_fields_are_named(rollout):
    with pytest.raises(AttributeError, match="'speed'; it has time, setpoint, tick, info, qpos"):
        _ = rollout.speed
