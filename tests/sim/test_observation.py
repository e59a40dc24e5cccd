"""Parts of a rollout have the same rows as the whole."""

import dataclasses

import numpy as np
import pytest

from batchpid.sim import Fault, Rollout, Runner
from batchpid.sim.signals.rollout import Redraw


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


def with_events(rollout):
    """Return a rollout of 3 envs with a fault in each of the first two ticks, and a redraw in the
    second and third.
    """
    time, tick = rollout.time, rollout.tick
    faults = tuple([Fault(env, 2, time[env], "panda_joint1", "setpoint", "hold") for env in (0, 1)])
    redraws = (Redraw(time[1], 2, 2, 1), Redraw(time[2], 1, 1, 1))
    episodes = np.array([[0, 0], [1, 0], [2, 0]])
    info = dataclasses.replace(
        rollout.info, faults=faults, redraws=redraws, draws={}, episodes=episodes
    )
    return dataclasses.replace(rollout, info=info, feedforward=np.full(rollout.qpos.shape, tick))


def test_events_of_some_envs_have_their_new_numbers(rollout):
    rollout = with_events(rollout)
    part = rollout.for_envs([2, 1])
    assert [fault.env for fault in part.info.faults] == [1]
    assert [redraw.env for redraw in part.info.redraws] == [0, 1]
    assert part.feedforward.shape == part.qpos.shape
    assert rollout.for_envs(slice(0, 1)).info.redraws == ()
    assert [fault.env for fault in rollout.for_envs(np.array([False, True, True])).info.faults] == [
        0
    ]


def test_some_ticks_begin_where_those_before_have_ended(rollout):
    rollout = with_events(rollout)
    first, second = rollout.for_ticks(slice(0, 2)), rollout.for_ticks(slice(2, None))
    np.testing.assert_array_equal(first.info.start, rollout.info.start)
    np.testing.assert_array_equal(second.info.start, rollout.qpos[1])
    assert first.info.draws == {}
    assert second.info.draws is None
    assert second.info.episodes.tolist() == [[0, 0], [1, 0], [2, 1]]
    assert [redraw.env for redraw in second.info.redraws] == [1]
    assert rollout.for_ticks(slice(0, 1)).info.faults == rollout.info.faults[:1]
    np.testing.assert_array_equal(Rollout.join([first, second]).qpos, rollout.qpos)
