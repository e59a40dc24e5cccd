"""Closed-form stability bound against the engine: gains at 0.8 of it are stable, at 1.5 of it they diverge."""

from __future__ import annotations

import numpy as np
import pytest
from robots import load_bundled

import batchpid as bp
from batchpid.sim import Runner

DT = 1 / 2000
DIVERGED = 50.0  # rad/s; PhysX stops joints at 100 rad/s


@pytest.mark.quick_rows(1)
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    ("name", "filter_time"),
    [
        ("panda", 5e-3),
        ("jaco2", 0.0),
        ("panda", 0.0),
        ("jaco2", 5e-3),
    ],
)
def test_the_engine_becomes_unstable_at_the_bound(name, filter_time):
    robot = load_bundled(name)
    rng = np.random.default_rng(1)
    num_envs = 4
    low, high = np.maximum(robot.lower, -3), np.minimum(robot.upper, 3)
    poses = low + (high - low) * rng.uniform(0.3, 0.7, (num_envs, robot.dof))
    mass = robot.mass_matrix(poses)
    inertia = np.diagonal(mass, axis1=1, axis2=2)
    kp, kd = 1600 * inertia, 80 * inertia
    bound = bp.stability_bound(mass, kp, kd, DT, filter_time=filter_time, damping=robot.damping)
    fastest = {}
    for factor in (0.8, 1.5):
        scale = (factor / bound.ratio)[:, None]
        params = bp.make_params(robot.dof, kp * scale, None, kd * scale, derivative_filter_time=filter_time)
        with Runner(robot, num_envs, params=params, workers=0, substeps=1, ground=False) as runner:
            runner.reset(poses)
            goal = poses + 1e-4 * rng.normal(size=poses.shape)
            rollout = runner.rollout(np.broadcast_to(goal, (400, *goal.shape)))
        fastest[factor] = np.nanmax(np.abs(np.where(rollout.ok[..., None], rollout.qvel, np.inf)), axis=(0, 2))
    assert (fastest[0.8] < DIVERGED / 5).all()
    assert (fastest[1.5] > DIVERGED).all()
