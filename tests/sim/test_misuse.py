"""Calls of a runner in another order, or from another place or moment, complete the tick or raise an
error that says so, and change nothing.
"""

import os
import signal
import threading

import numpy as np
import pytest
from identical import assert_identical
from option_values import ARM
from processes import handler, have_ended

from batchpid.errors import ClosedError, InUseError
from batchpid.sim import Runner

N, LONG = 4, 100_000
PARAMS = ARM.params(kp=20.0, ki=1.0, kd=2.0)
TABLE = np.random.default_rng(0).uniform(-0.2, 0.2, (4, N, ARM.dof))


def make(workers=0):
    return Runner(ARM, N, params=PARAMS, workers=workers, substeps=5)


@pytest.fixture(params=[0, 1])
def runner(request):
    with make(request.param) as made:
        yield made


# -- threads, signal handlers, children


def test_a_call_from_another_thread_raises(runner):
    done = threading.Event()

    def work():
        while not done.is_set():
            runner.step(TABLE[0], substeps=200)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        with pytest.raises(InUseError, match="in use: by another thread"):  # noqa: PT012
            while True:
                runner.observe()
    finally:
        done.set()
        thread.join()
    assert runner.step(TABLE[0]).ok.all(), "they may take turns"


def test_a_call_from_a_signal_handler_raises(runner):
    raised = []

    def call(*_):
        for _ in range(2):  # the first error does not end the call that is in progress
            try:
                runner.step(TABLE[0])
            except InUseError as error:
                raised.append("that this one interrupted" in str(error))
        if not raised:  # it came between two steps: once more
            signal.setitimer(signal.ITIMER_REAL, 0.2)

    with handler(signal.SIGALRM, call):
        # Long steps: the signal comes during one of them.
        while not raised:
            seen = runner.step(TABLE[0], substeps=LONG)
    assert seen.ok.all()
    assert raised == [True, True]


def test_a_signal_handler_may_close_the_runner(runner):
    with handler(signal.SIGALRM, lambda *_: runner.close()), pytest.raises(ClosedError):  # noqa: PT012
        while True:
            runner.step(TABLE[0], substeps=500)
    with pytest.raises(ClosedError):
        runner.observe()


def test_another_thread_may_close_the_runner():
    with make(1) as runner:
        pids = runner.pids
        timer = threading.Timer(0.2, runner.close)
        timer.start()
        with pytest.raises(ClosedError):  # noqa: PT012
            while True:
                runner.step(TABLE[0], substeps=LONG)
        timer.join()
    assert have_ended(pids)


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")  # of JAX, if other tests loaded it
def test_a_call_from_a_forked_child_raises(runner):
    before = runner.step(TABLE[0])
    read, write = os.pipe()
    if (child := os.fork()) == 0:
        try:
            runner.step(TABLE[0])
        except BaseException as error:
            os.write(write, f"{type(error).__name__}: {error}".encode())
        os._exit(0)
    os.waitpid(child, 0)
    os.close(write)
    with os.fdopen(read) as message:
        assert message.read().startswith("InUseError: this Runner is in use")
    assert_identical(runner.observe(), before)
    assert runner.step(TABLE[0]).ok.all()
