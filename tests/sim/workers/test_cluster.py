"""Runners on a Ray cluster of several nodes on this machine: bit-identical to a local one, whatever is lost."""

from __future__ import annotations

import os

import numpy as np
import pytest
from identical import assert_identical
from processes import have_ended
from robots import load_bundled

from sim import Ray, Runner

ray = pytest.importorskip("ray")
pytestmark = [
    # Ray's own: files and sockets that it leaves to the collector, and calls that its dependencies deprecate.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:ray"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

ROBOT = load_bundled("panda")
N = 12
SMALL = {"object_store_memory": 80 << 20, "include_dashboard": False}


class Machines:
    """Ray nodes on this machine, one CPU each, and a head without."""

    def __init__(self):
        from ray.cluster_utils import Cluster

        self.cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **SMALL})
        self.nodes = []

    def ensure(self, count):
        while len(self.nodes) < count:
            self.nodes.append(self.cluster.add_node(num_cpus=1, **SMALL))
        return self

    def raylet(self, index):
        return self.nodes[index].all_processes["raylet"][0].process

    def kill(self, index):
        process = self.raylet(index)
        process.kill()
        process.wait()
        return self.nodes.pop(index)

    def options(self, nodes=None, **options):
        return Ray(self.cluster.address, nodes=nodes, **options)


@pytest.fixture(scope="module")
def machines():
    before = set(os.listdir("/dev/shm"))
    made = Machines()
    yield made
    ray.shutdown()
    made.cluster.shutdown()
    assert set(os.listdir("/dev/shm")) <= before


def setpoints(ticks, seed=1):
    noise = np.random.default_rng(seed).uniform(-0.3, 0.3, (ticks, N, ROBOT.dof))
    return np.clip(ROBOT.settings.target + noise, ROBOT.lower, ROBOT.upper)


def make_runner(**options):
    return Runner(ROBOT, N, **{"params": ROBOT.params(), "checkpoint_steps": 300, "pack_size": 1, **options})


class Tape:
    """Recorder that keeps what it is given."""

    def __init__(self):
        self.ticks = []

    def append(self, time_, setpoint, observation):
        self.ticks.append((time_, setpoint, observation))


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


@pytest.mark.parametrize("nodes", [1, 2, 3])
def test_results_are_bit_identical_for_any_number_of_nodes(nodes, machines, expected):
    with make_runner(cluster=machines.ensure(nodes).options(nodes)) as runner:
        assert len(runner.nodes) == nodes
        assert [info.envs for info in runner.nodes][-1].stop == N
        assert_same(expected, program(runner))
        pids = [pid for info in runner.nodes for pid in (info.pid, *info.pids)]
        assert len(pids) == 2 * nodes
    assert have_ended(pids)
