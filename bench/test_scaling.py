"""Time of an env step of the closed loop by the number of envs, of workers, and of sim steps in a tick."""

import time

import numpy as np
import pytest
from workload import Workload

from batchpid.sim import Robot, Runner

ROUNDS = 2


@pytest.fixture
def run_scaling(benchmark, report, most):
    """Function that measures ``steps`` sim steps in ticks of ``substeps``."""

    def run_scaling(num_envs, workers, substeps, steps):
        robot = Robot.load("panda")
        workload, ticks = Workload(robot), min(max(1, steps // substeps), most.ticks)
        num_envs, workers, rounds = min(num_envs, most.envs), min(workers, most.workers), min(ROUNDS, most.rounds)
        seconds = []
        with Runner(robot, num_envs, params=robot.params(), workers=workers, substeps=substeps) as runner:
            runner.reset(workload.start)

            def run():
                began = time.perf_counter()
                for _ in range(ticks):
                    obs = runner.step(workload.target)
                seconds.append((time.perf_counter() - began) / (num_envs * ticks * substeps))
                return obs

            obs = benchmark.pedantic(run, rounds=rounds, warmup_rounds=1)
        assert obs.ok.all()
        assert (np.abs(obs.qpos - workload.start)[:, workload.moving].max(axis=1) > 1e-4).all(), "they did not move"
        report(seconds[-rounds:])

    return run_scaling


@pytest.mark.parametrize("num_envs", [1, 8, 64, 512, 2048])
def test_scaling_envs(benchmark, run_scaling, num_envs):
    benchmark.group = "envs (2 workers)"
    run_scaling(num_envs, workers=2, substeps=20, steps=max(20, 20_000 // num_envs))


@pytest.mark.parametrize("workers", [0, 1, 2, 3, 4])
def test_scaling_workers(benchmark, run_scaling, workers):
    benchmark.group = "workers (64 envs)"
    run_scaling(64, workers, substeps=20, steps=500)


@pytest.mark.parametrize("substeps", [1, 2, 5, 20, 100])
def test_scaling_substeps(benchmark, run_scaling, substeps):
    benchmark.group = "substeps (64 envs, 2 workers)"
    run_scaling(64, workers=2, substeps=substeps, steps=500)
