"""A runner that is used from where it cannot be says so, and stays as sound as it was."""

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

from batchpid.errors import ClosedError, InUseError
from sim import Robot, Runner

ROBOT = Robot.load("panda")
ROOT = Path(__file__).resolve().parents[2]
LONG = 100_000  # substeps that nobody waits for
NEAR = 0.9 * ROBOT.start + 0.1 * ROBOT.settings.target


@pytest.fixture(params=[0, 1])
def runner(request):
    with Runner(ROBOT, 8, workers=request.param) as made:
        yield made


@pytest.fixture
def on_alarm():
    """Let a function run, as a signal handler, so many seconds from now."""

    def on_alarm(act, seconds=0.1):
        signal.signal(signal.SIGALRM, lambda *_: act())
        signal.setitimer(signal.ITIMER_REAL, seconds)

    before = signal.getsignal(signal.SIGALRM)
    yield on_alarm
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


def busy(runner, until):
    """A thread that steps the runner until then."""

    def work():
        while not until.is_set():
            runner.step(ROBOT.start, substeps=200)

    thread = threading.Thread(target=work)
    thread.start()
    return thread


def test_two_threads_at_once(runner):
    done = threading.Event()
    thread = busy(runner, done)
    try:
        with pytest.raises(InUseError, match="another thread; take turns"):  # noqa: PT012
            while True:
                runner.observe()
    finally:
        done.set()
        thread.join()
    assert runner.step(ROBOT.start).ok.all()


def test_in_turn_threads_may_share_it(runner):
    expected = []
    lock = threading.Lock()

    def work():
        for _ in range(5):
            with lock:
                expected.append(runner.step(ROBOT.settings.target).qpos)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with Runner(ROBOT, 8, workers=0) as alone:
        for qpos in expected:
            np.testing.assert_array_equal(alone.step(ROBOT.settings.target).qpos, qpos)


def test_from_a_signal_handler(runner, on_alarm):
    seen = []

    def handler():
        with pytest.raises(InUseError, match="that this one interrupted"):
            runner.step(ROBOT.start)
        seen.append(True)

    on_alarm(handler)
    while not seen:
        obs = runner.step(ROBOT.start, substeps=500)
    assert obs.ok.all()


def test_closed_by_a_signal_handler(runner, on_alarm):
    on_alarm(runner.close)
    with pytest.raises(ClosedError):  # noqa: PT012
        while True:
            runner.step(ROBOT.start, substeps=500)
    with pytest.raises(ClosedError):
        runner.observe()


def test_closed_by_another_thread():
    with Runner(ROBOT, 8, workers=1) as runner:
        pids = runner.pids
        timer = threading.Timer(0.2, runner.close)
        timer.start()
        with pytest.raises(ClosedError, match="amid a call"):
            runner.step(ROBOT.start, substeps=LONG)
        timer.join()
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")  # of JAX, which other tests may have loaded
def test_in_a_forked_child(runner):
    before = runner.step(ROBOT.settings.target)
    read, write = os.pipe()
    if (child := os.fork()) == 0:
        try:
            runner.step(ROBOT.start)
        except BaseException as error:
            os.write(write, f"{type(error).__name__}: {error}".encode())
        os._exit(0)
    os.waitpid(child, 0)
    os.close(write)
    with os.fdopen(read) as said:
        assert said.read().startswith("InUseError: this Runner belongs to process")
    np.testing.assert_array_equal(runner.observe().qpos, before.qpos)
    assert runner.step(ROBOT.start).ok.all()


def test_a_stopped_worker_does_not_hang_whoever_has_much_to_send():
    with Runner(ROBOT, 64, workers=1) as runner:
        runner._workers[0]._channel._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)  # as much as nothing
        os.kill(runner.pids[0], signal.SIGSTOP)
        with pytest.warns(UserWarning, match="stuck: stopped"):
            obs = runner.reset(qpos=np.tile(NEAR, (64, 1)))
        assert runner.recoveries == 1
    np.testing.assert_allclose(obs.qpos, np.tile(NEAR, (64, 1)), atol=1e-6)


def run(program, *arguments, **options):
    """What a program prints that is not installed, but found where it was started."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    paths = [path for path in sys.path if path and Path(path) != ROOT]
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        capture_output=True,
        text=True,
        env=environment | {"PYTHONPATH": os.pathsep.join(paths)},
        cwd=ROOT,
        timeout=120,
        **options,
    )
    return done.stdout.splitlines() or done.stderr


def test_from_another_folder_and_with_odd_paths():
    program = """
import os, pathlib, sys, warnings
warnings.simplefilter("ignore")
from sim import Robot, Runner
os.chdir("/")
sys.path.append(pathlib.Path("/tmp"))
robot = Robot.load("panda")
with Runner(robot, 1, workers=1) as runner:
    print(runner.step(robot.start).ok.all())
"""
    assert run(program) == ["True"]


def test_workers_that_cannot_be_started_leave_nothing_behind():
    program = """
import os, resource, sys, warnings
warnings.simplefilter("ignore")
from batchpid.errors import WorkerError
from sim import Robot, Runner
robot = Robot.load("panda")
before = len(os.listdir("/proc/self/fd"))
for limit in (before + 5, before + 12):
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, 4096))
    try:
        Runner(robot, 64, workers=8)
    except WorkerError as error:
        print(error)
    resource.setrlimit(resource.RLIMIT_NOFILE, (4096, 4096))
    assert len(os.listdir("/proc/self/fd")) <= before + 1, os.listdir("/proc/self/fd")
sys.executable = ""
try:
    Runner(robot, 1, workers=1)
except WorkerError as error:
    print(error)
"""
    first, second, third = run(program)
    assert re.match(r"worker \d .*cannot be started: .*Too many open files; pass a smaller workers=", first)
    assert re.match(r"worker \d .*cannot be started: .*Too many open files; pass a smaller workers=", second)
    assert "sys.executable" in third
