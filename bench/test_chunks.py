"""Cost of a plan of chunks beside setpoints with rates. Processor time, in turn in one process."""

from __future__ import annotations

import statistics
import time

import numpy as np
import pytest

import batchpid as bp
from batchpid.sim import Robot, Runner

CHUNK, CHUNK_TICKS = 16, 20
"""Rows of a chunk, and ticks from chunk to chunk."""


@pytest.mark.benchmark(group="setpoint rates")
def test_a_plan_costs_little(benchmark, report, compare, most):
    """A chunk every 20 ticks, beside the same ticks with rates."""
    robot, num_envs = Robot.load("panda"), int(min(64, most.envs))
    rounds = int(min(15, most.rounds * 2))
    plan = bp.make_plan(joints=robot.dof, period=1 / 30, horizon=CHUNK)
    shares = np.linspace(0.0, 1.0, CHUNK)[:, None]
    rows = robot.start + shares * (robot.target - robot.start)
    chunk = np.tile(rows, (num_envs, 1, 1))
    rate = (rows[1] - rows[0]) / plan.period

    def rated(runner, tick):
        return runner.step(rows[0] + rate * (tick + 1) * 0.01, setpoint_rate=rate)

    def planned(runner, tick):
        return runner.step(None if tick else chunk)

    def seconds_per_env_step(runner, step):
        start = runner.reset().qpos
        began = time.process_time()
        for tick in range(CHUNK_TICKS):
            obs = step(runner, tick)
        seconds = time.process_time() - began
        assert np.abs(obs.qpos - start).max() > 0.1, "the robots did not move"
        return seconds / (CHUNK_TICKS * runner.substeps * num_envs)

    def measure():
        with (
            Runner(robot, num_envs, workers=0) as by_rates,
            Runner(robot, num_envs, workers=0, plan=plan) as by_plan,
        ):
            return [
                (seconds_per_env_step(by_plan, planned), seconds_per_env_step(by_rates, rated))
                for _ in range(rounds + 1)
            ][1:]

    measured = benchmark.pedantic(measure, rounds=1)
    report([ours for ours, _ in measured])
    ratio = statistics.median(theirs / ours for ours, theirs in measured)
    compare(f"mujoco, {num_envs} envs", "with a plan", "with rates", ratio, least=0.86)
