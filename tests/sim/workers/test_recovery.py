"""A worker that dies or gets stuck costs seconds and no data; nobody is left behind, whoever ends, and however."""

from __future__ import annotations

import contextlib
import gc
import os
import random
import signal
import subprocess
import sys
import textwrap
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import psutil
import pytest
from identical import assert_identical
from robots import load_bundled

from batchpid.errors import ClosedError, WorkerError
from sim import RecoveryWarning, Runner

ROBOT = load_bundled("panda")
N, TICKS = 8, 30
KILLS = int(os.environ.get("BATCHPID_SOAK_KILLS", "100"))


def table(ticks=TICKS):
    noise = np.random.default_rng(1).uniform(-0.3, 0.3, (ticks, N, ROBOT.dof))
    return np.clip(ROBOT.settings.target + noise, ROBOT.lower, ROBOT.upper)


def make(**options):
    return Runner(ROBOT, N, **({"params": ROBOT.params(), "workers": 2, "checkpoint_steps": 150} | options))


@pytest.fixture(scope="module")
def undisturbed():
    with make(workers=0) as runner:
        return runner.rollout(table())


def at_tick(tick, act):
    """A progress bar that calls ``act`` before the given tick."""

    def progress(ticks):
        for number in ticks:
            if number == tick:
                act()
            yield number

    return progress


@contextlib.contextmanager
def later(seconds, act):
    timer = threading.Timer(seconds, act)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()


def send(pid, number):
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def test_the_fixture_moves_its_robots(undisturbed):
    assert np.abs(undisturbed.qpos[-1] - ROBOT.start).max() > 0.1


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV, signal.SIGSTOP])
def test_a_lost_worker_is_brought_back_to_the_same_bytes(number, undisturbed):
    with make() as runner:
        before = runner.pids
        progress = at_tick(20, lambda: send(runner.pids[1], number))
        with pytest.warns(RecoveryWarning, match=r"worker 1 \(pid \d+, envs 4 to 7\)"):
            rollout = runner.rollout(table(), progress=progress)
        assert runner.recoveries == 1
        assert runner.pids[0] == before[0]
        assert runner.pids[1] != before[1]
        assert not psutil.pid_exists(before[1])
    assert_identical(undisturbed, rollout)


def test_killed_amid_a_long_tick_and_noticed_at_once():
    with make(recover=False) as runner, later(0.5, lambda: send(runner.pids[0], signal.SIGKILL)):
        began = time.monotonic()
        with pytest.raises(WorkerError, match=r"envs 0 to 3\) died \(SIGKILL\).*recover=True"):
            runner.step(ROBOT.settings.target, substeps=1_000_000)
        assert time.monotonic() - began < 5  # and not after the minute that the other worker's tick takes
        assert runner.closed
        with pytest.raises(ClosedError):
            runner.observe()


def test_stopped_amid_a_tick_and_noticed():
    with make(recover=False) as runner:
        send(runner.pids[1], signal.SIGSTOP)
        with pytest.raises(WorkerError, match=r"envs 4 to 7\) is stuck: stopped for"):
            runner.step(ROBOT.settings.target)


def test_asleep_amid_a_tick_and_told_where():
    def build(scene, env):
        # Stands for whatever blocks for ever in a worker: the next tick waits for a lock that nobody releases.
        import threading as threads

        import sim.loop.loop

        if env == 4:
            lock = threads.Lock()
            lock.acquire()
            sim.loop.loop.Loop.run = lambda *_: lock.acquire()

    with (
        make(recover=False, build=build) as runner,
        pytest.raises(WorkerError, match="is stuck: asleep") as info,
    ):
        runner.step(ROBOT.settings.target)
    assert "lock.acquire" not in str(info.value)
    assert "last stack" in str(info.value)
    assert "test_recovery.py" in str(info.value)


