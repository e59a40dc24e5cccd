"""The pool, with workers that answer, fail or die as a test says: no process and no physics."""

from __future__ import annotations

import gc
import os
import select
from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import pytest
from robots import load_bundled

from batchpid.errors import ClosedError
from batchpid.sim import RecoveryWarning, RunnerOptions
from batchpid.sim.loop.failure import Failure
from batchpid.sim.workers.pool import WorkerPool
from batchpid.sim.workers.requests import ReadPoses, Run, SetParams, Start
from batchpid.sim.workers.worker import Worker, WorkerLost

ROBOT = load_bundled("panda")
PARAMS = ROBOT.params()
N = 8


def run(ticks=1):
    return Run(ticks, 20)


def dies():
    raise WorkerLost("worker 0 died")


def interrupt():
    raise KeyboardInterrupt


class Stage:
    """Calls of the workers (name, worker, ...), and acts for the next calls of a name by worker 0 of the pool."""

    def __init__(self):
        self.calls, self.acts, self.made = [], defaultdict(list), []

    def next(self, name, *acts):
        self.acts[name] += acts

    def call(self, name, worker, *details):
        self.calls.append((name, worker, *details))
        return self.acts[name].pop(0)() if worker.index == 0 and self.acts[name] else None

    def of(self, name, index=0):
        """Return the details of the calls ``name`` of the workers with the number ``index``."""
        return [
            call[2] if len(call) == 3 else call[2:] for call in self.calls if call[0] == name and call[1].index == index
        ]


@pytest.fixture
def stage(monkeypatch):
    stage = Stage()

    class Scripted(Worker):
        def __init__(self, start, shared):
            self.start, self.shared, self.index, self.ends = start, shared, start.index, os.pipe()
            stage.made.append(self)

        def open(self):
            stage.call("open", self)
            self._answer()

        def send(self, request):
            stage.call("send", self, request)
            self._answer()

        def _answer(self):
            if stage.call("answer", self) is None:
                os.write(self.ends[1], b".")

        def receive(self):
            result = stage.call("receive", self)
            os.read(self.ends[0], 1)
            return result or self.index

        def close(self, patience):
            stage.call("close", self, patience)

        def successor(self):
            return type(self)(self.start, self.shared)

        def fileno(self):
            return self.ends[0]

        def check_alive(self, idle_limit, limit):
            stage.call("check", self, idle_limit, limit)

        def pin(self, core):
            stage.call("pin", self, core)

    monkeypatch.setattr("batchpid.sim.workers.pool.ProcessWorker", Scripted)
    yield stage
    for worker in stage.made:
        for end in worker.ends:
            os.close(end)


def make_pool(workers=2, **options):
    pool = WorkerPool(RunnerOptions(ROBOT, N, workers=workers, **options), PARAMS)
    pool.open()
    return pool


def test_begin_sends_at_once_and_finish_collects(stage):
    pool, request = make_pool(), run()
    pool.begin(request)
    assert [stage.of("send", index) for index in (0, 1)] == [[request]] * 2
    assert len(stage.of("receive")) == 1  # of the start
    assert pool.finish().results == [0, 1]
    assert [stage.of("send", index) for index in (0, 1)] == [[request]] * 2


def test_the_last_tick_of_a_request_holds_the_present_observation(stage):
    pool = make_pool()
    pool.arrays.observation.qpos[:] = np.arange(len(pool.ticks))[:, None, None]
    for ticks in (3, 1, 2):
        outcome = pool.run(run(ticks))
        assert len(outcome.completed) == ticks
        assert outcome.present is pool.present
        assert pool.present.observation.qpos[0, 0] == ticks - 1
    pool.run(ReadPoses())  # observes nothing
    assert pool.present.observation.qpos[0, 0] == 1


def test_of_two_failures_the_earlier_counts_with_the_ticks_before_it(stage):
    pool, failure = make_pool(), Failure(40, 0, 2, ValueError("late"))
    stage.next("receive", lambda: failure)
    outcome = pool.run(run(3))
    assert outcome.results == [None, 1]
    assert outcome.failure is failure
    assert len(outcome.completed) == 2
    stage.next("receive", lambda: failure)
    assert pool.run(SetParams(PARAMS)).completed == []  # of which no tick counts
    assert pool.run(run()).failure is None


def test_a_failure_at_the_start_is_raised(stage):
    stage.next("receive", lambda: Failure(0, 0, 0, ValueError("no such mesh")))
    with pytest.raises(ValueError, match="no such mesh"):
        make_pool()


def test_a_lost_worker_is_given_what_the_others_have_done(stage):
    pool, first, reading, second = make_pool(), run(), ReadPoses(), run(2)
    for request in (first, reading):
        pool.run(request)
    stage.next("receive", dies)
    assert pool.run(second).results == [0, 1]
    # Reading is not repeated.
    assert stage.of("send") == [first, reading, second, first, second]
    assert stage.of("send", 1) == [first, reading, second]
    assert pool.recoveries == 1
    assert "worker 0 died; replaced and replayed in 0." in pool.messages[RecoveryWarning]
    assert stage.of("close") == [0.0]
    pool.start_replay_from(third := SetParams(PARAMS))
    stage.next("send", dies)
    pool.run(fourth := run())
    again = stage.of("send")[-2:]
    assert isinstance(again[0], SetParams)
    assert again[0] is not third  # which the caller may change
    assert again[1] is fourth


