"""Stability bound against the engine: in closed form, and within 5 % for motors that are late."""

from dataclasses import replace

import numpy as np
import pytest
from robots import load_bundled

import batchpid as bp
from batchpid.sim import Runner
from batchpid.sim.diagnosis.loop_stability import stability_report

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
        params = bp.make_params(
            robot.dof, kp * scale, None, kd * scale, derivative_filter_time=filter_time
        )
        with Runner(robot, num_envs, params=params, workers=0, substeps=1, ground=False) as runner:
            runner.reset(poses)
            goal = poses + 1e-4 * rng.normal(size=poses.shape)
            rollout = runner.rollout(np.broadcast_to(goal, (400, *goal.shape)))
        fastest[factor] = np.nanmax(
            np.abs(np.where(rollout.ok[..., None], rollout.qvel, np.inf)), axis=(0, 2)
        )
    assert (fastest[0.8] < DIVERGED / 5).all()
    assert (fastest[1.5] > DIVERGED).all()


LATE = {
    "a delay": {"command_delay": 0.005},
    "a short delay and a sensor": {"command_delay": 0.0012, "sensor_delay": 0.0021},
    "a lag": {"command_delay": 0.001, "lag": 0.004, "strength": 0.8},
    "armature": {"command_delay": 0.003, "armature": 0.05, "viscous": 0.2},
}


@pytest.mark.quick_rows(2)
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    ("units", "late", "name"),
    [
        ("mass_matrix", "a delay", "panda"),
        ("effort", "a short delay and a sensor", "panda"),
        ("mass_matrix", "armature", "panda"),
        ("effort", "a lag", "panda"),
        ("effort", "a delay", "jaco2"),
    ],
)
def test_the_bound_of_late_motors_predicts_the_first_unstable_gain(units, late, name):
    """With 0.95 of the gains at the bound a disturbance decays, with 1.05 it grows."""
    robot = load_bundled(name)
    motors = bp.make_actuators(robot.dof, **LATE[late])
    known = replace(robot, actuators=bp.make_actuators(robot.dof, armature=0.03))
    # A joint at its limit would be held by it: panda's start is 0.2 mrad away from one.
    inside = np.minimum(0.05, (robot.upper - robot.lower) / 4)
    pose = np.clip(robot.start, robot.lower + inside, robot.upper - inside)
    unit = np.diagonal(robot.mass_matrix(pose)[0]) if units == "effort" else np.ones(robot.dof)
    gains = {
        "kp": 900 * unit,
        "kd": 60 * unit,
        "ki": None,
        "derivative_filter_time": 2e-3,
        "gain_units": units,
    }
    params = known.params(**gains, effort_limit=None)
    ratio, shares = stability_report(known, params, pose, DT, actuators=motors)[:2]
    assert ratio > 1.2 * stability_report(known, params, pose, DT, actuators=motors.joint_side())[0]
    # Slow motions of other joints say nothing of the mode at the bound.
    joint = int(np.argmax(shares))
    grows = {}
    for share in (0.95, 1.05):
        scaled = params.replace(kp=params.kp * share / ratio, kd=params.kd * share / ratio)
        options = {"workers": 0, "substeps": 1, "ground": False, "collisions": False}
        with Runner(known, 1, params=scaled, actuators=motors, **options) as runner:
            runner.reset(pose)
            goal = pose + 1e-3 * np.random.default_rng(1).normal(size=pose.shape)
            rollout = runner.rollout(np.broadcast_to(goal, (1600, 1, robot.dof)))
        speed = np.abs(rollout.qvel[:, 0, joint])
        grows[share] = np.nanmax(speed[1200:]) / speed[400:800].max()
    assert grows[0.95] < 1
    assert grows[1.05] > 1
