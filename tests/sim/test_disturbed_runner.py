"""A runner under kills, stops, signals and errors: bit-identical to an undisturbed one in this process,
or closed.
"""

import contextlib
import gc
import os
import random
import signal
import subprocess
import sys
import threading
import time
import warnings
from functools import partial

import numpy as np
import psutil
import pytest
from identical import assert_identical
from processes import handler, have_ended, send
from robots import load_bundled

from batchpid.errors import ClosedError, WorkerError
from batchpid.sim import RecoveryWarning, Robot, Runner

ROBOT = load_bundled("panda")
N, SUBSTEPS = 4, 5
NEAR = 0.9 * ROBOT.start + 0.1 * ROBOT.settings.target
PROGRAMS = int(os.environ.get("BATCHPID_SOAK_PROGRAMS", "20"))
DISTURBANCES = ("none", "none", "kill", "kill all", "stop", "ctrl-c")


def make(workers, **options):
    return Runner(
        ROBOT, N, workers=workers, params=ROBOT.params(), substeps=SUBSTEPS, timeout=3.0, **options
    )


def change_params(runner, setpoints):
    runner.params = ROBOT.params(kp=20.0 + 10 * abs(setpoints[0, 0, 0]))
    return runner.observe()


def go_back(runner, setpoints):
    snapshot = runner.snapshot()
    runner.rollout(setpoints[:2])
    return runner.restore(snapshot)


COMMANDS = {
    "step": lambda runner, setpoints: runner.step(
        setpoints[0], feedforward=setpoints[1], substeps=7
    ),
    "rollout": lambda runner, setpoints: runner.rollout(setpoints).observation,
    "reset": lambda runner, setpoints: runner.reset(NEAR, mask=setpoints[0, :, 0] > 0),
    "change params": change_params,
    "go back": go_back,
}
INTERRUPTED = ("step", "reset", "change params")
"""Commands of one request, which Ctrl-C leaves done or not begun."""


@contextlib.contextmanager
def later(seconds, act):
    """Call ``act`` in a thread after ``seconds``."""
    timer = threading.Timer(seconds, act)
    timer.start()
    try:
        yield
    finally:
        timer.join()


def run_interrupted(runner, model, command, seconds):
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


def run_program(seed, length, engine):
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


def count_open():
    """Return the numbers of descriptors and of children of this process."""
    gc.collect()  # an mmap keeps its descriptor until the arrays on it are collected
    me = psutil.Process()
    return me.num_fds(), len(me.children())


@pytest.mark.filterwarnings("ignore::batchpid.sim.RecoveryWarning")
@pytest.mark.parametrize(
    ("seed", "length"),
    [(0, 3), *[pytest.param(seed, 10, marks=pytest.mark.slow) for seed in range(PROGRAMS)]],
)
def test_commands_in_any_order_under_disturbances(seed, length, monkeypatch):
    monkeypatch.setattr("batchpid.sim.runner.runner.CHECKPOINT_STEPS", 40)
    before = count_open()
    run_program(seed, length, engine=("sapien", "mujoco")[seed % 2])
    descriptors, children = count_open()
    assert descriptors <= before[0] + 2
    assert children <= before[1]


class Acts:
    """Controller of the passive force that calls ``act`` with the number of each sim step."""

    def __init__(self, act):
        self.act = act

    def init(self, robot, num_envs, timestep):
        return np.zeros(num_envs, int)

    def __call__(self, state, setpoint, qpos, qvel, passive):
        self.act(int(state[0]))
        return state + 1, passive


def acting(act, workers, **options):
    options = {"control": Acts(act), "substeps": SUBSTEPS, "workers": workers, **options}
    return Runner(ROBOT, 2, **options)


def test_a_lost_worker_is_named_and_the_others_stay():
    with make(2) as runner:
        lost, other = runner.pids
        send(lost, signal.SIGKILL)
        named = r"worker 0 \(envs 0 to 1\) died \(Killed\); replaced"
        with pytest.warns(RecoveryWarning, match=named):
            runner.step(NEAR)
        assert (runner.recoveries, runner.pids[1]) == (1, other)
        assert not psutil.pid_exists(lost)
        # A warning as an error leaves the tick done.
        send(other, signal.SIGKILL)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with pytest.raises(RecoveryWarning):
                runner.step(NEAR)
        assert runner.time == 2 * SUBSTEPS * runner.timestep