def test_too_slow_for_the_timeout():
    def build(scene, env):
        import sim.loop.loop

        def endless(*_):
            while True:
                pass

        sim.loop.loop.Loop.run = endless

    with (
        make(recover=False, build=build, timeout=0.5) as runner,
        pytest.raises(WorkerError, match="no answer within"),
    ):
        runner.step(ROBOT.settings.target)


def test_as_many_workers_as_cores_keep_to_one_each():
    cores = os.sched_getaffinity(0)
    with Runner(ROBOT, 8 * len(cores) + 8, params=ROBOT.params(), workers=len(cores), recover=True) as runner:
        assert {frozenset(os.sched_getaffinity(pid)) for pid in runner.pids} == {frozenset([core]) for core in cores}
        os.kill(runner.pids[0], signal.SIGKILL)
        with pytest.warns(RecoveryWarning):
            runner.step(ROBOT.start)
        assert len(os.sched_getaffinity(runner.pids[0])) == 1
    with Runner(ROBOT, 8 * len(cores) + 8, params=ROBOT.params(), workers=len(cores) + 1) as runner:
        assert {frozenset(os.sched_getaffinity(pid)) for pid in runner.pids} == {frozenset(cores)}


def test_a_busy_or_starved_worker_is_not_taken_for_stuck():
    with make(recover=False) as runner:
        obs = runner.step(ROBOT.settings.target, substeps=8_000)  # more than a second in one tick
        assert obs.ok.all()


def test_killed_between_ticks_at_start_and_while_it_catches_up(undisturbed):
    with make() as runner:
        for pid in runner.pids:
            send(pid, signal.SIGKILL)
        first = threading.Timer(0.3, lambda: [send(pid, signal.SIGKILL) for pid in runner.pids])
        first.start()
        with pytest.warns(RecoveryWarning):
            rollout = runner.rollout(table())
        first.join()
    assert_identical(undisturbed, rollout)


def test_everything_is_replayed(undisturbed):
    """Resets of some envs, params, queries and snapshots between ticks: all come back."""

    def program(runner, kill):
        runner.rollout(table(8))
        runner.reset(qpos=0.9 * ROBOT.start + 0.1 * ROBOT.settings.target, mask=np.arange(N) % 3 == 1)
        runner.params = ROBOT.params(kp=30.0, derivative_filter_time=1e-3)
        runner.step(table()[3], feedforward=np.ones(ROBOT.dof), substeps=7)
        kill()
        snapshot = runner.snapshot()
        runner.rollout(table(4))
        kill()
        runner.restore(snapshot)
        kill()
        runner.reset(mask=np.arange(N) == 6)
        kill()
        return runner.rollout(table(5), setpoint_rates=np.full(ROBOT.dof, 0.1) * np.ones((5, 1)))

    with make(workers=0) as runner:
        expected = program(runner, lambda: None)
    with make() as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore", RecoveryWarning)
        assert_identical(expected, program(runner, lambda: send(runner.pids[1], signal.SIGKILL)))
        assert runner.recoveries == 4


def test_killed_amid_whatever_it_does(tmp_path):
    """Once in each method of the loop the worker dies when it has done it, before it can say so."""
    methods = ("reset", "set_params", "run", "snapshot", "restore", "poses")

    def build(scene, env):
        import sim.loop.loop

        for name in methods:
            act, mark = getattr(sim.loop.loop.Loop, name), tmp_path / name
            if hasattr(act, "__wrapped__"):
                continue

            def lethal(self, *args, act=act, mark=mark):
                result = act(self, *args)
                if armed.exists() and not mark.exists():
                    mark.touch()
                    os.kill(os.getpid(), signal.SIGKILL)
                return result

            lethal.__wrapped__ = act
            setattr(sim.loop.loop.Loop, name, lethal)
        return []

    def program(runner):
        runner.params = ROBOT.params(kp=30.0)
        runner.reset(qpos=ROBOT.settings.target, mask=np.arange(2) == 1)
        runner.rollout(table(3)[:, :2])
        snapshot = runner.snapshot()
        runner.step(table()[3, :2])
        assert runner.poses().shape == (2, 0, 7)
        runner.restore(snapshot)
        return runner.rollout(table(4)[:, :2])

    armed = tmp_path / "armed"
    with Runner(ROBOT, 2, params=ROBOT.params(), workers=0, build=lambda scene, env: []) as runner:
        expected = program(runner)
    with Runner(ROBOT, 2, params=ROBOT.params(), workers=1, build=build) as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore", RecoveryWarning)
        armed.touch()
        assert_identical(expected, program(runner))
    assert sorted(os.listdir(tmp_path)) == sorted([*methods, "armed"])


