"""Circle of 20 cm in 8 s that arms draw under control "osc" with default gains, without collision shapes.

    python bench/circles.py panda:panda_hand ur5.urdf z1.urdf:link06 [--engine sapien mujoco]

A robot without a LINK moves the one that the runner chooses: name one where that is a moving jaw. It begins at a pose
from which the whole circle is in reach. Prints, for each engine, the largest distance of the tool from the circle where
setpoints are poses alone, and from the setpoint where they have twist and acceleration, too, in the last 8 s of 10
[mm].
"""

from __future__ import annotations

import argparse
import importlib.util
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.sim import OperationalSpace, Robot, Runner
from batchpid.sim.options import RunnerOptions
from batchpid.sim.runner_keywords import EngineName

RADIUS, PERIOD, TICK = 0.1, 8.0, 1 / 100
POSES = 200
CLEARANCE, MOBILITY = 0.1, 0.05  # rad from the limits of joints; least eigenvalue of J M^-1 J^T


def circle(start: NDArray[Any], phase: NDArray[Any]) -> NDArray[Any]:
    """Return poses, twists and accelerations (n, 19) at ``phase`` (n,) of a circle that begins at ``start`` (7,)."""
    w, rows = 2 * np.pi / PERIOD, np.tile([*start, *np.zeros(12)], (len(phase), 1))
    across = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    along = np.stack([-np.sin(phase), np.cos(phase)], axis=1)
    rows[:, :2] += RADIUS * (across - [1, 0])
    rows[:, 7:9], rows[:, 13:15] = RADIUS * w * along, -RADIUS * w * w * across
    return rows


def start_of(tree: ts.RigidTree, link: str) -> NDArray[Any]:
    """Return joint positions from which the whole circle is in reach, away from limits and singular poses."""
    rng, chain = np.random.default_rng(0), tree.chain(link)
    for _ in range(POSES):
        start = qpos = rng.uniform(np.maximum(tree.lower, -2), np.minimum(tree.upper, 2))
        start[~chain] = np.clip(0.0, tree.lower, tree.upper)[~chain]
        pose, good = ts.link_poses(tree, start, [link])[0], True
        for goal in circle(pose, np.linspace(0, 2 * np.pi, 33))[:, :7]:
            found = ts.inverse_kinematics(tree, link, goal, qpos, starts=1, on_failure="return")
            near, qpos = np.abs(found.qpos[0] - qpos).max() < 0.5, found.qpos[0]
            j, mass = ts.jacobian(tree, qpos, link)[:, chain], ts.mass_matrix(tree, qpos)[np.ix_(chain, chain)]
            free = np.minimum(qpos - tree.lower, tree.upper - qpos)[chain].min() > CLEARANCE
            good = bool(near and free and found.success[0])
            if not good or np.linalg.eigvalsh(j @ np.linalg.solve(mass, j.T))[0] < MOBILITY or pose[2] < 0.15:
                good = False
                break
        if good:
            return start
    raise SystemExit(f"no pose of {link} has the circle in reach")


def measure(
    robot: Robot, link: str, engine: EngineName, **parts: bool
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the positions of the tool and of the circle (ticks, 3), and the center (3,)."""
    link = link or str(RunnerOptions(robot, 1, control="osc").tool)
    start = start_of(robot.kinematic_tree(), link)
    control = OperationalSpace(robot, link, posture=start, **parts)
    pose, ticks = np.array(control.command.neutral)[:7], round(1.25 * PERIOD / TICK)
    phase = 2 * np.pi / PERIOD * TICK * np.arange(1, ticks + 1)
    held = circle(pose, phase - np.pi / PERIOD * TICK)  # a setpoint is held for a tick: its middle
    with Runner(robot, 1, control=control, engine=engine, collisions=False, workers=0) as runner:
        runner.reset(start)
        seen = runner.rollout(held[:, : control.command.size])
    last = slice(ticks // 5, None)
    return seen.tool_pose[last, 0, :3], circle(pose, phase)[last, :3], pose[:3] - [RADIUS, 0, 0]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="+", metavar="ROBOT[:LINK]")
    installed = ["sapien", *(["mujoco"] if importlib.util.find_spec("mujoco") else [])]
    parser.add_argument("--engine", nargs="+", choices=installed, default=installed)
    given = parser.parse_args()
    for name in given.robots:
        file, _, link = name.partition(":")
        arm = Robot.load(file)
        for engine in given.engine:
            tool, _, center = measure(arm, link, engine)
            away = tool - center
            off = np.hypot(np.hypot(*away[:, :2].T) - RADIUS, away[:, 2]).max()
            tool, wanted, _ = measure(arm, link, engine, twist=True, acceleration=True)
            late = np.linalg.norm(tool - wanted, axis=1).max()
            found = f"from the circle {1e3 * off:.2f} mm; with twist and acceleration {1e3 * late:.2f} mm"
            print(f"{arm.name}, {engine}: {found}", flush=True)
