"""Rates of the closed loop, the tutorial's loop, the bare engine and third-party peers, measured in turn.

measure.py prints the same. A row is the time of an env step, and the column OPS is env-steps per second, which
``extra_info`` has as well.
"""

import pytest
from measure import CASES, MUJOCO_LOOPS, OURS, XLA_LOOPS, measure_rates
from peers import PEERS, installed_peers
from workload import Workload

from batchpid.sim import Robot

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
    names = [*CASES]
    if physics == "accurate":
        peers = installed_peers()
        names += [*XLA_LOOPS, *(MUJOCO_LOOPS if "mujoco" in peers else ()), *peers]
    return ", ".join(request.param), measure_rates(workload, names)


@pytest.mark.parametrize("case", [*CASES, *XLA_LOOPS, *MUJOCO_LOOPS, *PEERS])
def test_case(benchmark, report, compare, setup, case):
    benchmark.group, results = setup
    if case not in results:
        pytest.skip("XLA, MuJoCo and peers run with physics 'accurate' only, if installed")
    result = results[case]
    benchmark.pedantic(lambda: result, rounds=1)
    report([1 / rate for rate in result.rates])
    if case != OURS:
        compare(benchmark.group, OURS, case, results[OURS].over(result))
