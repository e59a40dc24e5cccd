"""Parts of a rollout have the same rows as the whole."""

import dataclasses

import numpy as np
import pytest

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Fault, Rollout, Runner
from batchpid.sim.rollout import PARAMS, RESET


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
        first = runner.rollout(np.tile(panda.start, (20, 1)))
        later = runner.rollout(np.tile(panda.start, (2, 1)))
    assert first.tick == later.tick == 3 / 2000
    for each in (later, later.info, later.for_ticks(0, 0)):
        assert len(repr(each).splitlines()) == 1
        assert len(repr(each)) < 100


def test_unknown_fields_are_named(rollout):
    with pytest.raises(AttributeError, match="'speed'; it has time, setpoint, tick, info, qpos"):
        _ = rollout.speed


def with_events(rollout):
    """Return a rollout of 3 envs with a fault in each of the first two ticks, and a reset before
    the second and the third.
    """
    time, tick = rollout.time, rollout.tick
    faults = tuple([Fault(env, 2, time[env], "panda_joint1", "setpoint", "hold") for env in (0, 1)])
    episodes = np.array([[0, 0], [1, 0], [2, 0]])
    info = dataclasses.replace(
        rollout.info, faults=faults, draws={"payload": episodes[:, :1]}, episodes=episodes
    )
    changes = np.zeros(rollout.ok.shape, np.uint8)
    changes[1, 2] = changes[2, 1] = RESET
    feedforward = np.full(rollout.qpos.shape, tick)
    return dataclasses.replace(rollout, info=info, feedforward=feedforward, changes=changes)


def test_events_of_some_envs_have_their_new_numbers(rollout):
    rollout = with_events(rollout)
    part = rollout.for_envs([2, 1])
    assert [fault.env for fault in part.info.faults] == [1]
    assert part.info.episodes.tolist() == [[2, 0], [1, 0]]
    assert part.info.draws["payload"].tolist() == [[2], [1]]
    assert part.changes.tolist()[1:3] == [[RESET, 0], [0, RESET]]
    assert part.feedforward.shape == part.qpos.shape
    assert [fault.env for fault in rollout.for_envs(np.array([False, True, True])).info.faults] == [
        0
    ]


@pytest.mark.parametrize(
    ("first", "start", "draws"), [(0, True, True), (1, False, False), (3, True, False)]
)
def test_some_ticks_begin_where_those_before_have_ended(rollout, first, start, draws):
    """Unless an env was reset there; its draws are unknown from then on."""
    rollout = with_events(rollout)
    part = rollout.for_ticks(first)
    before = rollout.qpos[first - 1] if first else rollout.info.start
    np.testing.assert_array_equal(part.info.start, before if start else None)
    assert (part.info.draws == rollout.info.draws) == draws
    np.testing.assert_array_equal(part.changes, rollout.changes[first:])
    assert rollout.for_ticks(0, 1).info.faults == rollout.info.faults[:1]


def test_joined_rollouts_say_what_was_changed_in_between(panda):
    setpoints = np.tile(panda.start, (3, 1))
    with Runner(panda, 2, workers=0, substeps=2) as runner:
        first = runner.rollout(setpoints, setpoint_rates=0 * setpoints)
        runner.params = panda.params(kp=5.0)
        runner.reset(mask=[True, False])
        second = runner.rollout(setpoints, feedforwards=np.ones_like(setpoints))
    joined = Rollout.join([first, second])
    for name, rows in second.arrays().items():
        np.testing.assert_array_equal(joined.arrays()[name][3:], rows, name)
    assert joined.changes[1:4].tolist() == [[0, 0]] * 2 + [[RESET | PARAMS, PARAMS]]
    assert not joined.feedforward[:3].any()
    assert joined.info.rates
    assert joined.info.params is first.info.params
    for parts in ([second, first], [first, second.for_envs([0])]):
        with pytest.raises(InvalidArgumentError, match="do not follow each other; join"):
            Rollout.join(parts)
