"""Cost of all effects of motors and sensors together, for the 16 envs of a group."""

from __future__ import annotations

import numpy as np
import pytest

import batchpid as bp
from sim.loop.actuators import JointActuators

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
def test_all_effects(benchmark):
    qpos, qvel, effort = np.random.default_rng(0).uniform(0.1, 1.0, (3, ENVS, JOINTS))
    actuators = JointActuators(bp.make_actuators(JOINTS, **EFFECTS), qpos, 1 / 2000, 0)

    def run():
        for _ in range(STEPS):
            measured, _ = actuators.measure(qpos, qvel)
            delivered = actuators.deliver(effort, qpos, qvel)
        return measured, delivered

    measured, delivered = benchmark(run)
    assert not np.array_equal(measured, qpos)
    assert not np.array_equal(delivered, effort)
    if benchmark.stats is not None:
        benchmark.extra_info["us_per_env_step"] = 1e6 * benchmark.stats.stats.median / (STEPS * ENVS)
        print(f"\n{benchmark.extra_info['us_per_env_step']:.2f} us for an env step of {JOINTS} joints")
