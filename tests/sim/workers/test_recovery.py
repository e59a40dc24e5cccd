"""A worker that dies or gets stuck is replaced, and the results are bit-identical to an undisturbed run."""

from __future__ import annotations

import contextlib
import gc
import os
import random
import signal
import threading
import warnings
from functools import partial

import numpy as np
import psutil
import pytest
from identical import assert_identical
from processes import children, have_ended, send
from robots import load_bundled

from batchpid.errors import ClosedError, WorkerError
from batchpid.sim import RecoveryWarning, Runner

ROBOT = load_bundled("panda")
N, TICKS = 8, 30
KILLS = int(os.environ.get("BATCHPID_SOAK_KILLS", "100"))


def setpoints(ticks=TICKS):
    noise = np.random.default_rng(1).uniform(-0.3, 0.3, (ticks, N, ROBOT.dof))
    return np.clip(ROBOT.settings.target + noise, ROBOT.lower, ROBOT.upper)


def make_runner(**options):
    return Runner(ROBOT, N, **({"params": ROBOT.params(), "workers": 2, "checkpoint_steps": 150} | options))


@pytest.fixture(scope="module")
def undisturbed():
    with make_runner(workers=0) as runner:
        rollout = runner.rollout(setpoints())
    assert np.abs(rollout.qpos[-1] - ROBOT.start).max() > 0.1
    return rollout


def at_ticks(acts):
    """Return a progress bar that calls each of ``acts`` before its tick."""

    def progress(ticks):
        for number in ticks:
            if number in acts:
                acts[number]()
            yield number

    return progress


@contextlib.contextmanager
def later(seconds, act):
    """Call ``act`` in a thread after ``seconds``."""
    timer = threading.Timer(seconds, act)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()


class Acts:
    """Controller that calls ``act`` in the worker whose envs have a setpoint beyond 0.5."""

    def __init__(self, act):
        self.act = act

    def init(self, robot, num_envs):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        if (setpoint[:, 0] > 0.5).any():
            self.act()
        return state, passive


def marked(env):
    """Return setpoints that let the worker of ``env`` act."""
    return np.where((np.arange(N) == env)[:, None], 1.0, 0.0) * np.ones(ROBOT.dof)


def work_for_ever():
    while True:
        pass


def sleep_for_ever():
    import threading as threads

    lock = threads.Lock()
    lock.acquire()
    lock.acquire()


def test_a_lost_worker_is_replaced(undisturbed):
    """Killed, crashed and stopped in one rollout."""
    lost = []

    def lose(number):
        lost.append(runner.pids[1])
        send(runner.pids[1], number)

    losses = {7: signal.SIGKILL, 14: signal.SIGSEGV, 21: signal.SIGSTOP}
    acts = {tick: partial(lose, number) for tick, number in losses.items()}
    with make_runner() as runner:
        other = runner.pids[0]
        with pytest.warns(RecoveryWarning) as found:
            rollout = runner.rollout(setpoints(), progress=at_ticks(acts))
        assert runner.recoveries == len(found) == 3
        for warning, pid in zip(found, lost, strict=True):
            assert f"worker 1 (pid {pid}, envs 4 to 7)" in str(warning.message)
        assert runner.pids[0] == other
        assert len({*lost, runner.pids[1]}) == 4
        assert not any(map(psutil.pid_exists, lost))
    assert_identical(undisturbed, rollout)


class WritesDots:
    """Controller that adds a byte to a file at each sim step."""

    def __init__(self, path):
        self.path = path

    def init(self, robot, num_envs):
        return np.zeros(num_envs)

    def __call__(self, state, setpoint, qpos, qvel, passive):
        with open(self.path, "ab") as file:
            file.write(b".")
        return state, passive


def test_only_the_requests_since_the_last_checkpoint_are_replayed(tmp_path):
    path = tmp_path / "steps"
    options = {"workers": 1, "control": WritesDots(path), "params": None, "substeps": 5, "checkpoint_steps": 20}
    with make_runner(**options) as runner:
        for _ in range(9):
            runner.step(ROBOT.start)  # checkpoints after 20 and 40 sim steps
        before = path.stat().st_size
        send(runner.pids[0], signal.SIGKILL)
        with pytest.warns(RecoveryWarning):
            runner.step(ROBOT.start)
    assert before >= 45
    assert 10 <= path.stat().st_size - before <= 20


def test_a_worker_that_dies_is_noticed_while_another_works():
    with (
        make_runner(recover=False, control=Acts(work_for_ever), params=None) as runner,
        later(0.5, lambda: send(runner.pids[0], signal.SIGKILL)),
    ):
        with pytest.raises(WorkerError, match=r"envs 0 to 3\) died \(SIGKILL\).*recover=True"):
            runner.step(marked(4))
        assert runner.closed
        with pytest.raises(ClosedError):
            runner.observe()


@pytest.mark.slow
def test_a_worker_that_is_stopped_during_a_tick_is_noticed():
    with make_runner(recover=False) as runner:
        send(runner.pids[1], signal.SIGSTOP)
        with pytest.raises(WorkerError, match=r"envs 4 to 7\) is stuck: stopped for"):
            runner.step(ROBOT.settings.target)


@pytest.mark.slow
def test_the_error_of_a_worker_that_is_asleep_holds_its_stack():
    with (
        make_runner(recover=False, control=Acts(sleep_for_ever), params=None) as runner,
        pytest.raises(WorkerError, match="is stuck: asleep") as info,
    ):
        runner.step(marked(4))
    assert "last stack" in str(info.value)
    assert "in sleep_for_ever" in str(info.value)


