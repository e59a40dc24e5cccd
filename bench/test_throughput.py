"""Time of an env step: the closed loop, the tutorial's loop and the bare engine.

Groups hold what is to be compared. A round is one simulated second of 64 robots (the tutorial's loop: one, or one per
core), and its time is divided by its env-steps: every row is the time of an env step, and the column OPS is env-steps
per second, which ``extra_info`` has as well. ``batchpid bench`` prints the same cases paired.
"""

import pytest

from sim import Robot
from sim.benchmark.baselines import make_baselines
from sim.benchmark.benchmark import CASES, XLA_CASES, make_closed_loops
from sim.benchmark.workload import Workload

ROUNDS = 3


@pytest.mark.parametrize("case", CASES | XLA_CASES)
@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_case(benchmark, name, physics, case):
    benchmark.group = f"{name}, {physics}"
    workload = Workload(Robot.load(name), physics=physics)
    ours = case.startswith("closed loop")
    cases = make_closed_loops(workload, [case]) if ours else make_baselines(workload)
    measure(benchmark, workload, case, cases[case])


def measure(benchmark, workload, name, case):
    """Time rounds of ``case`` and check that its robots moved."""

    def reset():
        case.reset()

    try:
        final = benchmark.pedantic(case.run, setup=reset, rounds=ROUNDS, warmup_rounds=1)
    finally:
        case.close()
    workload.check_motion(name, final)
    report_per_env_step(benchmark, case.env_steps)


def report_per_env_step(benchmark, env_steps):
    """Report the time per env-step in place of the time per round, and env-steps per second."""
    stats = benchmark.stats.stats
    stats.data[:] = [seconds / env_steps for seconds in stats.data]
    benchmark.extra_info["env_steps_per_second"] = round(1 / stats.median)
