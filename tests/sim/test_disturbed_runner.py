"""A runner under kills, stops and Ctrl-C is bit-identical to an undisturbed one in this process."""

from __future__ import annotations

import contextlib
import gc
import os
import random
import signal
import threading
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import psutil
import pytest
from identical import assert_identical
from processes import have_ended, send
from robots import load_bundled

from batchpid.errors import WorkerError
from batchpid.sim import RecoveryWarning, Runner

ROBOT = load_bundled("panda")
N, SUBSTEPS = 4, 5
NEAR = 0.9 * ROBOT.start + 0.1 * ROBOT.settings.target
PROGRAMS = int(os.environ.get("BATCHPID_SOAK_PROGRAMS", "20"))
DISTURBANCES = ("none", "none", "kill", "kill all", "stop", "ctrl-c")


def make(workers: int, **options: Any) -> Runner:
    return Runner(
        ROBOT, N, workers=workers, params=ROBOT.params(), substeps=SUBSTEPS, timeout=3.0, **options
    )


def exchange(runner: Runner, setpoints: Any) -> Any:
    runner.send(setpoints[0])
    return runner.recv()


def change_params(runner: Runner, setpoints: Any) -> Any:
    runner.params = ROBOT.params(kp=20.0 + 10 * abs(setpoints[0, 0, 0]))
    return runner.observe()


def go_back(runner: Runner, setpoints: Any) -> Any:
    snapshot = runner.snapshot()
    runner.rollout(setpoints[:2])
    return runner.restore(snapshot)


COMMANDS: dict[str, Callable[[Runner, Any], Any]] = {
    "step": lambda runner, setpoints: runner.step(
        setpoints[0], feedforward=setpoints[1], substeps=7
    ),
    "exchange": exchange,
    "rollout": lambda runner, setpoints: runner.rollout(setpoints).observation,
    "reset": lambda runner, setpoints: runner.reset(NEAR, mask=setpoints[0, :, 0] > 0),
    "change params": change_params,
    "go back": go_back,
}
INTERRUPTED = ("step", "reset", "change params")
"""Commands of one request, which Ctrl-C leaves done or not begun."""


@contextlib.contextmanager
def later(seconds: float, act: Callable[[], object]):
    """Call ``act`` in a thread after ``seconds``."""
    timer = threading.Timer(seconds, act)
    timer.start()
    try:
        yield
    finally:
        timer.join()


def run_interrupted(
    runner: Runner, model: Runner, command: Callable[[Runner], Any], seconds: float
) -> None:
    """Run a command under Ctrl-C: afterwards it is done, or nothing has changed."""
    before, copy = runner.snapshot(), model.snapshot()
    with (
        contextlib.suppress(KeyboardInterrupt),
        later(seconds, partial(os.kill, os.getpid(), signal.SIGINT)),
    ):
        command(runner)
    expected = command(model)
    seen = runner.observe()
    is_done = np.array_equal(seen.qpos, expected.qpos) and np.array_equal(
        runner.params.kp, model.params.kp
    )
    if not is_done:
        assert runner.time == before.steps * runner.timestep
        runner.restore(before)
        model.restore(copy)
    assert_identical(runner.observe(), model.observe())


def run_program(seed: int, length: int, engine: Any) -> None:
    """Run random commands, each of them disturbed or not, and compare with a runner in this
    process.
    """
    chance, draw = random.Random(seed), np.random.default_rng(seed)
    with make(2, engine=engine) as runner, make(0, engine=engine) as model:
        pids = {*runner.pids}
        for _ in range(length):
            kind, name = chance.choice(DISTURBANCES), chance.choice(list(COMMANDS))
            if kind == "ctrl-c":
                name = chance.choice(INTERRUPTED)
            noise = draw.uniform(-0.3, 0.3, (1 + chance.randrange(20), N, ROBOT.dof))
            setpoints = np.clip(ROBOT.settings.target + noise, ROBOT.lower, ROBOT.upper)
            setpoints = np.concatenate([setpoints, setpoints[:1]])
            command = partial(COMMANDS[name], setpoints=setpoints)
            seconds = chance.uniform(0, 0.02)
            if kind == "ctrl-c":
                run_interrupted(runner, model, command, seconds)
                continue
            number = signal.SIGSTOP if kind == "stop" else signal.SIGKILL
            lost = runner.pids if kind == "kill all" else (chance.choice(runner.pids),)
            act = (
                (lambda: None) if kind == "none" else (lambda: [send(pid, number) for pid in lost])  # noqa: B023
            )
            with later(seconds, act):
                seen = command(runner)
            assert_identical(command(model), seen)
            pids |= {*runner.pids}
        assert_identical(runner.observe(), model.observe())
        assert runner.time == model.time
    assert have_ended(pids)