@pytest.mark.slow
def test_a_worker_that_exceeds_the_timeout_is_noticed():
    options = {"workers": 1, "recover": False, "params": None, "timeout": 0.5}
    with (
        make_runner(control=Acts(work_for_ever), **options) as runner,
        pytest.raises(WorkerError, match="no answer within"),
    ):
        runner.step(marked(0))


@pytest.mark.slow
def test_workers_are_pinned_if_there_are_as_many_as_cores():
    cores = os.sched_getaffinity(0)
    with Runner(ROBOT, 8 * len(cores) + 8, params=ROBOT.params(), workers=len(cores), recover=True) as runner:
        assert {frozenset(os.sched_getaffinity(pid)) for pid in runner.pids} == {frozenset([core]) for core in cores}
        os.kill(runner.pids[0], signal.SIGKILL)
        with pytest.warns(RecoveryWarning):
            runner.step(ROBOT.start)
        assert len(os.sched_getaffinity(runner.pids[0])) == 1
    with Runner(ROBOT, 8 * len(cores) + 8, params=ROBOT.params(), workers=len(cores) + 1) as runner:
        assert {frozenset(os.sched_getaffinity(pid)) for pid in runner.pids} == {frozenset(cores)}


@pytest.mark.slow
def test_a_worker_with_a_long_tick_does_not_count_as_stuck():
    with make_runner(workers=1, recover=False) as runner:
        obs = runner.step(ROBOT.settings.target, substeps=4_000)  # more than a second in one tick
        assert obs.ok.all()


@pytest.mark.slow
def test_workers_killed_between_ticks_and_during_their_replay_are_replaced(undisturbed):
    with make_runner() as runner:
        for pid in runner.pids:
            send(pid, signal.SIGKILL)
        first = threading.Timer(0.3, lambda: [send(pid, signal.SIGKILL) for pid in runner.pids])
        first.start()
        with pytest.warns(RecoveryWarning):
            rollout = runner.rollout(setpoints())
        first.join()
    assert_identical(undisturbed, rollout)


@pytest.mark.quick_rows(1)
@pytest.mark.usefixtures("engine")
def test_resets_params_and_snapshots_are_replayed():
    def program(runner, kill):
        runner.rollout(setpoints(8))
        runner.reset(qpos=0.9 * ROBOT.start + 0.1 * ROBOT.settings.target, mask=np.arange(N) % 3 == 1)
        runner.params = ROBOT.params(kp=30.0, derivative_filter_time=1e-3)
        runner.step(setpoints()[3], feedforward=np.ones(ROBOT.dof), substeps=7)
        kill()
        snapshot = runner.snapshot()
        runner.rollout(setpoints(4))
        kill()
        runner.restore(snapshot)
        kill()
        runner.reset(mask=np.arange(N) == 6)
        kill()
        return runner.rollout(setpoints(5), setpoint_rates=np.full(ROBOT.dof, 0.1) * np.ones((5, 1)))

    with make_runner(workers=0) as runner:
        expected = program(runner, lambda: None)
    with make_runner() as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore", RecoveryWarning)
        assert_identical(expected, program(runner, lambda: send(runner.pids[1], signal.SIGKILL)))
        assert runner.recoveries == 4


def test_a_request_that_kills_every_worker_is_given_up(monkeypatch, tmp_path):
    monkeypatch.setattr("batchpid.sim.workers.pool.MAX_LOSSES", 2)

    def crash():
        (tmp_path / str(os.getpid())).touch()
        os.kill(os.getpid(), signal.SIGSEGV)

    with (
        make_runner(workers=1, control=Acts(crash), params=None) as runner,
        pytest.raises(WorkerError, match=r"(?s)SIGSEGV.*lost 2 times.*workers=0"),
    ):
        runner.step(marked(0))
    assert len(os.listdir(tmp_path)) == 2


def test_a_replay_does_not_see_later_writes_to_the_callers_arrays():
    target = ROBOT.settings.target
    start = np.tile(0.9 * ROBOT.start + 0.1 * target, (N, 1))
    given = {"qpos": start.copy(), "mask": np.arange(N) < 2}
    with make_runner(workers=1) as runner, make_runner(workers=0) as other:
        runner.reset(**given)
        other.reset(start, mask=np.arange(N) < 2)
        setpoint = np.tile(target, (N, 1))
        assert_identical(runner.step(setpoint), other.step(target))
        given["qpos"][...] = setpoint[...] = ROBOT.start
        given["mask"][...] = ~given["mask"]
        send(runner.pids[0], signal.SIGKILL)
        with pytest.warns(RecoveryWarning):
            again = runner.step(target)
        assert_identical(again, other.step(target))


@pytest.mark.slow
def test_kills_at_random_moments_of_many_rollouts(undisturbed):
    chance = random.Random(0)
    me, others = psutil.Process(), children()
    recovered, descriptors = 0, None
    for round_ in range(KILLS):
        with make_runner() as runner, warnings.catch_warnings():
            warnings.simplefilter("ignore", RecoveryWarning)
            pids = runner.pids
            with later(chance.uniform(0, 0.2), lambda pids=pids: send(chance.choice(pids), signal.SIGKILL)):
                rollout = runner.rollout(setpoints())
            recovered += runner.recoveries
            pids += runner.pids
        assert_identical(undisturbed, rollout)
        assert have_ended(pids)
        if round_ == 4:
            gc.collect()
            descriptors = me.num_fds()
    gc.collect()  # an mmap keeps its descriptor until the arrays on it are collected
    assert me.num_fds() <= descriptors + 2
    assert recovered > KILLS // 3  # most kills fell into the rollout
    assert children() <= others
