"""Calls of a runner from the wrong place or moment raise an error that says so, and change nothing."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from identical import assert_identical
from processes import have_ended

from batchpid.errors import ClosedError, InUseError
from batchpid.sim import Runner

ROOT = Path(__file__).resolve().parents[2]


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
    """Return the number of this process's descriptors of memory that it shares with workers, or with itself."""
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


def test_an_interrupted_close_raises_and_ends_the_workers(panda, on_alarm):
    def handler():
        raise KeyboardInterrupt

    runner = Runner(panda, 2, params=panda.params(), workers=1)
    os.kill(runner.pids[0], signal.SIGSTOP)  # close waits for it
    pids = runner.pids
    on_alarm(handler)
    with pytest.raises(KeyboardInterrupt):
        runner.close()
    assert have_ended(pids)


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
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")  # of JAX, which other tests may have loaded
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


@pytest.mark.slow
def test_a_stopped_worker_with_a_full_socket_does_not_block_the_caller(panda, monkeypatch):
    def small_socketpair(**options):
        ends = socketpair(**options)
        for end in () if options else ends:  # not those of the fork server
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)  # the system's minimum, about 4 kB
        return ends

    socketpair = socket.socketpair
    monkeypatch.setattr(socket, "socketpair", small_socketpair)
    near = np.tile(0.9 * panda.start + 0.1 * panda.settings.target, (64, 1))
    with Runner(panda, 64, params=panda.params(), workers=1) as runner:
        os.kill(runner.pids[0], signal.SIGSTOP)
        with pytest.warns(UserWarning, match="stuck: stopped"):
            obs = runner.reset(qpos=near)
        assert runner.recoveries == 1
    np.testing.assert_allclose(obs.qpos, near, atol=1e-6)


def run(program):
    """Return the lines that a program prints; batchpid is not installed for it, but lies in its working folder."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    paths = [path for path in sys.path if path and Path(path) != ROOT]
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        env=environment | {"PYTHONPATH": os.pathsep.join(paths)},
        cwd=ROOT,
        timeout=120,
    )
    return done.stdout.splitlines() or done.stderr


@pytest.mark.slow
def test_workers_that_cannot_be_started_leave_nothing_behind():
    program = """
import gc, os, resource, sys, warnings
warnings.simplefilter("ignore")
from batchpid.errors import WorkerError
from batchpid.sim import Robot, Runner
robot = Robot.load("panda")
executable, sys.executable = sys.executable, ""
try:
    Runner(robot, 1, workers=1)
except WorkerError as error:
    print(error)
sys.executable = executable
before = len(os.listdir("/proc/self/fd"))
for limit in (before + 5, before + 12):
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, 4096))
    try:
        Runner(robot, 64, workers=8)
    except WorkerError as error:
        print(error)
    resource.setrlimit(resource.RLIMIT_NOFILE, (4096, 4096))
    gc.collect()  # the error's traceback refers to the runner, in a cycle
    # A listing has a descriptor of its own, and the fork server's socket stays.
    assert len(os.listdir("/proc/self/fd")) <= before + 2, os.listdir("/proc/self/fd")
"""
    lines = run(program)
    assert len(lines) == 3, lines
    third, first, second = lines
    assert re.match(r"worker \d .*cannot be started: .*Too many open files.*; pass a smaller workers=", first)
    assert re.match(r"worker \d .*cannot be started: .*Too many open files; pass a smaller workers=", second)
    assert "sys.executable" in third


@pytest.mark.slow
def test_workers_start_without_standard_streams_from_another_folder_and_with_odd_entries_in_sys_path():
    program = """
import os, pathlib, sys, warnings
warnings.simplefilter("ignore")
kept = os.dup(1)
for stream in (0, 1, 2):
    os.close(stream)
from batchpid.sim import Robot, Runner
os.chdir("/")
sys.path.append(pathlib.Path("/tmp"))
robot = Robot.load("panda")
try:
    with Runner(robot, 2, params=robot.params(), workers=1) as runner:
        ok = runner.step(robot.start).ok.all()
        assert not [stream for stream in (0, 1, 2) if os.path.exists(f"/proc/self/fd/{stream}")]  # others print there
except BaseException as error:
    ok = repr(error)
os.write(kept, str(ok).encode())
"""
    assert run(program) == ["True"]
