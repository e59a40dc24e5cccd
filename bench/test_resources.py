"""Memory of a Runner, its time to build, and the cost of many envs."""

import gc
import os
import time
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from workload import Workload

from batchpid.sim import Robot, Runner

FEW, MANY, MOST = 64, 1024, 2048
pytestmark = pytest.mark.filterwarnings(
    "ignore::batchpid.sim.StabilityWarning"
)  # the tutorial's gains on the jaco2


@pytest.fixture(params=["panda", "jaco2"])
def workload(request):
    return Workload(Robot.load(request.param))


@pytest.fixture
def make_runner(workload, most):
    """Function that returns a runner of two workers under the tutorial's gains."""

    def make_runner(num_envs, **options):
        params, workers = workload.robot.params(), min(2, most.workers)
        options = {"engine": "sapien", "workers": workers, **options}
        return Runner(workload.robot, num_envs, params=params, **options)

    return make_runner


def resident(pids):
    """Return the resident memory of some processes [bytes]."""
    pages = [int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in pids]
    return sum(pages) * os.sysconf("SC_PAGE_SIZE")


def step_once(runner, workload):
    """Make the first tick, and check that the robots move."""
    runner.reset(workload.start)
    obs = runner.step(workload.target)
    assert (np.abs(obs.qpos - workload.start)[:, workload.moving].max(axis=1) > 1e-4).all()


def test_memory_and_build(benchmark, make_runner, workload, most):
    """Memory and build time of one env more, from 64 to 1024 envs, workers and parent together."""
    benchmark.group = "resources"
    few, many = sizes(most, MANY)
    seconds, memory = {few: [], many: []}, {few: [], many: []}

    def build(num_envs):
        gc.collect()
        began = time.perf_counter()
        with make_runner(num_envs) as runner:
            seconds[num_envs].append(time.perf_counter() - began)
            step_once(runner, workload)
            memory[num_envs].append(
                resident(runner.pids) + runner.num_envs * shared_bytes(workload)
            )

    def build_few_and_many():
        build(few)
        build(many)

    benchmark.pedantic(build_few_and_many, rounds=min(2, most.rounds), warmup_rounds=1)
    more = many - few
    slope = (median(memory[many]) - median(memory[few])) / more
    each = (median(seconds[many]) - median(seconds[few])) / more
    benchmark.extra_info |= {
        "MB_per_env": round(slope / 2**20, 3),
        "build_ms_per_env": round(1e3 * each, 3),
    }
    assert not most.floors or 0.1 < slope / 2**20 < 10


def sizes(most, many):
    """Return the least and the largest number of envs."""
    return (FEW, many) if many <= most.envs else (1, most.envs)


def shared_bytes(workload):
    """Return the parent's bytes of one env in the shared arrays: 3 doubles, 3 floats, a flag per
    joint; 4 words.
    """
    return workload.robot.dof * (3 * 8 + 3 * 4 + 1) + 4 * 8


def test_cost_of_many_envs(benchmark, compare, make_runner, workload, most):
    """Cost of an env step with 2048 envs over that with 64, in turn on two runners of two
    workers.
    """
    benchmark.group = "resources"
    ratios, (fewest, largest) = [], sizes(most, MOST)
    with make_runner(fewest) as few, make_runner(largest) as many:
        for runner in (few, many):
            step_once(runner, workload)

        def cost(runner, ticks):
            began = time.perf_counter()
            for _ in range(ticks):
                runner.step(workload.target)
            return (time.perf_counter() - began) / (ticks * runner.num_envs)

        def step_few_and_many():
            for runner in (few, many):
                runner.reset(workload.start)
            ratios.append(cost(many, 1) / cost(few, 20))

        benchmark.pedantic(step_few_and_many, rounds=min(3, most.rounds), warmup_rounds=1)
        obs = many.observe()
    assert obs.ok.all()
    benchmark.extra_info["cost_2048_over_64"] = round(median(ratios), 3)
    compare(
        f"{workload.robot.name}, speed of an env step",
        f"{largest} envs",
        f"{fewest} envs",
        1 / median(ratios),
    )
