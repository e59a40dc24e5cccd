"""Env-steps per second: the closed loop beside the tutorial's loop and the bare engine.

Groups hold what is to be compared. One round of every case is 64 robots (the tutorial's loop: one) through one
simulated second; ``extra_info`` has env-steps per second. ``batchpid bench`` prints the same cases paired.
"""

import numpy as np
import pytest

from sim import Robot, Runner
from sim.benchmark import CASES, Setup, check_motion
from sim.hands import Hand, run_by_hand

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

    @pytest.mark.parametrize("case", [case for case in CASES if case != "closed loop"])
    def test_by_hand(self, benchmark, setups, name, physics, case):
        setup = setups[name, physics]
        benchmark.group = f"{name}, {physics}"
        hands = [Hand(setup, index) for index in range(1 if case == "tutorial" else setup.workers)]
        try:
            _, steps, final = benchmark.pedantic(run_by_hand, (case, hands, setup), rounds=ROUNDS)
        finally:
            for hand in hands:
                hand.close()
        check_motion(case, final, setup)
        record(benchmark, steps)

    def test_closed_loop(self, benchmark, setups, name, physics):
        setup = setups[name, physics]
        benchmark.group = f"{name}, {physics}"
        robot = Robot.load(name, dissipation="sapien")
        with Runner(robot, setup.num_envs, workers=setup.workers, physics=physics) as runner:

            def second():
                runner.reset(setup.start)
                for _ in range(setup.ticks):
                    obs = runner.step(setup.target)
                return obs.qpos[0].astype(np.float64)

            final = benchmark.pedantic(second, rounds=ROUNDS, warmup_rounds=1)
        check_motion("closed loop", final, setup)
        record(benchmark, setup.num_envs * setup.ticks * setup.substeps)


def record(benchmark, steps):
    benchmark.extra_info["env_steps_per_second"] = round(steps / benchmark.stats.stats.median)
