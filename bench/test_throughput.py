"""Rates of the closed loop, the tutorial's loop, the bare engine and third-party peers, measured in
turn.

measure.py prints the same.
"""

import pytest
from measure import CASES, MUJOCO_LOOPS, OURS, measure_rates
from peers import installed_peers
from workload import Workload

from batchpid.sim import Robot

ENVS, TICKS, ROUNDS = 32, 50, 3  # two groups of envs


@pytest.mark.usefixtures("quick_smoke")
@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_cases(benchmark, report, compare, most, name, physics):
    """Env-steps per second of the closed loop over those of every case; MuJoCo and peers with
    "accurate" only.
    """
    benchmark.group = f"{name}, {physics}"
    envs, workers, rounds = min(ENVS, most.envs), min(2, most.workers), min(ROUNDS, most.rounds)
    workload = Workload(Robot.load(name), envs, workers, physics, ticks=TICKS, rounds=rounds)
    names = [*CASES]
    if physics == "accurate":
        peers = installed_peers()
        names += [*(MUJOCO_LOOPS if "mujoco" in peers else ()), *peers]
    results = benchmark.pedantic(lambda: measure_rates(workload, names), rounds=1)
    report([1 / rate for rate in results[OURS].rates])
    benchmark.extra_info |= {case: round(result.rate) for case, result in results.items()}
    for case, result in results.items():
        if case != OURS:
            compare(benchmark.group, OURS, case, results[OURS].over(result))