def test_what_kills_every_worker_is_not_tried_for_ever(monkeypatch):
    monkeypatch.setattr("sim.workers.pool.MAX_LOSSES", 2)

    def build(scene, env):
        import sim.loop.loop

        def crash(*_):
            os.kill(os.getpid(), signal.SIGSEGV)

        sim.loop.loop.Loop.run = crash

    with (
        make(build=build) as runner,
        pytest.raises(WorkerError, match=r"(?s)SIGSEGV.*lost 2 times.*workers=0"),
    ):
        runner.step(ROBOT.settings.target)


def test_what_a_loop_raises_comes_with_its_traceback():
    def build(scene, env):
        import sim.loop.loop

        def explode(*_):
            raise ZeroDivisionError("what the worker said")

        sim.loop.loop.Loop.run = explode

    with (
        make(build=build) as runner,
        pytest.raises(WorkerError, match=r"(?s)worker \d.*envs.*ZeroDivisionError: what"),
    ):
        runner.step(ROBOT.settings.target)


@pytest.mark.parametrize("workers", [0, 2])
def test_ctrl_c_amid_a_rollout_leaves_a_runner_that_goes_on(workers):
    with make(workers=workers) as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore", RecoveryWarning)
        for delay in (0.02, 0.07, 0.11):
            with later(delay, lambda: signal.raise_signal(signal.SIGINT)), pytest.raises(KeyboardInterrupt):
                runner.rollout(table(2000))
        ended, steps = runner.observe(), round(runner.time * 2000)
        again = runner.rollout(table(3))
    assert 0 < steps < 3 * 2000 * 20
    assert ended.ok.all()
    assert again.ok.all()


@pytest.mark.parametrize("workers", [0, 2])
def test_an_interrupted_tick_is_finished_before_anything_else(workers):
    results = []
    for interrupted in (False, True):
        with make(workers=workers) as runner:
            runner.rollout(table(5))
            if interrupted:
                with (
                    later(0.02, lambda: signal.raise_signal(signal.SIGINT)),
                    pytest.raises(KeyboardInterrupt),
                ):
                    runner.step(table()[5], substeps=1500)
            else:
                runner.step(table()[5], substeps=1500)
            results.append((runner.observe(), runner.rollout(table(5)), runner.time))
    for first, second in zip(*results, strict=True):
        if hasattr(first, "qpos"):
            assert_identical(first, second)
        else:
            assert first == second


# -- whoever ends, nothing stays ---------------------------------------------------------------------------------

PROGRAM = """
import sys, numpy as np, warnings
warnings.simplefilter("ignore")
from sim import Robot, Runner
robot = Robot.load("panda")
runner = Runner(robot, 8, params=robot.params(), workers=2)
print(*runner.pids, flush=True)
{body}
"""


def start(body, **options):
    text = PROGRAM.format(body=textwrap.dedent(body))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))}
    process = subprocess.Popen(
        [sys.executable, "-c", text],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        **options,
    )
    pids = [int(pid) for pid in process.stdout.readline().split()]
    assert len(pids) == 2, process.communicate()[1]
    return process, pids


