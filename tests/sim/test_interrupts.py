"""Ctrl-C waits for the request in progress; a second one ends it and closes the runner."""

from __future__ import annotations

import contextlib
import os
import signal
import threading

import numpy as np
import pytest
from identical import assert_identical
from processes import have_ended
from robots import load_bundled

from batchpid.errors import ClosedError
from batchpid.sim import Recorder, Robot, Runner, read_recording

ROBOT = load_bundled("panda")
N, SUBSTEPS = 2, 5
NEAR = 0.9 * ROBOT.start + 0.1 * ROBOT.settings.target


class SignalsAt:
    """Controller that sends SIGINT to the process of the test in given sim steps."""

    def __init__(self, *steps):
        self.steps, self.pid = steps, os.getpid()

    def init(self, robot, num_envs):
        return np.zeros(num_envs, int)

    def __call__(self, state, setpoint, qpos, qvel, passive):
        if state[0] in self.steps:
            os.kill(self.pid, signal.SIGINT)
        return state + 1, passive


def make(workers, *steps):
    return Runner(ROBOT, N, workers=workers, control=SignalsAt(*steps), substeps=SUBSTEPS)


@pytest.mark.parametrize("workers", [0, 1])
def test_ctrl_c_in_a_tick_is_raised_when_it_is_done(workers, tmp_path):
    before = signal.getsignal(signal.SIGINT)
    with (
        make(workers, SUBSTEPS + 2) as runner,
        make(0) as model,
        Recorder(tmp_path / "run.h5", runner) as recorder,
    ):
        runner.step(NEAR)
        with pytest.raises(KeyboardInterrupt):
            runner.step(NEAR)
        assert signal.getsignal(signal.SIGINT) is before
        assert runner.time == 2 * SUBSTEPS * runner.timestep
        for _ in range(2):
            last = model.step(NEAR)
        assert_identical(runner.observe(), last)
        assert_identical(runner.step(NEAR), model.step(NEAR))
        recorder.close()
    assert len(read_recording(tmp_path / "run.h5").time) == 3


@pytest.mark.parametrize("workers", [0, 1])
def test_a_rollout_ends_after_the_request_in_progress(workers, tmp_path):
    with make(workers, 1) as runner, Recorder(tmp_path / "run.h5", runner) as recorder:
        with pytest.raises(KeyboardInterrupt):
            runner.rollout(np.tile(NEAR, (5_000, 1)))
        ticks = round(runner.time / (SUBSTEPS * runner.timestep))
        recorder.close()
    assert 0 < ticks <= 8000 / (SUBSTEPS * (N if workers == 0 else 1))
    assert len(read_recording(tmp_path / "run.h5").time) == ticks


@pytest.mark.parametrize("workers", [0, 1])
def test_a_second_ctrl_c_ends_the_tick_and_closes_the_runner(workers):
    class Hangs(SignalsAt):
        def __call__(self, state, setpoint, qpos, qvel, passive):
            import time

            while state[0] == SUBSTEPS + 1:
                time.sleep(0.05)
                os.kill(self.pid, signal.SIGINT)
            return state + 1, passive

    with Runner(ROBOT, N, workers=workers, control=Hangs(), substeps=SUBSTEPS) as runner:
        runner.step(NEAR)
        pids = runner.pids
        with pytest.raises(KeyboardInterrupt):
            runner.step(NEAR)
        with contextlib.suppress(KeyboardInterrupt):  # one more, before the worker has ended
            assert have_ended(pids)
        assert runner.closed
        assert runner.time == SUBSTEPS * runner.timestep
        with pytest.raises(ClosedError, match="since a call failed"):
            runner.step(NEAR)


def test_a_handler_of_the_callers_own_is_called_when_the_tick_is_done():
    times, before = [], signal.getsignal(signal.SIGINT)
    with make(1, 2) as runner:
        signal.signal(signal.SIGINT, lambda *_: times.append(runner.time))
        try:
            assert runner.step(NEAR).ok.all()
        finally:
            signal.signal(signal.SIGINT, before)
        assert times == [runner.time]


def test_an_exception_of_another_signal_handler_closes_the_runner():
    def handler(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, handler)
    try:
        with Runner(ROBOT, N, workers=1) as runner:
            signal.setitimer(signal.ITIMER_REAL, 0.2)
            with pytest.raises(TimeoutError):
                runner.step(NEAR, substeps=1_000_000)
            assert runner.closed
            assert runner.time == 0
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("error", [KeyboardInterrupt, TimeoutError, MemoryError])
def test_an_exception_within_a_sim_step_reaches_the_caller(error, monkeypatch):
    """Native code returns to Python for sensors, since Python drops exceptions of functions that C
    calls.
    """
    pytest.importorskip("sapien")
    from batchpid.sim.engine.sapien.link_sensors import LinkSensors

    robot = Robot.load("quadruped", fixed_base=False)
    with Runner(robot, 2, engine="sapien", workers=0, contacts=[robot.links[-1].name]) as runner:
        runner.step(robot.start)
        steps = []

        def fail(sensors, row):
            steps.append(len(steps))
            if len(steps) == 7:
                raise error

        monkeypatch.setattr(LinkSensors, "_add", fail)
        with pytest.raises(error):
            runner.step(robot.start)
        assert len(steps) == 7
        assert runner.closed


def test_calls_in_another_thread_leave_ctrl_c_to_the_main_thread():
    seen = []
    with make(0) as runner:
        runner.step(NEAR)
        thread = threading.Thread(
            target=lambda: seen.append((runner.step(NEAR), signal.getsignal(signal.SIGINT)))
        )
        thread.start()
        thread.join()
    assert seen[0][0].ok.all()
    assert seen[0][1] is signal.getsignal(signal.SIGINT)
