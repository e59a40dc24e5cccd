"""Requests: parts for some envs, messages to a worker process, and copies for a replay."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
from identical import assert_identical

from batchpid.sim import RecoveryWarning, Runner
from batchpid.sim.loop.arrays import Arrays, Command
from batchpid.sim.workers.requests import ReadPoses, Reset, Run, SetParams, decode

N, DOF = 4, 9
ENVS = slice(1, 3)


def command(ticks=3):
    return Command(np.arange(float(ticks * N * DOF)).reshape(ticks, N, DOF))


def test_the_part_of_a_reset_has_the_rows_of_its_envs():
    rows = np.arange(float(N * DOF)).reshape(N, DOF)
    part = Reset(np.array([True, False, True, False]), rows, -rows).for_envs(ENVS)
    assert part.mask.tolist() == [False, True]
    np.testing.assert_array_equal(part.qpos, rows[1:3])
    np.testing.assert_array_equal(part.qvel, -rows[1:3])


def test_a_run_writes_the_commands_of_some_envs_and_no_others():
    layout = Arrays.layout(4, N, DOF)
    arrays = Arrays.from_fields({name: np.full(shape, 7, dtype) for name, (shape, dtype) in layout.items()})
    run = Run(3, 20, command(ticks=3))
    run.write(arrays, ENVS)
    expected = np.full((4, N, DOF), 7.0)
    expected[:3, ENVS] = command().setpoint[:, ENVS]
    np.testing.assert_array_equal(arrays.command.setpoint, expected)
    assert (arrays.command.setpoint_rate == 7).all()
    assert (run.ticks, run.substeps) == (3, 20)


def test_the_part_of_params_has_the_rows_of_its_envs(panda):
    params = panda.params(kp=np.arange(1.0, N + 1)[:, None])
    assert SetParams(params).for_envs(ENVS).params.kp[:, 0].tolist() == [2.0, 3.0]
    assert SetParams(panda.params()).for_envs(ENVS).params.num_envs == 1


@pytest.mark.parametrize("rate", [None, command().setpoint])
def test_the_message_of_a_run_is_short_and_holds_all_but_the_commands(rate):
    given = command()._replace(setpoint_rate=rate)
    request = Run(3, 7, given)
    message = request.encode(ENVS)
    assert len(message) < 20
    received = decode(message)
    assert (received.ticks, received.substeps, received.given) == (3, 7, given.given)


def test_other_messages_hold_the_whole_request():
    request = Reset(np.ones(N, bool), np.zeros((N, DOF)), np.ones((N, DOF)))
    received = decode(request.encode(slice(None)))
    np.testing.assert_array_equal(received.qvel, request.qvel)
    assert decode(ReadPoses().encode(ENVS)) == ReadPoses()


def test_requests_that_only_read_are_not_replayed():
    assert not ReadPoses.changes_loop
    assert Reset.changes_loop


def test_a_replay_does_not_see_later_writes_to_the_callers_arrays(panda):
    target = panda.settings.target
    given = {"qpos": np.tile(0.9 * panda.start + 0.1 * target, (N, 1)), "mask": np.arange(N) < 2}
    with Runner(panda, N, params=panda.params(), workers=1) as runner:
        runner.reset(**given)
        setpoint = np.tile(target, (N, 1))
        expected = runner.step(setpoint)
        given["qpos"][...] = setpoint[...] = panda.start
        given["mask"][...] = ~given["mask"]
        os.kill(runner.pids[0], signal.SIGKILL)
        with pytest.warns(RecoveryWarning):
            again = runner.step(target)
    with Runner(panda, N, params=panda.params(), workers=0) as other:
        other.reset(np.tile(0.9 * panda.start + 0.1 * target, (N, 1)), mask=np.arange(N) < 2)
        assert_identical(expected, other.step(target))
        assert_identical(again, other.step(target))
