"""Plan with the simulated robot: a panda reaches around a ball, by rollouts of 64 copies of its
present state.

    python examples/plan_reach.py [--no-motors] [--delay 0.03]    (needs SciPy)

Predictive sampling: every 50 ms, 64 splines of setpoints run for 0.3 s, and the robot follows the
best one. The copies have the delay of the robot's motors; with --no-motors they have ideal ones.
"""

import time

import numpy as np
import tyro
from scipy.interpolate import CubicSpline

import batchpid as bp
from batchpid import task_space as ts
from batchpid.sim import Robot, Runner

START = np.array([-0.7, 0.3, 0.0, -2.0, 0.0, 2.3, 0.8, 0.02, 0.02])
GOAL = np.array([0.7, *START[1:]])
BALL, RADIUS = np.array([0.56, -0.02, 0.38]), 0.12  # in the way of the hand [m]
LINKS = ["panda_link6", "panda_link7", "panda_hand", "panda_leftfinger"]
RADII = np.array([0.08, 0.07, 0.07, 0.03])  # of spheres around the links [m]
TICKS, EXECUTED = 30, 5  # ticks of 10 ms in a rollout, and until the next plan
KNOTS = np.array([0, 10, 20, 30])  # ticks
SPREAD = np.array([0.3, 0.3, 0.1, 0.3, 0.1, 0.1, 0.0, 0.0, 0.0])  # of the knots [rad, m]
MARGIN = 0.02  # desired distance from the ball [m]


def clearance(tree, qpos):
    """Return the least distance of the links to the ball [m]; negative where they touch."""
    places = ts.link_poses(tree, qpos, LINKS)[..., :3]
    return (np.linalg.norm(places - BALL, axis=-1) - RADII).min(-1) - RADIUS


class Planner:
    """Finds setpoints by rollouts; its first candidate is the rest of the last plan."""

    def __init__(self, robot, runner, motors):
        self.tree, self.runner, self.motors = robot.kinematic_tree(), runner, motors
        self.knots, self.samples = np.tile(START, (len(KNOTS), 1)), runner.num_envs
        self.lower, self.upper = robot.lower, robot.upper
        self.random = np.random.default_rng(0)

    def plan(self, plant):
        """Return the best setpoints from the present state of ``plant``, a runner of one env."""
        noise = self.random.normal(0.0, SPREAD, (self.samples, *self.knots.shape))
        noise *= np.linspace(0.0, 1.0, self.samples)[:, None, None]
        noise[:, 0] = 0.0
        knots = np.clip(self.knots + noise, self.lower, self.upper)
        setpoints = CubicSpline(KNOTS, knots, axis=1, bc_type="natural")(np.arange(1, TICKS + 1))
        setpoints = setpoints.clip(self.lower, self.upper).swapaxes(0, 1)  # (ticks, samples, dof)
        if self.motors:
            self.runner.restore(plant.snapshot().for_envs([0] * self.samples))
        else:
            now = plant.observe()
            self.runner.reset(now.qpos.clip(self.lower, self.upper), now.qvel)
        qpos = self.runner.rollout(setpoints).qpos
        away = np.linalg.norm(qpos - GOAL, axis=-1) + np.linalg.norm(setpoints - GOAL, axis=-1)
        near = np.maximum(MARGIN - clearance(self.tree, qpos), 0.0)
        best = (away + 100.0 * near).mean(0).argmin()
        self.knots = setpoints[np.minimum(KNOTS + EXECUTED, TICKS) - 1, best]
        return setpoints[:, best]


def main(
    motors: bool = True,
    delay: float = 0.005,
    samples: int = 64,
    seconds: float = 2.5,
    workers: int | None = None,
) -> None:
    """Let the robot reach for some seconds around the ball, and print how near it came to it.

    ``motors``: whether rollouts have the motors of the robot, with their ``delay`` [s].
    """
    robot = Robot.load("panda")
    gains = {"gain_units": "mass_matrix", "integral_time": np.inf, "measurement_rate": "measured"}
    params = bp.design_gains(robot, bandwidth_hz=5.0, **gains)
    actuators = bp.make_actuators(robot.dof, command_delay=delay)
    shared = {"params": params, "engine": "mujoco"}
    own = actuators if motors else None
    times, poses = [], []
    with (
        Runner(robot, samples, actuators=own, workers=workers, **shared) as runner,
        Runner(robot, 1, actuators=actuators, workers=0, **shared) as plant,
    ):
        planner = Planner(robot, runner, motors)
        plant.reset(START)
        for _ in range(round(seconds / 0.01 / EXECUTED)):
            began = time.perf_counter()
            setpoints = planner.plan(plant)
            times.append(time.perf_counter() - began)
            poses.append(plant.rollout(setpoints[:EXECUTED, None]).qpos)
    reach = np.concatenate(poses)
    least, left = clearance(planner.tree, reach).min(), np.abs(reach[-1] - GOAL).max()
    result = "touches the ball" if least < 0 else "goes around"
    print(f"{result}: least distance {1e3 * least:.0f} mm, {left:.2f} rad left at the end")
    print(f"{1 / np.median(times):.1f} plans/s")


if __name__ == "__main__":
    tyro.cli(main)
