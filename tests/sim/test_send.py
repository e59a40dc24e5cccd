"""Runner.send and Runner.recv: bit-identical to step, for any call between the two."""

import os
import signal

import numpy as np
import pytest
from identical import assert_identical
from processes import have_ended
from robots import load_bundled

from batchpid.errors import CallOrderError, ClosedError, InvalidArgumentError
from batchpid.sim import RecoveryWarning, Runner

ROBOT = load_bundled("panda")
SETPOINTS = np.clip(
    ROBOT.start + np.random.default_rng(0).uniform(-0.2, 0.2, (6, 6, ROBOT.dof)),
    ROBOT.lower,
    ROBOT.upper,
)


def make(workers=1, **options):
    return Runner(ROBOT, 6, workers=workers, params=ROBOT.params(), substeps=5, **options)


def exchange(runner, setpoint, **arguments):
    runner.send(setpoint, **arguments)
    return runner.recv()


@pytest.mark.parametrize("workers", [0, 1])
def test_a_runner_that_was_closed_after_send_has_nothing_to_settle(workers):
    with make(workers) as runner:
        runner.send(SETPOINTS[0])
    runner.settle()
    with pytest.raises(ClosedError):
        runner.recv()


def test_halves_in_turns_are_bit_identical_to_the_whole():
    def policy(obs):
        return np.clip(obs.qpos + 0.1, ROBOT.lower, ROBOT.upper)

    halves = [Runner(ROBOT, 3, workers=1, params=ROBOT.params(), substeps=5) for _ in range(2)]
    for half in halves:
        half.send(policy(half.observe()))
    for _ in range(3):
        for half in halves:
            half.send(policy(half.recv()))
    ends = [half.recv() for half in halves]
    with make(0) as whole:
        for _ in range(4):
            end = whole.step(policy(whole.observe()))
    assert_identical(type(end).join(ends), end)
    for half in halves:
        half.close()


@pytest.mark.quick_rows(1)
@pytest.mark.parametrize("moment", ["before send", "during the tick", "after the tick"])
def test_a_worker_lost_around_a_sent_tick_is_replaced(moment):
    with make() as runner, make(0) as model:
        (pid,) = runner.pids
        if moment == "before send":
            os.kill(pid, signal.SIGKILL)
        if moment == "during the tick":
            os.kill(pid, signal.SIGSTOP)
        runner.send(SETPOINTS[1])
        if moment == "during the tick":
            os.kill(pid, signal.SIGKILL)
        if moment == "after the tick":
            runner.observe()
            os.kill(pid, signal.SIGKILL)
            assert_identical(runner.recv(), model.step(SETPOINTS[1]))
            runner.send(SETPOINTS[1])
        with pytest.warns(RecoveryWarning):
            observation = runner.recv()
        assert_identical(observation, model.step(SETPOINTS[1]))
        assert_identical(runner.step(SETPOINTS[3]), model.step(SETPOINTS[3]))


def test_another_call_completes_the_tick_first_and_recv_still_returns_it():
    with make() as runner, make(0) as model:
        for other in (
            lambda each: each.snapshot(),
            lambda each: setattr(each, "params", ROBOT.params(kp=33.0)),
            lambda each: each.observe(),
        ):
            runner.send(SETPOINTS[0])
            sent = model.step(SETPOINTS[0])
            other(runner)
            other(model)
            assert_identical(runner.recv(), sent)
            assert_identical(runner.observe(), model.observe())
        runner.send(SETPOINTS[0])
        assert runner.time == pytest.approx(model.time + 5 * model.timestep)


def test_a_call_that_changes_the_observation_waits_for_recv():
    with make(0) as runner, make(0) as model:
        snapshot = runner.snapshot()
        model.snapshot()
        runner.send(SETPOINTS[0])
        for name, argument in (
            ("step", SETPOINTS[1]),
            ("reset", SETPOINTS[2]),
            ("rollout", SETPOINTS[:3]),
            ("restore", snapshot),
        ):
            with pytest.raises(CallOrderError, match=rf"{name}: .*call recv\(\) first"):
                getattr(runner, name)(argument)
        assert_identical(runner.recv(), model.step(SETPOINTS[0]))
        assert_identical(runner.reset(SETPOINTS[2]), model.reset(SETPOINTS[2]))


def test_calls_out_of_order_are_named():
    runner = make()
    with pytest.raises(CallOrderError, match="send"):
        runner.recv()
    with pytest.raises(InvalidArgumentError, match="setpoint"):
        runner.send(np.nan)
    runner.send(SETPOINTS[0])
    with pytest.raises(CallOrderError, match="recv"):
        runner.send(SETPOINTS[0])
    runner.recv()
    with pytest.raises(CallOrderError, match="send"):
        runner.recv()
    runner.send(SETPOINTS[0])
    pids = runner.pids
    runner.close()
    assert have_ended(pids)
    with pytest.raises(ClosedError):
        runner.recv()


class Broken:
    """Controller that returns an effort of a wrong shape from its second sim step on."""

    def init(self, robot, num_envs):
        return np.zeros((num_envs, 1))

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return state + 1, passive if state.max() < 5 else passive[:, :2]


@pytest.mark.parametrize("workers", [0, 1])
def test_recv_raises_the_error_of_the_tick(workers):
    with make(workers, control=Broken()) as runner:
        exchange(runner, SETPOINTS[0])
        runner.send(SETPOINTS[0])
        with pytest.raises(InvalidArgumentError, match="control"):
            runner.recv()
