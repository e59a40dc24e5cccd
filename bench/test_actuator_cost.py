"""Cost of the effects of motors and sensors: of all together, and of those that are off, for the 16
envs of a group.
"""

from __future__ import annotations

import statistics
import time
from contextlib import ExitStack

import numpy as np
import pytest
from workload import Workload

import batchpid as bp
from batchpid.motors import advance_effort, advance_measurement, command_limits, discretise
from batchpid.sim import Robot
from batchpid.sim.loop.model_functions import NoiseBlocks

ENVS, JOINTS, STEPS, TICKS = 16, 9, 512, 10
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
    num_envs, rounds = min(ENVS, most.envs), min(rounds, most.rounds)
    workload = Workload(Robot.load("panda"), num_envs, workers=0, physics=physics, ticks=TICKS)
    setpoints = np.broadcast_to(workload.target, (workload.ticks, num_envs, len(workload.target)))
    rng, seconds = np.random.default_rng(0), []
    with ExitStack() as stack:
        chosen = {name: bp.make_actuators(JOINTS, **options) for name, options in CASES.items()}
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
