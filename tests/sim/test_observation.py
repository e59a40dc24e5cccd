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
    assert later.for_ticks(slice(None, None, 2)).tick == 2 * later.tick
    for each in (later, later.info, later.for_ticks(slice(0, 0))):
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


def test_some_ticks_begin_where_those_before_have_ended(rollout):
    rollout = with_events(rollout)
    first, second = rollout.for_ticks(slice(0, 2)), rollout.for_ticks(slice(2, None))
    np.testing.assert_array_equal(first.info.start, rollout.info.start)
    # An env was reset in between: where it starts, and its draws, are unknown.
    assert first.info.draws == rollout.info.draws
    assert (second.info.start, second.info.draws, second.info.episodes) == (None, None, None)
    np.testing.assert_array_equal(rollout.for_ticks(slice(4, 6)).changes, np.zeros((2, 3)))
    # Of ticks that are left out, the changes stay.
    assert rollout.for_ticks(slice(0, None, 2)).changes[1].tolist() == [0, RESET, RESET]
    assert rollout.for_ticks(slice(0, 1)).info.faults == rollout.info.faults[:1]
    joined = Rollout.join([first, second])
    for name, rows in joined.arrays().items():
        np.testing.assert_array_equal(rows, rollout.arrays()[name], name)


def test_some_ticks_start_at_the_positions_before_them(rollout):
    np.testing.assert_array_equal(rollout.for_ticks(slice(2, None)).info.start, rollout.qpos[1])


def successive(robot, change, *, first=None, second=None):
    """Return two successive rollouts with further inputs, and a ``change`` of the runner in
    between.
    """
    setpoints = np.tile(robot.start, (3, 1))
    with Runner(robot, 2, workers=0, params=robot.params(), substeps=2) as runner:
        part = runner.rollout(setpoints, **(first or {}))
        change(runner)
        return [part, runner.rollout(setpoints, **(second or {}))]


def test_joined_rollouts_say_what_was_changed_in_between(panda):
    def change(runner):
        runner.params = panda.params(kp=5.0)
        runner.reset(mask=[True, False])

    given = {"feedforwards": np.ones((3, panda.dof)), "setpoint_rates": np.zeros((3, panda.dof))}
    parts = successive(panda, change, second=given)
    joined = Rollout.join(parts)
    assert joined.changes[1:].tolist() == [[0, 0]] * 2 + [[RESET | PARAMS, PARAMS]] + [[0, 0]] * 2
    assert joined.info.rates
    np.testing.assert_array_equal(joined.feedforward[:, 0, 0], [0, 0, 0, 1, 1, 1])
    first = Rollout.join(successive(panda, lambda runner: None, first=given))
    np.testing.assert_array_equal(first.feedforward[:, 0, 0], [1, 1, 1, 0, 0, 0])


def test_rollouts_of_other_runs_are_not_joined(panda):
    parts = successive(panda, lambda runner: runner.step(panda.start))
    with pytest.raises(InvalidArgumentError, match=r"part 1 does not go on .* time; join all"):
        Rollout.join(parts)
    one, other = (successive(panda, lambda runner: None) for _ in range(2))
    info = dataclasses.replace(other[1].info, params=panda.params(kp=5.0), engine="sapien")
    with pytest.raises(InvalidArgumentError, match="the one before it: engine, params"):
        Rollout.join([one[0], dataclasses.replace(other[1], info=info)])
    assert len(Rollout.join([one[0], other[1]]).time) == 6