def test_a_worker_that_is_lost_again_and_again_is_given_up(stage):
    pool = make_pool()
    for times in (4, 4):  # fewer losses in each of two requests
        stage.next("send", *[dies] * times)
        pool.run(ReadPoses())
    assert pool.recoveries == 2
    stage.next("send", *[dies] * 5)
    with pytest.raises(WorkerLost, match="lost 5 times"):
        pool.run(ReadPoses())
    assert len(stage.made) == 2 + 4 + 4 + 4


def test_without_recovery_a_loss_is_an_error(stage):
    pool = make_pool(recover=False)
    stage.next("receive", dies)
    with pytest.raises(WorkerLost, match=r"died.*recover=True"):
        pool.run(run())


def test_a_silent_worker_is_checked_by_the_limits_of_its_request(stage):
    pool, request = make_pool(timeout=5.0), Run(1, 20_000)
    stage.next("answer", *[lambda: "none"] * 2)  # neither to the request, nor when its replacement starts
    stage.next("check", lambda: None, dies, dies)
    pool.run(request)
    start = Start(0, slice(0, 4), RunnerOptions(ROBOT, N), PARAMS)
    assert stage.of("check") == [(each.idle_limit, 5.0 + each.limit(N // 2)) for each in (request, request, start)]
    assert pool.recoveries == 1


def test_workers_are_pinned_and_so_are_their_successors(stage, monkeypatch):
    monkeypatch.setattr(
        "batchpid.sim.workers.pool.pinned_cores", lambda workers: [10 + core for core in range(workers)]
    )
    pool = make_pool()
    stage.next("send", dies)
    pool.run(run())
    assert (stage.of("pin"), stage.of("pin", 1)) == ([10, 10], [11])


def test_an_exception_of_a_signal_handler_is_raised(stage):
    pool = make_pool()
    stage.next("receive", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        pool.run(run())


def test_idle_workers_are_waited_for_and_busy_ones_are_not(stage):
    pool, request = make_pool(), run()
    stage.next("receive", interrupt)
    with pytest.raises(KeyboardInterrupt):
        pool.run(request)
    pool.close()
    assert stage.of("close") == stage.of("close", 1) == [0.0]
    pool = make_pool()
    pool.close()
    assert stage.of("close")[1:] == [5.0]
    for call in (pool.begin, pool.run):
        with pytest.raises(ClosedError):
            call(run())
    pool.close()
    assert len(stage.of("close")) == 2


def test_an_interrupt_while_workers_end_is_raised_when_they_have(stage):
    pool = make_pool()
    stage.next("close", interrupt)
    with pytest.raises(KeyboardInterrupt):
        pool.close()
    assert (stage.of("close"), stage.of("close", 1)) == ([5.0, 0.0], [0.0])


def test_the_shared_memory_ends_with_the_pool(stage):
    pool = make_pool()
    shared = stage.made[0].shared
    pool.close()
    with pytest.raises(OSError, match="Bad file"):
        os.fstat(shared.fd)


def test_a_pool_that_is_forgotten_ends_its_workers(stage):
    make_pool()
    gc.collect()
    assert [stage.of("close", index) for index in (0, 1)] == [[5.0]] * 2


@pytest.mark.parametrize("error", [None, OSError, WorkerLost])
def test_a_call_during_which_another_thread_closes_the_pool_ends(stage, error):
    pool = make_pool()

    def close():
        pool.close()
        if error is not None:
            raise error("the socket was closed")

    stage.next("receive", close)
    with pytest.raises(ClosedError) as info:
        pool.run(run())
    assert type(info.value.__cause__) is (type(None) if error is None else error)


@pytest.mark.parametrize(("substeps", "ticks"), [(20, 100), (3000, 1)])
def test_a_request_has_so_many_ticks_that_it_lasts_a_fifth_of_a_second(stage, substeps, ticks):
    assert len(make_pool(substeps=substeps).ticks) == ticks


@pytest.fixture
def waits(monkeypatch):
    """Return the waits for answers, in ms; a clock goes on by 0.03 s in each, by the whole wait if none comes."""
    found, now, poll = [], [0.0], select.poll

    class Poll:
        def __init__(self):
            self.poller = poll()

        def register(self, *arguments):
            self.poller.register(*arguments)

        def poll(self, wait):
            found.append(round(wait))
            answers = self.poller.poll(0)
            now[0] += 0.03 if answers else 1.01e-3 * wait
            return answers

    monkeypatch.setattr("batchpid.sim.workers.pool.select", SimpleNamespace(poll=Poll, POLLIN=select.POLLIN))
    monkeypatch.setattr("batchpid.sim.workers.pool.time", SimpleNamespace(monotonic=lambda: now[0]))
    return found


def test_a_tick_waits_for_its_workers_one_after_another(stage, waits):
    pool = make_pool()
    waits.clear()
    pool.run(run())
    assert waits == [100, 70, 0]
    assert stage.of("check") == []


def test_a_silent_worker_is_waited_for_a_tenth_of_a_second_between_checks(stage, waits):
    pool = make_pool()
    waits.clear()
    stage.next("answer", lambda: "none")
    stage.next("check", lambda: None, lambda: os.write(stage.made[0].ends[1], b".") and None)
    pool.run(run())
    assert waits == [100, 0, 100, 0, 100, 0]
    assert len(stage.of("check")) == 2


def test_a_worker_that_catches_up_gets_its_next_request_at_once(stage, waits):
    pool = make_pool()
    waits.clear()
    stage.next("receive", dies)
    pool.run(run())
    assert waits == [100, 70, 0, 100, 100, 0]
