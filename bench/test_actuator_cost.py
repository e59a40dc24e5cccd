"""Cost of all the effects of motors and sensors together, for the 16 envs of a group."""

from __future__ import annotations

import numpy as np
import pytest

import batchpid as bp
from batchpid.motors import advance_effort, advance_measurement, command_limits, discretise
from batchpid.sim.loop.model_functions import NoiseBlocks

ENVS, JOINTS, STEPS = 16, 9, 512
EFFECTS = {
    "command_delay": 0.005,
    "sensor_delay": 0.003,
    "lag": 0.004,
    "strength": 0.9,
    "bias": 0.1,
    "saturation_effort": 80.0,
    "no_load_speed": 5.0,
    "effort_limit": 60.0,
    "backlash": 1e-3,
    "position_resolution": 1e-5,
    "velocity_resolution": 1e-3,
    "position_noise": 1e-5,
    "velocity_noise": 1e-3,
}


@pytest.mark.benchmark(group="actuators")
def test_all_effects(benchmark, most):
    qpos, qvel, effort = np.random.default_rng(0).uniform(0.1, 1.0, (3, ENVS, JOINTS))
    steps = int(min(STEPS, most.ticks))
    actuators = bp.make_actuators(JOINTS, **EFFECTS)
    start = bp.motors.init(actuators, qpos, 1 / 2000)
    k = discretise(actuators, start, 1 / 2000, ENVS)
    noise = NoiseBlocks()

    def run():
        state = start
        for _ in range(steps):
            state, measured, rate = advance_measurement(k, state, qpos, qvel, noise(k, state, qpos))
            limits = command_limits(k, measured, rate)
            state, delivered = advance_effort(k, state, effort, qpos, qvel)
        return measured, delivered, limits

    measured, delivered, (_, most) = benchmark.pedantic(run, rounds=100, warmup_rounds=1)
    assert (most < 70.0).all(), "the effort limit over the strength"
    assert not np.array_equal(measured, qpos)
    assert not np.array_equal(delivered, effort)
    benchmark.extra_info["us_per_env_step"] = 1e6 * benchmark.stats.stats.median / (steps * ENVS)
    print(f"\n{benchmark.extra_info['us_per_env_step']:.2f} us for an env step of {JOINTS} joints")
