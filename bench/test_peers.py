"""Time of an env step of third-party baselines: MuJoCo, and Gymnasium's AsyncVectorEnv around the tutorial's loop.

The same moves as in ``test_throughput.py``, and the same groups. ``batchpid bench --peers`` prints them paired.
"""

import pytest
from test_throughput import measure

from sim import Robot
from sim.benchmark.peers import PEERS, make_peers
from sim.benchmark.workload import Workload


@pytest.mark.parametrize("peer", PEERS)
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_peer(benchmark, name, peer):
    pytest.importorskip(PEERS[peer].package)
    benchmark.group = f"{name}, accurate"
    workload = Workload(Robot.load(name))
    measure(benchmark, workload, peer, make_peers(workload, [peer])[peer])
