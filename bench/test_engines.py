"""MuJoCo as an engine: speed over SAPIEN's, and over MuJoCo alone, in one process in turn; memory
and build time.

Processor time: another program disturbs it less.
"""

from __future__ import annotations

import multiprocessing
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import mujoco.batch as mujoco_batch
import numpy as np
import psutil
import pytest
from workload import Workload

from batchpid.sim import MujocoSolver, Robot, Runner
from batchpid.sim.engine.mujoco.model_builder import robot_model
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.options.options import default_params

TICKS, ROUNDS, SUBSTEPS = 20, 5, 20
GAINS = ("tutorial", "tuned")


def seconds_per_env_step(runner: Runner, workload: Workload, ticks: int) -> float:
    """Return the processor time of an env step; the robots begin at their start."""
    runner.reset(workload.start)
    setpoints = np.broadcast_to(workload.target, (ticks, *workload.target.shape))
    began = time.process_time()
    qpos = runner.rollout(setpoints).qpos[-1]
    seconds = time.process_time() - began
    assert np.abs(qpos - workload.start)[:, workload.moving].max() > 0.05, "the robots did not move"
    return seconds / (ticks * SUBSTEPS * runner.num_envs)


def bare_engine(robot: Robot, num_envs: int, ticks: int) -> float:
    """Return the processor time of an env step of ``mujoco.batch`` alone, of the same robots under
    fixed efforts.
    """
    options: dict[str, Any] = {"ground": robot.has_ground}
    spec = SceneSpec(
        robot.tables, robot.self_contact.ignored, robot.joints, 1 / 2000, MujocoSolver(), **options
    )
    built = robot_model(spec)
    batch = mujoco_batch.Batch(built.model, num_envs, nthread=1, persistent=True)
    qpos = batch.bind("qpos")
    qpos[:, built.qpos] = robot.start
    before = qpos.copy()
    batch.bind("qfrc_applied")[...] = 0.1
    began = time.process_time()
    for _ in range(ticks * SUBSTEPS):
        batch.step()
    seconds = time.process_time() - began
    assert np.abs(qpos - before).max() > 1e-3, "the robots did not move"
    return seconds / (ticks * SUBSTEPS * num_envs)


@pytest.mark.parametrize("gains", GAINS)
@pytest.mark.parametrize("num_envs", [1, 64])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_speed_over_sapien(benchmark, report, compare, most, name, num_envs, gains):
    benchmark.group = "MuJoCo, in one process"
    robot, num_envs = Robot.load(name), min(num_envs, most.envs)
    params = robot.params() if gains == "tutorial" else default_params(robot)
    ticks, rounds = min(TICKS if num_envs > 1 else 5 * TICKS, most.ticks), min(ROUNDS, most.rounds)
    workload = Workload(robot, num_envs, workers=0, ticks=ticks)

    def measure():
        options: dict[str, Any] = {"params": params, "workers": 0, "substeps": SUBSTEPS}
        with (
            Runner(robot, num_envs, engine="sapien", **options) as accurate,
            Runner(robot, num_envs, engine="sapien", physics="fast", **options) as fast,
            Runner(robot, num_envs, engine="mujoco", **options) as mujoco,
        ):
            runners = accurate, fast, mujoco
            rows = []
            for _ in range(rounds + 1):
                row = [seconds_per_env_step(runner, workload, ticks) for runner in runners]
                rows.append([*row, bare_engine(robot, num_envs, ticks)])
        return rows[1:]

    rows = benchmark.pedantic(measure, rounds=1)
    report([row[2] for row in rows])
    for column, other in (
        (0, "SAPIEN accurate"),
        (1, "SAPIEN fast"),
        (3, "mujoco.batch without control"),
    ):
        ratio = statistics.median(row[column] / row[2] for row in rows)
        benchmark.extra_info[f"over {other}"] = round(ratio, 3)
        compare(f"{name}, {gains} gains", f"MuJoCo, {num_envs} envs", other, ratio)


def build_many(num_envs: int) -> tuple[float, float]:
    """Return the seconds to build ``num_envs`` pandas, and the memory of each [bytes], after a
    first step of all.
    """
    robot = Robot.load("panda")
    with Runner(robot, 1, engine="mujoco", workers=0) as runner:
        runner.reset()  # the model is compiled once
    process = psutil.Process()
    before, began = process.memory_info().rss, time.perf_counter()
    with Runner(robot, num_envs, engine="mujoco", workers=0, substeps=1) as runner:
        seconds = time.perf_counter() - began
        start = runner.reset().qpos
        assert np.abs(runner.step(robot.target).qpos - start).max() > 0
        return seconds, (process.memory_info().rss - before) / num_envs


def test_thousands_of_envs(benchmark, report, most):
    """Build 8,192 pandas in one process, and step them once: time, and memory of each.

    It is a new process, because this one may use memory again that earlier tests have freed.
    """
    benchmark.group = "MuJoCo, in one process"
    num_envs = min(8192, 20 * most.envs)

    def build():
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            return pool.submit(build_many, num_envs).result()

    seconds, memory = benchmark.pedantic(build, rounds=1)
    report([seconds])
    benchmark.extra_info |= {
        "build_seconds": round(seconds, 3),
        "kB_per_env": round(memory / 1e3, 2),
    }
    print(f"\n{num_envs} pandas: built in {seconds:.2f} s, {memory / 1e3:.1f} kB for each")