WITH_SIGPIPE = """
import os, signal, sys, time, warnings
from batchpid.sim import Robot, Runner
signal.signal(signal.SIGPIPE, signal.SIG_DFL)
warnings.simplefilter("ignore")
robot = Robot.load("panda")
with Runner(robot, 1, workers=1, engine="mujoco") as runner:
    os.kill(runner.pids[0], signal.SIGKILL)
    time.sleep(0.3)
    runner.step(robot.start)
    print(runner.recoveries)
"""
WITH_CHILD = """
import os, sys, time
from batchpid.sim import Robot, Runner
robot = Robot.load("panda")
runner = Runner(robot, 2, workers=2, engine="mujoco")
child = os.fork()
if child == 0:
    time.sleep(600)
print(child, *runner.pids, flush=True)
time.sleep(600)
"""


def start(program):
    command = [sys.executable, "-c", program]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def test_a_dead_worker_does_not_end_a_caller_with_sigpipe_at_its_default():
    with start(WITH_SIGPIPE) as process:
        assert process.communicate()[0].split() == ["1"]


def test_a_forked_child_does_not_keep_the_workers_of_a_killed_caller():
    with start(WITH_CHILD) as process:
        assert process.stdout is not None
        child, *workers = map(int, process.stdout.readline().split())
        process.kill()
    try:
        assert have_ended(workers)
    finally:
        os.kill(child, signal.SIGKILL)


def test_closing_does_not_wait_for_a_worker_that_is_stopped():
    # The time limit of a test is shorter than that of the request.
    with Runner(ROBOT, N, workers=2, timeout=3600.0) as runner:
        send(runner.pids[0], signal.SIGSTOP)


def test_a_worker_without_an_answer_is_stuck_after_the_timeout(capfd, monkeypatch):
    monkeypatch.setattr("batchpid.sim.workers.pool.MAX_LOSSES", 1)

    def work_for_ever(step):
        while True:
            pass

    with (
        acting(work_for_ever, 1, timeout=0.5) as runner,
        pytest.raises(WorkerError, match=r"is stuck: no answer in time; raise timeout="),
    ):
        runner.step(NEAR)
    assert "work_for_ever" in capfd.readouterr().err  # its stack


def test_a_request_that_kills_every_worker_is_given_up(monkeypatch, tmp_path):
    monkeypatch.setattr("batchpid.sim.workers.pool.MAX_LOSSES", 2)

    def crash(step):
        (tmp_path / str(os.getpid())).touch()
        os.kill(os.getpid(), signal.SIGSEGV)

    with (
        acting(crash, 1) as runner,
        pytest.raises(WorkerError, match=r"Segmentation fault.*lost 2 times.*workers=0"),
    ):
        runner.step(NEAR)
    assert len(os.listdir(tmp_path)) == 2
    assert runner.closed


@pytest.mark.parametrize(
    ("engine", "resets", "replayed"),
    [
        ("mujoco", {}, 10),
        # Env 0 is reset at 20 and 30 sim steps, env 1 at 25: from a checkpoint at 20.
        ("sapien", {4: [0], 5: [1], 6: [0]}, 30),
        ("sapien", {4: [0], 6: [0]}, 50),
    ],
)
def test_only_the_requests_since_the_last_checkpoint_are_replayed(
    tmp_path, monkeypatch, engine, resets, replayed
):
    monkeypatch.setattr("batchpid.sim.runner.runner.CHECKPOINT_STEPS", 20)
    path = tmp_path / "steps"

    def write_a_dot(step):
        with path.open("ab") as file:
            file.write(b".")

    with acting(write_a_dot, 1, engine=engine) as runner:
        # In MuJoCo checkpoints come after 20 and 40 sim steps.
        for tick in range(9):
            if tick in resets:
                runner.reset(mask=np.isin([0, 1], resets[tick]))
            runner.step(ROBOT.start)
        before = path.stat().st_size
        send(runner.pids[0], signal.SIGKILL)
        with pytest.warns(RecoveryWarning):
            runner.step(ROBOT.start)
    assert (before, path.stat().st_size - before) == (45, replayed)


DOG = Robot.load("quadruped", fixed_base=False)
WALK = DOG.start + 0.15 * np.sin(np.arange(24))[:, None, None] * np.ones((1, 3, DOG.dof))


