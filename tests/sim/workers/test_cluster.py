"""Runners on a Ray cluster of several nodes on this machine: bit-identical to a local one, after any loss."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from functools import partial

import numpy as np
import pytest
from clusters import FILTERS, ROBOT, SMALL, Machines, N, make_runner, pids_of, setpoints
from identical import assert_identical
from processes import have_ended, shared_memory

from batchpid.errors import InvalidArgumentError
from batchpid.sim import ClusterWarning, Ray, RecoveryWarning, Runner

ray = pytest.importorskip("ray")
pytestmark = FILTERS
LONG = 64


@pytest.fixture(scope="module")
def machines():
    made = Machines()
    yield made
    made.close()


class Tape:
    """Recorder that keeps its inputs."""

    def __init__(self):
        self.ticks = []

    def prepare(self):
        pass

    def append(self, time_, command, observation):
        self.ticks.append((time_, command.setpoint, observation))


def program(runner, disturb=lambda: None):
    """Call every method that changes a state; return what can be observed."""
    runner.recorder = tape = Tape()
    seen = [runner.rollout(setpoints(20))]
    runner.recorder = None
    np.testing.assert_array_equal(np.stack([setpoint for _, setpoint, _ in tape.ticks]), seen[0].setpoint)
    runner.reset(qpos=0.9 * ROBOT.start + 0.1 * ROBOT.settings.target, mask=np.arange(N) % 3 == 1)
    seen.append(runner.observe())
    runner.params = ROBOT.params(kp=np.linspace(20.0, 30.0, N)[:, None], derivative_filter_time=1e-3)
    seen.append(runner.step(setpoints(1)[0], feedforward=np.ones(ROBOT.dof), substeps=7))
    disturb()
    snapshot = runner.snapshot()
    seen.append(runner.rollout(setpoints(4, seed=2), setpoint_rates=np.full((4, ROBOT.dof), 0.1)))
    runner.restore(snapshot)
    seen.append(runner.rollout(setpoints(4, seed=3)))
    return seen


@pytest.fixture(scope="module")
def expected():
    with make_runner(workers=0) as runner:
        return program(runner)


def assert_same(expected, got):
    for first, second in zip(expected, got, strict=True):
        assert_identical(first, second)


@pytest.mark.slow
@pytest.mark.parametrize("nodes", [1, 2, 3])
def test_results_are_bit_identical_for_any_number_of_nodes(nodes, machines, expected):
    with make_runner(cluster=machines.ensure(nodes).options(nodes)) as runner:
        assert len(runner.nodes) == nodes
        assert [info.envs for info in runner.nodes][-1].stop == N
        assert_same(expected, program(runner))
        pids = pids_of(runner)
        assert len(pids) == 2 * nodes
    assert have_ended(pids)


def at_tick(acts):
    """Return a progress bar that calls each of ``acts`` before its tick."""

    def progress(ticks):
        for number in ticks:
            if number in acts:
                acts[number]()
            yield number

    return progress


@pytest.fixture(scope="module")
def undisturbed():
    with make_runner(workers=0) as runner:
        return runner.rollout(setpoints(LONG))


def lossy_rollout(machines, losses):
    """Return a rollout on two machines with ``losses``, functions of its runner by tick."""
    with make_runner(cluster=machines.ensure(2).options(2)) as runner:
        pids = pids_of(runner)
        acts = {tick: partial(lose, runner) for tick, lose in losses.items()}
        rollout = runner.rollout(setpoints(LONG), progress=at_tick(acts))
        assert runner.recoveries == len(losses)
        pids += pids_of(runner)
    assert have_ended(pids)
    return rollout


@pytest.mark.slow
def test_a_killed_process_and_a_killed_worker_are_replaced(machines, undisturbed):
    losses = {
        20: lambda runner: os.kill(runner.nodes[1].pid, signal.SIGKILL),
        50: lambda runner: os.kill(runner.nodes[0].pids[0], signal.SIGKILL),
    }
    with pytest.warns(RecoveryWarning, match=r"node [01] \([\d.]+, envs \d+ to \d+\) (died|lost a worker)"):
        rollout = lossy_rollout(machines, losses)
    assert_identical(undisturbed, rollout)


@pytest.mark.slow
def test_the_envs_of_a_killed_machine_go_to_another(machines, undisturbed):
    def kill(runner):
        pid = runner.nodes[1].pid
        machines.kill(pid)
        assert have_ended([pid])

    with pytest.warns(RecoveryWarning, match=r"node 1 \([\d.]+, envs 6 to 11\) died"):
        rollout = lossy_rollout(machines, {40: kill})
    assert_identical(undisturbed, rollout)


@pytest.mark.slow
def test_a_process_that_does_not_answer_is_replaced(machines, undisturbed, monkeypatch):
    monkeypatch.setattr("batchpid.sim.workers.node.SILENCE_LIMIT", 3.0)
    with make_runner(cluster=machines.ensure(2).options(2)) as runner:
        pids = pids_of(runner)
        stop = lambda: os.kill(runner.nodes[0].pid, signal.SIGSTOP)  # noqa: E731
        with pytest.warns(RecoveryWarning, match=r"node 0 .* has not answered for 3 s"):
            rollout = runner.rollout(setpoints(LONG), progress=at_tick({LONG // 2: stop}))
    assert_identical(undisturbed, rollout)
    assert have_ended(pids)


@pytest.mark.slow
def test_an_interrupted_tick_is_done_completely(machines):
    results = []
    for interrupted in (False, True):
        where = {"cluster": machines.ensure(1).options(1)} if interrupted else {"workers": 0}
        with make_runner(**where) as runner:
            runner.rollout(setpoints(5))
            if interrupted:
                timer = threading.Timer(0.05, signal.raise_signal, [signal.SIGINT])
                timer.start()
                with pytest.raises(KeyboardInterrupt):
                    runner.step(setpoints(1)[0], substeps=1200)
                timer.join()
            else:
                runner.step(setpoints(1)[0], substeps=1200)
            assert runner.recoveries == 0
            results.append((runner.observe(), runner.rollout(setpoints(5))))
    assert_same(*results)


def odd_controller():
    """Return a controller that a variable of the environment changes, as a processor might."""

    class Odd:
        def init(self, robot, num_envs):
            return None

        def __call__(self, state, setpoint, qpos, qvel, passive):
            import os

            return state, passive + 50 * (setpoint - qpos) * float(os.environ.get("BATCHPID_TEST_FACTOR", "1"))

    return Odd()


@pytest.fixture
def odd_machine(machines):
    node = machines.ensure(1).cluster.add_node(num_cpus=1, env_vars={"BATCHPID_TEST_FACTOR": "1.0000001"}, **SMALL)
    yield
    machines.cluster.remove_node(node, allow_graceful=False)


@pytest.mark.slow
def test_machines_that_round_differently_are_refused(machines, odd_machine):
    with pytest.raises(InvalidArgumentError, match=r"do not round alike.*accept_differences"):
        make_runner(cluster=machines.options(), control=odd_controller())


@pytest.mark.slow
def test_machines_that_round_differently_are_accepted_on_request(machines, odd_machine):
    with (
        pytest.warns(ClusterWarning, match="do not round alike"),
        make_runner(cluster=machines.options(accept_differences=True), control=odd_controller()) as runner,
    ):
        assert len({info.digest for info in runner.nodes}) == 2


@pytest.mark.slow
def test_steps_whose_time_are_messages_are_warned_of(machines):
    with Runner(ROBOT, 1, params=ROBOT.params(), substeps=1, cluster=machines.ensure(1).options(1)) as runner:
        for _ in range(49):
            runner.step(ROBOT.start)
        with pytest.warns(ClusterWarning, match=r"takes [\d.]+ ms, of which \d+ % are simulation.*rollout"):
            runner.step(ROBOT.start)


DRIVER = """
import sys, psutil
from batchpid.sim import Ray, Robot, Runner
robot = Robot.load("panda")
runner = Runner(robot, 2, params=robot.params(), cluster=Ray({address!r}, nodes=1))
pids = [pid for info in runner.nodes for pid in (info.pid, *info.pids)]
# Ray's agents notice the end of their cluster after a minute.
pids += [child.pid for child in psutil.Process().children(recursive=True) if "Agent" not in child.name()]
print("pids:", *pids, flush=True)
while True:
    runner.step(robot.settings.target)
