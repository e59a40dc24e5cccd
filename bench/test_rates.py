"""Cost of setpoints that move within the tick: rollouts with rates against the same without, by
processor time.

The rates are 0, so that both runs make the same motion, and they alternate in one process.
"""

from __future__ import annotations

import statistics
import time

import numpy as np
import pytest

from batchpid.sim import Robot, Runner


@pytest.mark.benchmark(group="setpoint rates")
@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_rates_cost_little(benchmark, report, compare, most, engine):
    robot, num_envs = Robot.load("panda"), int(min(64, most.envs))
    ticks, rounds = int(min(50, most.ticks)), int(min(7, most.rounds))
    setpoints = np.broadcast_to(robot.target, (ticks, num_envs, robot.dof))

    def seconds_per_env_step(runner, **given):
        runner.reset()
        began = time.process_time()
        qpos = runner.rollout(setpoints, **given).qpos
        seconds = time.process_time() - began
        assert np.ptp(qpos, axis=0).max() > 0.1, "the robots did not move"
        return seconds / (ticks * runner.substeps * num_envs)

    def measure():
        cases = {}, {"setpoint_rates": np.zeros_like(setpoints)}
        with Runner(robot, num_envs, engine=engine, workers=0) as runner:
            return [
                [seconds_per_env_step(runner, **case) for case in cases] for _ in range(rounds + 1)
            ][-rounds:]

    rows = benchmark.pedantic(measure, rounds=1)
    report([rated for _, rated in rows])
    ratio = statistics.median(without / rated for without, rated in rows)
    least = 0.86  # 0.9 of the least median measured, 0.96
    compare(f"{engine}, {num_envs} envs", "with rates", "without", ratio, least=least)
