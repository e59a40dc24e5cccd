"""Env-steps per second: the closed loop beside the tutorial's loop and the bare engine.

Groups hold what is to be compared. One round of every case is 64 robots (the tutorial's loop: one) through one
simulated second; ``extra_info`` has env-steps per second. ``batchpid bench`` prints the same cases paired.
"""

import pytest

from sim import Robot, Runner
from sim.benchmark.baselines import BaselineProcess, run_baseline
from sim.benchmark.benchmark import CASES, check_motion, run_closed_loop
from sim.benchmark.setup import Setup

ROUNDS = 3


@pytest.fixture(scope="module")
def setups():
    return {
        (name, physics): Setup(Robot.load(name), physics=physics)
        for name in Robot.bundled()
        for physics in ("accurate", "fast")
    }


@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
class TestThroughput:
    """The cases of ``batchpid bench``."""

    @pytest.mark.parametrize("case", [case for case in CASES if not case.startswith("closed loop")])
    def test_by_hand(self, benchmark, setups, name, physics, case):
        setup = setups[name, physics]
        benchmark.group = f"{name}, {physics}"
        processes = [BaselineProcess(setup, index) for index in range(1 if case == "tutorial" else setup.workers)]
        try:
            _, steps, final = benchmark.pedantic(run_baseline, (case, processes, setup), rounds=ROUNDS)
        finally:
            for process in processes:
                process.close()
        check_motion(case, final, setup)
        record(benchmark, steps)

    @pytest.mark.parametrize("case", [case for case in CASES if case.startswith("closed loop")])
    def test_closed_loop(self, benchmark, setups, name, physics, case):
        setup = setups[name, physics]
        benchmark.group = f"{name}, {physics}"
        robot = Robot.load(name, dissipation="sapien")
        with Runner(robot, setup.num_envs, workers=setup.workers, physics=physics) as runner:
            arguments = (case, runner, setup)
            _, steps, final = benchmark.pedantic(run_closed_loop, arguments, rounds=ROUNDS, warmup_rounds=1)
        check_motion(case, final, setup)
        record(benchmark, steps)


def record(benchmark, steps):
    benchmark.extra_info["env_steps_per_second"] = round(steps / benchmark.stats.stats.median)
