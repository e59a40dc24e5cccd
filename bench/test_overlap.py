"""Step and policy at once: halves of the envs in turns by send and recv, over step and then policy.

The policy takes as long as half a tick. It waits, as for an accelerator, while the workers have two
cores; or it computes on one core of two, while each runner has one worker.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from time import perf_counter, sleep

import numpy as np
import pytest

from batchpid.sim import Robot, Runner

ENVS = 128  # enough that half of them fill their packs and groups, too
TICKS, ROUNDS, ATTEMPTS, FLOOR = 10, 3, 3, 1.25


def compute(seconds: float) -> None:
    """Use a core for ``seconds``."""
    end = perf_counter() + seconds
    while perf_counter() < end:
        pass


def in_turn(runner: Runner, policy, seconds: float, ticks: int) -> None:
    """Step, then let the policy compute for all envs."""
    for _ in range(ticks):
        runner.step(runner.robot.target)
        policy(seconds)


def at_once(halves: list[Runner], policy, seconds: float, ticks: int) -> None:
    """Compute the policy of one half while the other half steps."""
    for half in halves:
        half.send(half.robot.target)
    for tick in range(ticks):
        for half in halves:
            half.recv()
            policy(seconds / 2)
            if tick < ticks - 1:
                half.send(half.robot.target)


def seconds_of(act, *arguments) -> float:
    begin = perf_counter()
    act(*arguments)
    return perf_counter() - begin


@pytest.mark.check
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
@pytest.mark.parametrize(
    ("policy", "workers"), [(sleep, 2), (compute, 1)], ids=["waits", "computes"]
)
def test_step_and_policy_at_once_are_faster_than_one_after_the_other(most, policy, workers):
    envs, workers, ticks = min(ENVS, most.envs), min(workers, most.workers), min(TICKS, most.ticks)
    with ExitStack() as stack:
        whole, *halves = (
            stack.enter_context(
                Runner(Robot.load("panda"), count, engine="sapien", workers=workers)
            )
            for count in (envs, envs // 2, envs // 2)
        )
        for _ in range(ATTEMPTS):
            ratios = []
            for _ in range(min(ROUNDS, most.rounds)):
                tick = seconds_of(in_turn, whole, lambda _: None, 0.0, ticks) / ticks
                one_by_one = seconds_of(in_turn, whole, policy, tick / 2, ticks)
                ratios.append(one_by_one / seconds_of(at_once, halves, policy, tick / 2, ticks))
            found = float(np.median(ratios))
            print(
                f"\ntick {1e3 * tick:.1f} ms: {found:.2f} times the throughput, rounds"
                f" {np.round(ratios, 2)}"
            )
            for runner in (whole, *halves):
                assert (np.abs(runner.observe().qpos - runner.robot.start).max(1) > 0.05).all(), (
                    "they did not move"
                )
            if found >= FLOOR or not most.floors:
                return
    pytest.fail(f"{found:.2f} times the throughput of step and then policy, floor {FLOOR}")
