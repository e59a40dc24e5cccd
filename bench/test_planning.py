"""Plans by rollouts of 64 copies of one state: their rate, and the time that the slowest of a
hundred takes.
"""

import time

import numpy as np
import pytest

import batchpid as bp
from batchpid.sim import Robot, Runner

SAMPLES, TICKS, PLANS = 64, 30, 100
IMPLICIT = {
    "gain_units": "mass_matrix",
    "discretization": "implicit",
    "measurement_rate": "measured",
}
CASES = {
    # time step: sim steps in a tick of 0.01 s, options of the gains, least plans per second
    "1/2000 s": (1 / 2000, 20, {"gain_units": "mass_matrix", "measurement_rate": "measured"}, 12.0),
    "1/100 s, implicit": (1 / 100, 1, IMPLICIT, 125.0),
}


@pytest.mark.benchmark(group="plans of 64 rollouts of 0.3 s")
@pytest.mark.parametrize("case", CASES)
def test_plans(benchmark, most, case):
    timestep, substeps, gains, goal = CASES[case]
    robot, samples = Robot.load("panda"), int(min(SAMPLES, most.envs))
    options = {
        "params": bp.design_gains(robot, dt=timestep, **gains),
        "actuators": bp.make_actuators(robot.dof, command_delay=0.005),
        "engine": "mujoco",
        "timestep": timestep,
        "substeps": substeps,
    }
    noise = np.random.default_rng(0).uniform(-0.1, 0.1, (TICKS, samples, robot.dof))
    setpoints = np.clip(robot.target + noise.cumsum(axis=0), robot.lower, robot.upper)
    parts = {"snapshot": [], "restore": [], "rollout": []}
    with (
        Runner(robot, 1, workers=0, **options) as plant,
        Runner(robot, samples, workers=int(min(2, most.workers)), **options) as planner,
    ):

        def plan():
            began = time.perf_counter()
            snapshot = plant.snapshot().for_envs([0] * samples)
            copied = time.perf_counter()
            planner.restore(snapshot)
            restored = time.perf_counter()
            qpos = planner.rollout(setpoints).qpos
            ended = time.perf_counter()
            for times, seconds in zip(
                parts.values(), (copied - began, restored - copied, ended - restored), strict=True
            ):
                times.append(seconds)
            assert np.ptp(qpos, axis=0).max() > 0.05, "the robots did not move"
            plant.step(setpoints[0, 0])

        benchmark.pedantic(
            plan, rounds=int(min(PLANS, most.rounds)), warmup_rounds=int(min(5, most.rounds))
        )
    times = np.sum([*parts.values()], axis=0)
    benchmark.extra_info["plans per second"] = round(float(1 / np.median(times)), 1)
    benchmark.extra_info["goal"] = goal
    benchmark.extra_info["99th percentile, ms"] = round(1e3 * float(np.quantile(times, 0.99)), 2)
    for part, seconds in parts.items():
        benchmark.extra_info[f"{part}, ms"] = round(1e3 * float(np.median(seconds)), 2)
