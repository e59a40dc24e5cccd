"""Measurements that a benchmark and a check of its floors share: few robots in the caller's process
over the tutorial's loop, and actuators over ideal ones.

Processor time: another program disturbs it less.
"""

from __future__ import annotations

import statistics
import time
from contextlib import ExitStack

import numpy as np
from tutorial import TutorialLoop
from workload import Workload

import batchpid as bp
from batchpid.sim import Robot

TICKS = 50
COUNTS = (1, 4, 16)
"""Numbers of robots in the caller's process."""
CASES = {
    "all off": {},
    "armature": {"armature": 1e-4},
    "strength": {"strength": 0.95},
    "effort limit": {"effort_limit": 60.0},
}
"""Options of actuators whose runners are compared with one of ideal ones."""


def speeds_over_ideal(physics, most, rounds):
    """Return the speed of each case relative to actuators=None: the median of rounds in which all
    take turns.

    Processor time of this process, in which the robots are: another program disturbs it less.
    """
    num_envs, rounds = min(16, most.envs), min(rounds, most.rounds)
    workload = Workload(Robot.load("panda"), num_envs, workers=0, physics=physics, ticks=10)
    setpoints = np.broadcast_to(workload.target, (workload.ticks, num_envs, len(workload.target)))
    rng, seconds = np.random.default_rng(0), []
    with ExitStack() as stack:
        chosen = {name: bp.make_actuators(9, **options) for name, options in CASES.items()}
        runners = {
            name: stack.enter_context(workload.runner(actuators=each))
            for name, each in {"ideal": None, **chosen}.items()
        }
        for _ in range(rounds + 1):
            took = {}
            for name in rng.permutation(list(runners)):
                runners[name].reset(workload.start)
                began = time.process_time()
                qpos = runners[name].rollout(setpoints).qpos[-1]
                took[name] = time.process_time() - began
                assert np.abs(qpos - workload.start)[:, workload.moving].max(1).min() > 0.02, (
                    "the robots did not move"
                )
            seconds.append(took)
    return {
        name: statistics.median(took["ideal"] / took[name] for took in seconds[1:])
        for name in CASES
    }


def few_robots(name, num_envs, physics, most, rounds=3):
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
