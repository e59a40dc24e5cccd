"""Few robots in the caller's process, compared with the tutorial's loop: time of an env step,
measured in turn.

Processor time: another program disturbs it less.
"""

import statistics
import time

import numpy as np
import pytest
from tutorial import TutorialLoop
from workload import Workload

from batchpid.sim import Robot

TICKS, ROUNDS = 50, 3
COUNTS = (1, 4, 16)


def few_robots(name, num_envs, physics, most, rounds=ROUNDS):
    """Return the seconds per env step of our loop and of the tutorial's in each round (rounds,
    2).
    """
    num_envs, ticks, rounds = (
        min(num_envs, most.envs),
        min(TICKS, most.ticks),
        min(rounds, most.rounds),
    )
    workload = Workload(Robot.load(name), num_envs, workers=0, physics=physics, ticks=ticks)
    tutorial = TutorialLoop(workload.robot, workload.target, start=workload.start)
    setpoints = np.broadcast_to(workload.target, (ticks, *workload.target.shape))
    seconds = []
    with workload.runner() as runner:
        for _ in range(rounds + 1):
            tutorial.reset()
            runner.reset(workload.start)
            began = time.process_time()
            qpos = runner.rollout(setpoints).qpos[-1]
            between = time.process_time()
            final = tutorial.run(workload.steps)
            ended = time.process_time()
            seconds.append(
                (
                    (between - began) / (workload.steps * num_envs),
                    (ended - between) / workload.steps,
                )
            )
    for place in (*qpos, final):
        assert np.abs(place - workload.start)[workload.moving].max() > 0.05, (
            "the robots did not move"
        )
    return seconds[1:]


@pytest.mark.parametrize("num_envs", COUNTS)
@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_few_robots(benchmark, report, compare, most, name, physics, num_envs):
    benchmark.group = "few robots in the caller's process"
    seconds = benchmark.pedantic(lambda: few_robots(name, num_envs, physics, most), rounds=1)
    report([ours for ours, _ in seconds])
    ratio = statistics.median(theirs / ours for ours, theirs in seconds)
    benchmark.extra_info["over_tutorial"] = round(ratio, 3)
    compare(
        f"{name}, {physics}, in one process", f"closed loop, {num_envs} envs", "tutorial", ratio
    )
