"""The same motion of 64 arms in SAPIEN and in MuJoCo: rates, and the largest difference."""

import time

import numpy as np

from batchpid.sim import Robot, Runner

NUM_ENVS, TICKS = 64, 50

robot = Robot.load("panda")
setpoints = np.tile(robot.target, (TICKS, NUM_ENVS, 1))
motions, rates = {}, {}
for engine in ("sapien", "mujoco"):
    with Runner(robot, NUM_ENVS, engine=engine, substeps=20) as runner:
        runner.reset()
        runner.step(robot.target)
        runner.reset()
        began = time.perf_counter()
        motions[engine] = runner.rollout(setpoints).qpos
        seconds = time.perf_counter() - began
        rates[engine] = NUM_ENVS * TICKS * 20 / seconds
        print(f"{engine}: {rates[engine]:,.0f} env-steps/s, {runner.backend}")
difference = np.abs(motions["mujoco"] - motions["sapien"]).max()
print(
    f"MuJoCo is {rates['mujoco'] / rates['sapien']:.1f} times as fast; the motions differ by at most"
    f" {difference:.1e} rad"
)
