"""Rates of the closed loop, the tutorial's loop, the bare engine and third-party peers, measured in turn.

``batchpid bench`` prints the same. A row is the time of an env step, and the column OPS is env-steps per second, which
``extra_info`` has as well.
"""

import importlib.util

import pytest

from batchpid.sim import Robot
from batchpid.sim.benchmark.benchmark import CASES, IN_MUJOCO, OURS, XLA_CASES, cases_in, measure_rates
from batchpid.sim.benchmark.peers import PEERS
from batchpid.sim.benchmark.workload import Workload

ENVS, TICKS, ROUNDS = 32, 50, 3  # two groups of envs


@pytest.fixture(
    scope="module",
    params=[(name, physics) for name in ("panda", "jaco2") for physics in ("accurate", "fast")],
    ids=", ".join,
)
def setup(request, most):
    """Name of robot and physics, and the results of all cases. XLA, MuJoCo and the peers run with "accurate" only."""
    name, physics = request.param
    if not most.floors and physics == "accurate":  # with XLA
        request.getfixturevalue("quick_smoke")
    envs, workers, rounds = min(ENVS, most.envs), min(2, most.workers), min(ROUNDS, most.rounds)
    workload = Workload(Robot.load(name), envs, workers, physics, ticks=TICKS, rounds=rounds)
    peers = [each for each in PEERS if physics == "accurate" and importlib.util.find_spec(PEERS[each].package)]
    names = cases_in(xla=True, mujoco="mujoco" in peers) if physics == "accurate" else CASES
    return ", ".join(request.param), measure_rates(workload, peers=peers, names=names)


@pytest.mark.parametrize("case", CASES | XLA_CASES | IN_MUJOCO | PEERS)
def test_case(benchmark, report, compare, setup, case):
    benchmark.group, results = setup
    if case not in results:
        pytest.skip("XLA, MuJoCo and peers run with physics 'accurate' only, if installed")
    result = results[case]
    benchmark.pedantic(lambda: result, rounds=1)
    report([1 / rate for rate in result.rates])
    if case != OURS:
        compare(benchmark.group, OURS, case, results[OURS].over(result))
