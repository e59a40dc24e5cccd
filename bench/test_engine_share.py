"""Speed of the closed loop relative to the bare engine, in this process: the engine's share of the
time.

Pandas under their default gains (mass matrix) and the URDF's friction, held at several poses. The
bare engine steps the same robots at the same poses under PhysX's drives, robot by robot. Processor
times: other programs disturb them less.
"""

from __future__ import annotations

import statistics
import time

import numpy as np
import pytest
from baselines import DriveLoop
from workload import Workload

from batchpid.sim import Robot, Runner

ENVS, TICKS, ROUNDS, POSES = 32, 10, 5, 6


def engine_share(pose, physics, most):
    """Return the speed of the closed loop relative to the bare engine at one pose, for each
    round.
    """
    envs, ticks, rounds = min(ENVS, most.envs), min(TICKS, most.ticks), min(ROUNDS, most.rounds)
    workload = Workload(Robot.load("panda"), envs, workers=0, physics=physics, ticks=ticks)
    bare, found = DriveLoop(workload, envs, pose, pose + 0.01), []
    setpoints = np.broadcast_to(pose, (ticks, envs, len(pose)))
    with Runner(
        workload.robot,
        envs,
        engine="sapien",
        workers=0,
        physics=physics,
        substeps=workload.substeps,
    ) as runner:
        for _ in range(rounds + 1):
            runner.reset(qpos=pose + 0.01)
            began = time.process_time()
            qpos = runner.rollout(setpoints).qpos
            between = time.process_time()
            bare.run(workload.steps)
            found.append((time.process_time() - between) / (between - began))
            assert np.abs(qpos[-1] - (pose + 0.01)).max() > 2e-4, "the robots did not move"
    return found[1:]


@pytest.mark.parametrize("physics", ["accurate", "fast"])
def test_engine_share(benchmark, compare, most, physics):
    benchmark.group = "closed loop over the bare engine, in one process"
    robot = Robot.load("panda")
    count = int(min(POSES, most.poses))
    poses = np.clip(robot.sample(POSES, seed=0)[:count], robot.lower + 0.02, robot.upper - 0.02)
    ratios = benchmark.pedantic(
        lambda: [statistics.median(engine_share(pose, physics, most)) for pose in poses], rounds=1
    )
    benchmark.extra_info["share"] = [round(ratio, 3) for ratio in ratios]
    compare(
        f"panda, {physics}, {POSES} poses",
        "closed loop, default gains",
        "bare engine",
        statistics.median(ratios),
    )
    print("\n" + ", ".join(f"{ratio:.3f}" for ratio in ratios))
