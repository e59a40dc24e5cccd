"""Ratio of the rates of the Gymnasium env and the plain Runner, with the same substeps."""

import time

import numpy as np
import pytest

pytest.importorskip("gymnasium")

from batchpid.sim.gym import ReachVectorEnv

NUM_ENVS, TICKS = 64, 12


def test_env_keeps_nine_tenths_of_the_runners_rate(benchmark, compare, most):
    """64 pandas, 40 sim steps per action. Blocks of both alternate, so that a busy machine slows
    both equally.
    """
    options = {} if most.workers else {"workers": 0}
    env = ReachVectorEnv(min(NUM_ENVS, most.envs), max_episode_steps=None, **options)
    first, _ = env.reset(seed=0)
    setpoint = first[:, : env.robot.dof].astype(float)  # the positions at the start
    action = np.clip(2 * (setpoint - env.low) / (env.high - env.low) - 1, -1, 1)
    ratios = []

    def both():
        with_env = elapsed(lambda: env.step(action), ticks)
        plain = elapsed(lambda: env.runner.step(setpoint), ticks)
        ratios.append(plain / with_env)

    ticks = min(TICKS, most.ticks)
    benchmark.pedantic(both, rounds=min(3, most.rounds), warmup_rounds=1)
    obs = env.step(-action)[0]
    assert np.abs(obs[:, :9] - first[:, :9]).max() > 1e-3, "the robots did not move"
    env.close()
    ratio = float(np.median(ratios))
    benchmark.extra_info["share of the plain Runner's rate"] = round(ratio, 3)
    compare("panda, 40 sim steps an action", "Gymnasium env", "plain Runner", ratio, least=0.9)


def elapsed(call, ticks):
    began = time.perf_counter()
    for _ in range(ticks):
        call()
    return time.perf_counter() - began