def gone(pids, seconds=5.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if not any(psutil.pid_exists(pid) and psutil.Process(pid).status() != "zombie" for pid in pids):
            return True
        time.sleep(0.02)
    return False


LONG = "while True: runner.step(robot.settings.target, substeps=1000000)"
SHORT = "while True: runner.step(robot.settings.target)"


ENDS = [(number, LONG) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL, signal.SIGSEGV)]
ENDS += [(number, SHORT) for number in (signal.SIGINT, signal.SIGKILL)]


@pytest.mark.parametrize(("number", "body"), ENDS)
def test_no_process_stays_when_the_parent_ends(number, body):
    shared = set(os.listdir("/dev/shm"))
    process, pids = start(body)
    with process:
        time.sleep(0.3)
        process.send_signal(number)
        error = process.communicate(timeout=20)[1]
    assert gone(pids)
    assert set(os.listdir("/dev/shm")) <= shared
    if number == signal.SIGINT:
        assert error.rstrip().endswith("KeyboardInterrupt")


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ("raise RuntimeError('the caller')", 1),
        ("sys.exit(7)", 7),
        ("runner.close(); runner.close(); sys.exit(3)", 3),
        ("import os; os._exit(9)", 9),
        ("runner.step(robot.settings.target); del runner; print('end')", 0),
        ("f = Runner.__exit__; f(runner, None, None, None); print(runner.closed)", 0),
    ],
)
def test_no_process_stays_after_any_end(body, status):
    process, pids = start(body)
    with process:
        error = process.communicate(timeout=30)[1]
    assert process.returncode == status, error
    assert gone(pids)
    assert "Exception ignored" not in error


def test_a_forked_child_leaves_the_workers_to_the_parent():
    body = """
    import os
    child = os.fork()
    if child == 0:
        runner.close()
        os._exit(0)
    os.waitpid(child, 0)
    print(runner.step(robot.settings.target).ok.all())
    """
    process, pids = start(body)
    with process:
        output, error = process.communicate(timeout=30)
    assert output.strip() == "True", error
    assert gone(pids)


@pytest.mark.parametrize("how", ["stdin", "script", "thread"])
def test_programs_without_a_main_guard_just_work(how, tmp_path):
    text = PROGRAM.format(body="print(runner.step(robot.settings.target).ok.all(), len(runner.pids))")
    if how == "thread":
        text = "import threading\ndef job():\n" + textwrap.indent(text, "    ")
        text += "\nthread = threading.Thread(target=job); thread.start(); thread.join()"
    script = tmp_path / "script.py"
    script.write_text(text)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))}
    arguments = [sys.executable, "-"] if how == "stdin" else [sys.executable, str(script)]
    done = subprocess.run(
        arguments,
        input=text if how == "stdin" else None,
        capture_output=True,
        text=True,
        env=environment,
        cwd=tmp_path,
        timeout=60,
    )
    assert done.stdout.splitlines()[-1] == "True 2", done.stderr
    assert gone([int(pid) for pid in done.stdout.splitlines()[0].split()])


# -- many times ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_kills_at_random_moments_of_many_rollouts(undisturbed):
    chance = random.Random(0)
    me = psutil.Process()
    recovered, descriptors = 0, None
    for round_ in range(KILLS):
        with make() as runner, warnings.catch_warnings():
            warnings.simplefilter("ignore", RecoveryWarning)
            pids = runner.pids
            with later(chance.uniform(0, 0.35), lambda pids=pids: send(chance.choice(pids), signal.SIGKILL)):
                began = time.monotonic()
                rollout = runner.rollout(table())
                assert time.monotonic() - began < 60
            recovered += runner.recoveries
            pids += runner.pids
        assert_identical(undisturbed, rollout)
        assert gone(pids)
        if round_ == 4:
            gc.collect()
            descriptors = me.num_fds()
    gc.collect()  # mmap keeps a descriptor of its own until the arrays on it are collected
    assert me.num_fds() <= descriptors + 2
    assert recovered > KILLS // 3  # most kills fell into the rollout
    assert not me.children()
