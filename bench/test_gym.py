"""Rate of the Gymnasium env over that of the plain Runner at the same substeps."""

import time

import numpy as np
import pytest

pytest.importorskip("gymnasium")

from sim.gym import ReachVectorEnv

NUM_ENVS, TICKS = 64, 12


def test_env_keeps_nine_tenths_of_the_runners_rate(benchmark):
    """64 pandas, 40 sim steps an action; blocks of both alternate, so that a busy machine slows them alike."""
    env = ReachVectorEnv(NUM_ENVS, max_episode_steps=None)
    first, _ = env.reset(seed=0)
    setpoint = first[:, : env.robot.dof].astype(float)  # the positions at the start
    action = np.clip(2 * (setpoint - env.low) / (env.high - env.low) - 1, -1, 1)
    ratios = []

    def both():
        with_env = elapsed(lambda: env.step(action))
        plain = elapsed(lambda: env.runner.step(setpoint))
        ratios.append(plain / with_env)

    benchmark.pedantic(both, rounds=5, warmup_rounds=1)
    obs = env.step(-action)[0]
    assert np.abs(obs[:, :9] - first[:, :9]).max() > 1e-3, "the robots did not move"
    env.close()
    benchmark.extra_info["share of the plain Runner's rate"] = round(float(np.median(ratios)), 3)
    assert np.median(ratios) > 0.9


def elapsed(call):
    began = time.perf_counter()
    for _ in range(TICKS):
        call()
    return time.perf_counter() - began
