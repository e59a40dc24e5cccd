"""A slow policy on the fast law: what the robot makes of chunks of actions, by the way of executing
them.

A policy of 40 actions a second gives chunks of 20 rows, one every 0.2 s, 0.1 s late, each with an
error of up to 4 mrad and half anchored on the measured pose. ``python examples/slow_policy.py``
prints the table of docs/moving-setpoints.md, the worst of ten robots with random errors.
"""

from __future__ import annotations

import argparse

import numpy as np

import batchpid as bp
from batchpid.sim import Robot, Runner

PERIOD, ROWS, TICK = 1 / 40, 20, 0.005
EVERY, LATE = 40, 20  # ticks from chunk to chunk, and from observation to chunk
WAYS = {
    "held": {"blend": "newest", "interpolation": "hold"},
    "linear": {"blend": "newest", "interpolation": "linear"},
    "cubic": {"blend": "newest"},
    "cubic, aligned": {"blend": "align", "fade": 1.0},
}


def reference(robot: Robot, time: np.ndarray | float) -> np.ndarray:
    """Return the motion that the policy means (..., dof), from rest at ``robot.target``."""
    seconds = np.asarray(time, float)[..., None]
    seconds = seconds * seconds / (seconds + 0.7)
    joints = np.arange(robot.dof)
    slow = 0.25 * (np.sin(2.8 * seconds + joints) - np.sin(joints))
    fast = 0.06 * (np.sin(5.7 * seconds + 2 * joints) - np.sin(2 * joints))
    return robot.target + (joints < 7) * (slow + fast)


def execute(robot: Robot, engine: str, way: str, seconds: float, envs: int) -> list[float]:
    """Return error rms [mrad], acceleration [rad/s^2] and largest change of effort in a tick."""
    rng = np.random.default_rng(0)
    rows = PERIOD * np.arange(ROWS)
    fingers = list(range(7, robot.dof))
    plan = bp.make_plan(robot.dof, period=PERIOD, horizon=ROWS, latest=fingers, **WAYS[way])
    chunk = np.tile(reference(robot, rows), (envs, 1, 1))
    late, positions, efforts = 0.0, [], []
    with Runner(robot, envs, engine=engine, substeps=round(2000 * TICK), plan=plan) as runner:
        obs = runner.reset(robot.target)
        for tick in range(round(seconds / TICK)):
            time = TICK * tick
            if tick % EVERY == 0:
                error = rng.uniform(-0.004, 0.004, (envs, 1, robot.dof))
                error[..., 7:] = 0.0  # the fingers stay
                anchor = 0.5 * (obs.qpos - reference(robot, time))[:, None]
                made = reference(robot, time + rows) + error + anchor
            if tick % EVERY == LATE:
                chunk, late = made, LATE * TICK
            obs = runner.step(chunk, latency=late)
            chunk = None  # until the next one
            positions.append(obs.qpos)
            efforts.append(obs.effort)
    times = TICK * np.arange(1, len(positions) + 1)
    arm = np.array(positions)[200:, :, :7]
    error = arm - reference(robot, times)[200:, None, :7]
    acceleration = np.diff(arm, 2, axis=0) / TICK**2
    change = np.diff(np.array(efforts)[200:, :, :7], axis=0)
    return [
        1e3 * float(np.sqrt((error**2).mean((0, 2))).max()),
        float(np.abs(acceleration).max()),
        float(np.abs(change).max()),
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--engine", default="mujoco", choices=["mujoco", "sapien"])
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--num-envs", type=int, default=10)
    arguments = parser.parse_args()
    robot = Robot.load("panda")
    print("| executed as | error rms [mrad] | acceleration [rad/s^2] | change of effort [N m] |")
    print("| --- | --: | --: | --: |")
    for way in WAYS:
        figures = execute(robot, arguments.engine, way, arguments.seconds, arguments.num_envs)
        print(f"| {way} | {' | '.join(f'{figure:.1f}' for figure in figures)} |", flush=True)


if __name__ == "__main__":
    main()