"""


@pytest.mark.slow
@pytest.mark.parametrize("local", [False, True])
def test_nothing_is_left_of_a_program_that_is_killed(local, machines):
    shared = shared_memory()
    address = "local" if local else machines.ensure(1).cluster.address
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER.format(address=address)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [os.getcwd(), *sys.path]))},
    )
    with process:
        # Ray prints the messages of its machines in between.
        line = next(line for line in process.stdout if line.startswith("pids:"))
        pids = [int(pid) for pid in line.split()[1:]]
        time.sleep(0.3)
        process.kill()
    assert len(pids) > (4 if local else 1)
    assert have_ended(pids)
    assert shared_memory() <= shared


@pytest.mark.parametrize("error", [ConnectionError("failed"), ray.exceptions.AuthenticationError("no token")])
def test_a_cluster_that_refuses_says_what_a_token_needs(error, monkeypatch):
    """Ray names a wrong token in its log alone, and an absent one by an error of its own."""

    def refuse(*_, **__):
        raise error

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", refuse)
    with socket.create_server(("127.0.0.1", 0)) as head:
        address = f"127.0.0.1:{head.getsockname()[1]}"
        with pytest.raises(InvalidArgumentError, match=rf"at {address} cannot be joined.*RAY_AUTH_MODE=token"):
            make_runner(cluster=Ray(address))
