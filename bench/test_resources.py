"""What a Runner takes beside the time to step: memory, the time to build, to start, and to pass a tick on."""

import gc
import os
import time
from pathlib import Path
from statistics import median

import numpy as np
import pytest

from sim import Robot, Runner
from sim.benchmark.setup import Setup

FEW, MANY = 64, 1024


@pytest.fixture(params=["panda", "jaco2"])
def setup(request):
    return Setup(Robot.load(request.param))


def resident(pids):
    """Resident memory of some processes [bytes]."""
    pages = [int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in pids]
    return sum(pages) * os.sysconf("SC_PAGE_SIZE")


def stepped(runner, setup):
    """The runner after its first tick, in which the robots moved."""
    runner.reset(setup.start)
    obs = runner.step(setup.target)
    assert (np.abs(obs.qpos - setup.start)[:, setup.moving].max(axis=1) > 1e-4).all()


def test_memory_and_build(benchmark, setup):
    """From 64 to 1024 envs: what one more takes to build, and holds once stepped, workers and parent together."""
    benchmark.group = "resources"
    seconds, memory = {FEW: [], MANY: []}, {FEW: [], MANY: []}

    def build(num_envs):
        gc.collect()
        began = time.perf_counter()
        with Runner(setup.robot, num_envs, workers=2) as runner:
            seconds[num_envs].append(time.perf_counter() - began)
            stepped(runner, setup)
            memory[num_envs].append(resident(runner.pids) + runner.num_envs * shared_bytes(setup))

    def both():
        build(FEW)
        build(MANY)

    benchmark.pedantic(both, rounds=3, warmup_rounds=1)
    more = MANY - FEW
    slope = (median(memory[MANY]) - median(memory[FEW])) / more
    each = (median(seconds[MANY]) - median(seconds[FEW])) / more
    benchmark.extra_info |= {
        "MB_per_env": round(slope / 2**20, 3),
        "build_ms_per_env": round(1e3 * each, 3),
    }
    assert 0.1 < slope / 2**20 < 10


def shared_bytes(setup):
    """Of one env in the parent's end of the shared arrays: 3 doubles, 3 floats and a flag per joint, 4 words."""
    return setup.robot.dof * (3 * 8 + 3 * 4 + 1) + 4 * 8


def test_start(benchmark, setup):
    """From ``Runner(...)`` to the first step of 64 envs."""
    benchmark.group = "resources"
    gone = []

    def start():
        runner = Runner(setup.robot, 64, workers=2)
        runner.step(setup.target)
        gone.append(runner)

    def close():
        while gone:
            gone.pop().close()

    benchmark.pedantic(start, setup=close, rounds=5, warmup_rounds=1)
    stepped(gone[0], setup)
    close()
    benchmark.extra_info["start_seconds"] = round(benchmark.stats.stats.median, 3)


def test_flat(benchmark, setup):
    """Cost of an env step with 2048 envs over that with 64, in turn on two runners of two workers."""
    benchmark.group = "resources"
    ratios = []
    with Runner(setup.robot, 64, workers=2) as few, Runner(setup.robot, 2048, workers=2) as many:
        for runner in (few, many):
            stepped(runner, setup)

        def cost(runner, ticks):
            began = time.perf_counter()
            for _ in range(ticks):
                runner.step(setup.target)
            return (time.perf_counter() - began) / (ticks * runner.num_envs)

        def both():
            for runner in (few, many):
                runner.reset(setup.start)
            ratios.append(cost(many, 1) / cost(few, 20))

        benchmark.pedantic(both, rounds=7, warmup_rounds=1)
        obs = many.observe()
    assert obs.ok.all()
    benchmark.extra_info["cost_2048_over_64"] = round(median(ratios), 3)


def test_tick(benchmark, setup):
    """What a tick of one sim step costs beyond the work of the slower worker: a policy at 2 kHz in the parent."""
    benchmark.group = "resources"
    over = []
    with Runner(setup.robot, 64, workers=2, substeps=1) as runner:
        stepped(runner, setup)

        def ticks():
            for _ in range(500):
                began = time.perf_counter()
                runner.step(setup.target)
                over.append(time.perf_counter() - began - runner.work_seconds.max())

        benchmark.pedantic(ticks, rounds=5, warmup_rounds=1)
    benchmark.extra_info["us_over_work"] = round(1e6 * median(over), 1)
