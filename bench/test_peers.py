"""What else steps many robots on a CPU: MuJoCo, and Gymnasium's AsyncVectorEnv around the tutorial's loop.

The same moves as in ``test_throughput.py``, and the same groups. ``batchpid bench --peers`` prints them paired.
"""

import pytest
from test_throughput import ROUNDS, record

from sim import Robot
from sim.benchmark.benchmark import check_motion
from sim.benchmark.peers import PEERS, make_peer
from sim.benchmark.setup import Setup


@pytest.mark.parametrize("peer", PEERS)
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_peer(benchmark, name, peer):
    pytest.importorskip(PEERS[peer].package)
    benchmark.group = f"{name}, accurate"
    setup = Setup(Robot.load(name))
    stepper = make_peer(peer, setup)
    try:
        steps, final = benchmark.pedantic(
            stepper.run, (setup.ticks,), setup=stepper.reset, rounds=ROUNDS, warmup_rounds=1
        )
    finally:
        stepper.close()
    check_motion(peer, final, setup)
    record(benchmark, steps)
