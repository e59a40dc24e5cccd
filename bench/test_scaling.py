"""Time of an env step of the closed loop by the number of envs, of workers, and of sim steps in a tick."""

import numpy as np
import pytest
from test_throughput import ROUNDS, report_per_env_step

from sim import Robot, Runner
from sim.benchmark.workload import Workload


@pytest.mark.parametrize("num_envs", [1, 8, 64, 512, 2048])
def test_scaling_envs(benchmark, num_envs):
    benchmark.group = "envs (2 workers)"
    run_scaling(benchmark, num_envs, workers=2, substeps=20, steps=max(20, 20_000 // num_envs))


@pytest.mark.parametrize("workers", [0, 1, 2, 3, 4])
def test_scaling_workers(benchmark, workers):
    benchmark.group = "workers (64 envs)"
    run_scaling(benchmark, 64, workers, substeps=20, steps=500)


@pytest.mark.parametrize("substeps", [1, 2, 5, 20, 100])
def test_scaling_substeps(benchmark, substeps):
    benchmark.group = "substeps (64 envs, 2 workers)"
    run_scaling(benchmark, 64, workers=2, substeps=substeps, steps=500)


def run_scaling(benchmark, num_envs, workers, substeps, steps):
    """Measure ``steps`` sim steps in ticks of ``substeps``."""
    robot = Robot.load("panda")
    workload, ticks = Workload(robot), max(1, steps // substeps)
    with Runner(robot, num_envs, params=robot.params(), workers=workers, substeps=substeps) as runner:
        runner.reset(workload.start)

        def run():
            for _ in range(ticks):
                obs = runner.step(workload.target)
            return obs

        obs = benchmark.pedantic(run, rounds=ROUNDS, warmup_rounds=1)
    assert obs.ok.all()
    assert (np.abs(obs.qpos - workload.start)[:, workload.moving].max(axis=1) > 1e-4).all(), "the robots did not move"
    report_per_env_step(benchmark, num_envs * ticks * substeps)
