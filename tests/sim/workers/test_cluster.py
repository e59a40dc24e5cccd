"""Runners on a Ray cluster of several nodes on this machine: bit-identical to a local one, after
any loss.
"""

import os
import signal

import numpy as np
import psutil
import pytest
from identical import assert_identical
from processes import have_ended
from robots import load_bundled

from batchpid.errors import InvalidArgumentError
from batchpid.sim import RecoveryWarning, Runner

ray = pytest.importorskip("ray")
from ray.cluster_utils import Cluster  # noqa: E402

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings(
        "ignore:os.fork:RuntimeWarning"
    ),  # of JAX, which other tests may have loaded
    # Ray's own: files and sockets that it leaves to the collector, and calls that its dependencies
    # deprecate.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:ray"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
ROBOT = load_bundled("panda")
N = 12
SMALL = {"object_store_memory": 80 << 20, "include_dashboard": False}


@pytest.fixture
def cluster(monkeypatch):
    """Two Ray nodes on this machine, one CPU each, and a head without."""
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **SMALL})
    monkeypatch.setenv("RAY_ADDRESS", made.address)
    made.nodes = [made.add_node(num_cpus=1, **SMALL) for _ in range(2)]
    yield made
    ray.shutdown()
    made.shutdown()


def nodes():
    """Return the processes of the actors, on which the workers depend."""
    processes = psutil.process_iter(["cmdline"])
    return [
        each for each in processes if "".join(each.info["cmdline"] or ()).startswith("ray::Node")
    ]


def all_pids():
    return [each.pid for node in nodes() for each in (node, *node.children())]


def kill_node(cluster):
    os.kill(nodes()[1].pid, signal.SIGKILL)


def kill_worker(cluster):
    os.kill(nodes()[0].children()[0].pid, signal.SIGKILL)


def stop_node(cluster):
    os.kill(nodes()[0].pid, signal.SIGSTOP)


def kill_machine(cluster):
    node = nodes()[1]
    raylets = {each.all_processes["raylet"][0].process.pid: each for each in cluster.nodes}
    cluster.remove_node(raylets[node.ppid()], allow_graceful=False)
    assert have_ended([node.pid])  # which answers until then


def program(runner, disturb=lambda: None):
    """Call the methods that change a state; return what can be observed."""
    noise = np.random.default_rng(1).uniform(-0.3, 0.3, (40, N, ROBOT.dof))
    setpoints = np.clip(ROBOT.settings.target + noise, ROBOT.lower, ROBOT.upper)
    runner.rollout(setpoints[:20])
    runner.reset(0.9 * ROBOT.start + 0.1 * ROBOT.settings.target, mask=np.arange(N) % 3 == 1)
    runner.params = ROBOT.params(
        kp=np.linspace(20.0, 30.0, N)[:, None], derivative_filter_time=1e-3
    )
    snapshot = runner.snapshot()
    runner.step(setpoints[0], feedforward=np.ones(ROBOT.dof), substeps=7)
    disturb()
    rollout = runner.rollout(setpoints[20:], setpoint_rates=np.full((20, ROBOT.dof), 0.1))
    return rollout, runner.restore(snapshot), runner.step(setpoints[1])


@pytest.mark.parametrize("disturb", [kill_node, kill_worker, stop_node, kill_machine])
def test_results_are_bit_identical_after_the_loss_of(disturb, cluster):
    with Runner(ROBOT, N, params=ROBOT.params(), workers=0) as runner:
        expected = program(runner)
    with Runner(ROBOT, N, params=ROBOT.params(), cluster="ray", timeout=5.0) as runner:
        pids = all_pids()
        assert len(pids) >= 4
        with pytest.warns(
            RecoveryWarning, match=r"node [01] \(envs (0 to 5|6 to 11)\) (is lost|lost a worker)"
        ):
            results = program(runner, lambda: disturb(cluster))
        for one, two in zip(expected, results, strict=True):
            assert_identical(one, two)
        assert runner.recoveries == 1
        pids += all_pids()
    assert have_ended(pids)


def test_a_cluster_without_cpus_is_refused(cluster):
    for node in cluster.nodes:
        cluster.remove_node(node)
    with pytest.raises(InvalidArgumentError, match="no machine with a CPU"):
        Runner(ROBOT, N, params=ROBOT.params(), cluster="ray")