@pytest.mark.filterwarnings("ignore::batchpid.sim.RecoveryWarning")
def test_a_replay_from_resets_of_some_envs_in_contact(engine, monkeypatch):
    monkeypatch.setattr("batchpid.sim.runner.runner.CHECKPOINT_STEPS", 24)
    masks = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1], [0, 0, 0]], bool)
    with (
        Runner(DOG, 3, workers=2, engine=engine, substeps=8) as runner,
        Runner(DOG, 3, workers=0, engine=engine, substeps=8) as model,
    ):
        for number, mask in enumerate(masks):
            send(runner.pids[number % 2], signal.SIGKILL)
            part = slice(4 * number, 4 * number + 4)
            for each in (runner, model):
                if mask.any():
                    each.reset(mask=mask)
            assert_identical(runner.rollout(WALK[part]), model.rollout(WALK[part]))


def test_a_run_whose_commands_are_too_many_cannot_be_replayed(monkeypatch):
    monkeypatch.setattr("batchpid.sim.workers.pool.MOST_BYTES", 4 * 8 * N * ROBOT.dof * 8)
    with make(1, engine="sapien") as runner:
        runner.rollout(np.tile(NEAR, (20, 1)))
        runner.snapshot()
        send(runner.pids[0], signal.SIGKILL)
        with pytest.warns(RecoveryWarning):
            runner.step(NEAR)
        runner.rollout(np.tile(NEAR, (20, 1)))
        send(runner.pids[0], signal.SIGKILL)
        with pytest.raises(WorkerError, match=r"too many to be replayed: .*runner\.snapshot"):
            runner.step(NEAR)


# -- Ctrl-C and other signals


def interrupting(*steps):
    """Return an act that sends SIGINT to the process of the test in some sim steps."""
    pid = os.getpid()
    return lambda step: os.kill(pid, signal.SIGINT) if step in steps else None


@pytest.mark.parametrize("workers", [0, 1])
def test_ctrl_c_waits_for_the_request_in_progress(workers):
    before = signal.getsignal(signal.SIGINT)
    with (
        acting(interrupting(SUBSTEPS + 2, 3 * SUBSTEPS), workers) as runner,
        acting(lambda step: None, 0) as model,
    ):
        runner.step(NEAR)
        with pytest.raises(KeyboardInterrupt):
            runner.step(NEAR)
        assert signal.getsignal(signal.SIGINT) is before
        for _ in range(2):
            last = model.step(NEAR)
        assert runner.time == model.time
        assert_identical(runner.observe(), last)
        assert_identical(runner.step(NEAR), model.step(NEAR))
        with pytest.raises(KeyboardInterrupt):
            runner.rollout(np.tile(NEAR, (5_000, 1)))
        ticks = round(runner.time / (SUBSTEPS * runner.timestep))
    assert 3 < ticks < 2_000


@pytest.mark.parametrize("workers", [0, 1])
def test_a_second_ctrl_c_ends_the_tick_and_closes_the_runner(workers):
    pid = os.getpid()

    def hang(step):
        while step == SUBSTEPS + 1:
            time.sleep(0.05)
            os.kill(pid, signal.SIGINT)

    with acting(hang, workers) as runner:
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
    times = []
    with acting(interrupting(2), 1) as runner:
        with handler(signal.SIGINT, lambda *_: times.append(runner.time)):
            assert runner.step(NEAR).ok.all()
        assert times == [runner.time]


@pytest.mark.parametrize("workers", [0, 1])
def test_an_exception_of_another_signal_handler_closes_the_runner(workers, monkeypatch):
    """Between requests to workers, and between sim steps in this process, in Python's calls."""

    def fail(*_):
        raise TimeoutError

    monkeypatch.setenv("BATCHPID_NATIVE", "0")
    with (
        make(workers) as runner,
        handler(signal.SIGALRM, fail),
        pytest.raises(TimeoutError),
    ):
        runner.step(NEAR, substeps=1_000_000)
    assert runner.closed
    assert runner.time == 0


def test_calls_in_another_thread_leave_ctrl_c_to_the_main_thread():
    seen = []
    with make(0) as runner:
        work = lambda: seen.append((runner.step(NEAR), signal.getsignal(signal.SIGINT)))  # noqa: E731
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert seen[0][0].ok.all()
    assert seen[0][1] is signal.getsignal(signal.SIGINT)
