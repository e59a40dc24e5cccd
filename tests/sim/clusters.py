"""Ray clusters of several nodes on this machine, and runners to try on them."""

from __future__ import annotations

import numpy as np
import pytest
from processes import shared_memory
from robots import load_bundled

from batchpid.sim import Ray, Runner

ROBOT = load_bundled("panda")
N = 12
SMALL = {"object_store_memory": 80 << 20, "include_dashboard": False}
FILTERS = [
    pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning"),  # of JAX, which other tests may have loaded
    # Ray's own: files and sockets that it leaves to the collector, and calls that its dependencies deprecate.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:ray"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


class Machines:
    """Ray nodes on this machine, one CPU each, and a head without."""

    def __init__(self):
        from ray.cluster_utils import Cluster

        self._shared = shared_memory()
        head = {"num_cpus": 0, "_system_config": {"worker_niceness": 0}, **SMALL}
        self.cluster = Cluster(initialize_head=True, head_node_args=head)
        self.nodes = []

    def ensure(self, count):
        """Add nodes until there are ``count``."""
        while len(self.nodes) < count:
            self.nodes.append(self.cluster.add_node(num_cpus=1, **SMALL))
        return self

    def raylet(self, pid):
        """Return the node that is the parent of process ``pid``, and its raylet."""
        import psutil

        raylets = [(node, node.all_processes["raylet"][0].process) for node in self.nodes]
        return next(each for each in raylets if each[1].pid == psutil.Process(pid).ppid())

    def kill(self, pid):
        """Kill the machine of process ``pid``, with which that ends."""
        node, raylet = self.raylet(pid)
        raylet.kill()
        raylet.wait()
        self.nodes.remove(node)

    def options(self, nodes=None, **options):
        return Ray(self.cluster.address, nodes=nodes, **options)

    def close(self):
        import ray

        ray.shutdown()
        self.cluster.shutdown()
        assert shared_memory() <= self._shared


def setpoints(ticks, seed=1):
    noise = np.random.default_rng(seed).uniform(-0.3, 0.3, (ticks, N, ROBOT.dof))
    return np.clip(ROBOT.settings.target + noise, ROBOT.lower, ROBOT.upper)


def make_runner(**options):
    return Runner(ROBOT, N, **{"params": ROBOT.params(), "checkpoint_steps": 300, **options})


def pids_of(runner):
    return [pid for info in runner.nodes for pid in (info.pid, *info.pids)]