def count_open() -> tuple[int, int]:
    """Return the numbers of descriptors and of children of this process."""
    gc.collect()  # an mmap keeps its descriptor until the arrays on it are collected
    me = psutil.Process()
    return me.num_fds(), len(me.children())


@pytest.mark.filterwarnings("ignore::batchpid.sim.RecoveryWarning")
@pytest.mark.parametrize(
    "seed", [0, *[pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, PROGRAMS)]]
)
def test_commands_in_any_order_under_disturbances(seed, monkeypatch):
    monkeypatch.setattr("batchpid.sim.runner.runner.CHECKPOINT_STEPS", 40)
    before = count_open()
    run_program(seed, length=10, engine=("sapien", "mujoco")[seed % 2])
    descriptors, children = count_open()
    assert descriptors <= before[0] + 2
    assert children <= before[1]


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


MARKED = np.where((np.arange(N) == 0)[:, None], 1.0, 0.0) * np.ones(ROBOT.dof)
"""Setpoints at which the first worker acts."""


def test_a_lost_worker_is_named_and_the_others_stay():
    with make(2) as runner:
        lost, other = runner.pids
        send(lost, signal.SIGKILL)
        with pytest.warns(
            RecoveryWarning,
            match=rf"worker 0 \(pid {lost}, envs 0 to 1\) died \(Killed\); replaced",
        ):
            runner.step(NEAR)
        assert runner.recoveries == 1
        assert runner.pids[1] == other
        assert not psutil.pid_exists(lost)


def test_a_worker_without_an_answer_is_stuck_after_the_timeout(capfd, monkeypatch):
    monkeypatch.setattr("batchpid.sim.workers.pool.MAX_LOSSES", 1)

    def work_for_ever():
        while True:
            pass

    options = {"workers": 1, "control": Acts(work_for_ever), "timeout": 0.5}
    with (
        Runner(ROBOT, N, **options) as runner,
        pytest.raises(Exception, match=r"is stuck: no answer in time; raise timeout="),
    ):
        runner.step(MARKED)
    assert "work_for_ever" in capfd.readouterr().err  # its stack


def test_a_request_that_kills_every_worker_is_given_up(monkeypatch, tmp_path):
    monkeypatch.setattr("batchpid.sim.workers.pool.MAX_LOSSES", 2)

    def crash():
        (tmp_path / str(os.getpid())).touch()
        os.kill(os.getpid(), signal.SIGSEGV)

    with (
        Runner(ROBOT, N, workers=1, control=Acts(crash)) as runner,
        pytest.raises(WorkerError, match=r"Segmentation fault.*lost 2 times.*workers=0"),
    ):
        runner.step(MARKED)
    assert len(os.listdir(tmp_path)) == 2
    assert runner.closed


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


def test_only_the_requests_since_the_last_checkpoint_are_replayed(tmp_path, monkeypatch):
    monkeypatch.setattr("batchpid.sim.runner.runner.CHECKPOINT_STEPS", 20)
    path = tmp_path / "steps"
    with Runner(ROBOT, 1, workers=1, control=WritesDots(path), substeps=5) as runner:
        for _ in range(9):
            runner.step(ROBOT.start)  # checkpoints after 20 and 40 sim steps
        before = path.stat().st_size
        send(runner.pids[0], signal.SIGKILL)
        with pytest.warns(RecoveryWarning):
            runner.step(ROBOT.start)
    assert before == 45
    assert path.stat().st_size - before == 10


def test_a_replay_does_not_see_later_writes_to_the_callers_arrays():
    start, mask = np.tile(NEAR, (N, 1)), np.arange(N) < 2
    setpoint = np.tile(NEAR, (N, 1))
    with make(1) as runner, make(0) as model:
        for each in (runner, model):
            each.reset(start, mask=mask)
            each.step(setpoint)
        start[...] = setpoint[...] = ROBOT.start
        mask[...] = ~mask
        send(runner.pids[0], signal.SIGKILL)
        with pytest.warns(RecoveryWarning):
            again = runner.step(NEAR)
        assert_identical(again, model.step(NEAR))


def test_a_warning_as_an_error_leaves_the_tick_done():
    with make(1) as runner, make(0) as model, warnings.catch_warnings():
        warnings.simplefilter("error")
        send(runner.pids[0], signal.SIGKILL)
        with pytest.raises(RecoveryWarning):
            runner.step(NEAR)
        model.step(NEAR)
        assert_identical(runner.step(NEAR), model.step(NEAR))


def test_closing_is_quick_while_a_worker_is_stopped_in_a_tick():
    with make(1) as runner:
        send(runner.pids[0], signal.SIGSTOP)
        runner.send(NEAR)
        began = time.monotonic()
    assert time.monotonic() - began < 2.0
