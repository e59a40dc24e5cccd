"""Calls of a runner from the wrong place or moment raise an error that says so, and change
nothing.
"""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import pytest
from identical import assert_identical

from batchpid.errors import ClosedError, InUseError
from batchpid.sim import Runner


@pytest.fixture(params=[0, 1])
def runner(request, panda):
    with Runner(panda, 8, params=panda.params(), workers=request.param) as made:
        yield made


@pytest.fixture
def on_alarm():
    """Function that makes another one the handler of a signal that arrives 0.1 s later."""

    def on_alarm(act):
        signal.signal(signal.SIGALRM, lambda *_: act())
        signal.setitimer(signal.ITIMER_REAL, 0.1)

    before = signal.getsignal(signal.SIGALRM)
    yield on_alarm
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


def memory_files():
    """Return the number of this process's descriptors of memory that it shares with workers, or
    with itself.
    """
    links = (os.readlink(path) for path in Path("/proc/self/fd").iterdir() if path.is_symlink())
    return sum(link.startswith("/memfd:batchpid") for link in links)


def test_a_closed_runner_gives_its_memory_back(runner):
    before = memory_files()
    runner.close()
    assert memory_files() < before


def test_a_call_from_another_thread_raises(runner, panda):
    done = threading.Event()

    def work():
        while not done.is_set():
            runner.step(panda.start, substeps=200)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        with pytest.raises(InUseError, match="another thread; take turns"):  # noqa: PT012
            while True:
                runner.observe()
    finally:
        done.set()
        thread.join()
    assert runner.step(panda.start).ok.all()


@pytest.mark.quick_rows(1)
def test_threads_may_take_turns(runner, panda):
    steps = []
    lock = threading.Lock()

    def work():
        for _ in range(5):
            with lock:
                steps.append(runner.step(panda.settings.target))

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with Runner(panda, 8, params=panda.params(), workers=0) as other:
        for step in steps:
            assert_identical(other.step(panda.settings.target), step)


@pytest.mark.quick_rows(1)
def test_a_call_from_a_signal_handler_raises(runner, panda, on_alarm):
    raised = []

    def handler():
        for _ in range(2):  # the first error does not end the call that is in progress
            with pytest.raises(InUseError, match="that this one interrupted"):
                runner.step(panda.start)
        raised.append(True)

    on_alarm(handler)
    while not raised:
        obs = runner.step(panda.start, substeps=500)
    assert obs.ok.all()


def test_a_signal_handler_may_close_the_runner(runner, panda, on_alarm):
    before = memory_files()
    on_alarm(runner.close)
    with pytest.raises(ClosedError):  # noqa: PT012
        while True:
            runner.step(panda.start, substeps=500)
    assert memory_files() < before
    with pytest.raises(ClosedError):
        runner.observe()


def test_another_thread_may_close_the_runner(panda):
    with Runner(panda, 8, params=panda.params(), workers=1) as runner:
        pids = runner.pids
        timer = threading.Timer(0.2, runner.close)
        timer.start()
        with pytest.raises(ClosedError, match="during a call"):
            runner.step(panda.start, substeps=100_000)
        timer.join()
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
@pytest.mark.filterwarnings(
    "ignore:os.fork:RuntimeWarning"
)  # of JAX, which other tests may have loaded
def test_a_call_from_a_forked_child_raises(runner, panda):
    before = runner.step(panda.settings.target)
    read, write = os.pipe()
    if (child := os.fork()) == 0:
        try:
            runner.step(panda.start)
        except BaseException as error:
            os.write(write, f"{type(error).__name__}: {error}".encode())
        os._exit(0)
    os.waitpid(child, 0)
    os.close(write)
    with os.fdopen(read) as message:
        assert message.read().startswith("InUseError: this Runner belongs to process")
    assert_identical(runner.observe(), before)
    assert runner.step(panda.start).ok.all()
