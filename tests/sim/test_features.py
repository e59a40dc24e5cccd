"""Each feature of a robot with each control and engine: it reaches its goal, or is refused by
name.
"""

import functools
import itertools
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from c_programs import COMPILERS, TABLE, compiled
from featured import FEATURES, joints_of, poses, robot_with

import batchpid as bp
import batchpid.task_space as ts
from batchpid.errors import BatchPIDError
from batchpid.export import to_c
from batchpid.sim import OperationalSpace, Robot, Runner, write_recording
from batchpid.sim.identification import identify
from batchpid.sim.robot.mjcf_export import to_mjcf
from batchpid.sim.robot.urdf_export import to_urdf
from batchpid.trajectories import minimum_jerk

PAIRS = [
    pair
    for pair in itertools.combinations(FEATURES, 2)
    if not joints_of(pair[0]) & joints_of(pair[1])
]
CONTROLS = ["pid", "drive", "osc", "effort"]
REFUSED = {"floating base": {"osc"}}
"""Controls that refuse a feature; all others have to reach their goal."""


def reach(robot, control, engine):
    """Assert that the robot reaches its goal, within a turn of each continuous joint."""
    start, goal = poses(robot)
    options = {"control": control}
    setpoint, ticks, error = goal, 250, 0.02
    if control == "osc":
        options = {"control": OperationalSpace(robot, "l8", posture=goal)}
        setpoint = ts.link_poses(robot.kinematic_tree(), goal, ["l8"])[0]
    if control == "effort":
        # The law is outside of the runner, whose setpoints are its efforts.
        options["substeps"], ticks, error = 1, 3000, 0.03
        params = robot.designed("effort").replace(measurement_rate="difference")
        pid = bp.BatchPID(params, 1, 1 / 2000)
    with Runner(robot, 1, workers=0, engine=engine, ground=False, **options) as runner:
        seen = runner.reset(start)
        if control == "effort":
            for _ in range(ticks):
                seen = runner.step(pid(goal[None], seen.qpos.astype(float)))
            seen = seen.map(lambda rows: rows[None])
        else:
            seen = runner.rollout(np.tile(setpoint, (ticks, 1)))
    assert seen.ok.all()
    last = seen.qpos[-1, 0].astype(float)
    if control == "osc":
        pose = seen.tool_pose[-1, 0].astype(float)
        np.testing.assert_allclose(pose[:3], setpoint[:3], rtol=0, atol=2e-3)
        assert abs(pose[3:] @ setpoint[3:]) > 1 - 1e-6  # cosine of half the angle
    else:
        np.testing.assert_allclose(off(robot, last, goal), 0.0, atol=error)
    followers = robot.coupling.followers
    rates = robot.coupling.rates(seen.qvel[-20:])[..., followers]
    np.testing.assert_allclose(seen.qvel[-20:, :, followers], rates, atol=0.02)
    turning = robot.continuous[robot.coupling.leader] | robot.continuous
    still = [joint for joint in followers if not turning[joint]]
    np.testing.assert_allclose(last[still], robot.coupling.positions(last)[still], atol=1e-4)


def off(robot, qpos, goal):
    """Return the errors of the independent joints, within a turn of each continuous joint."""
    left = qpos - goal
    left = np.where(robot.continuous, left - 2 * np.pi * np.rint(left / (2 * np.pi)), left)
    return left[..., robot.independent]


def check(features, command, engine):
    refuses = any(command in REFUSED.get(feature, ()) for feature in features)
    try:
        reach(robot_with(*features), command, engine)
    except BatchPIDError:
        if not refuses:
            raise
    else:
        assert not refuses


def in_both_engines(*names):
    """Return rows of a parametrized test with an engine each: of the two rows of a case one is
    quick.
    """
    for number, name in enumerate(names):
        for engine in ("sapien", "mujoco"):
            is_quick = (number % 2 == 0) == (engine == "sapien")
            yield pytest.param(name, engine, marks=() if is_quick else pytest.mark.slow)


@pytest.mark.parametrize(
    ("case", "engine"), [*in_both_engines(*itertools.product(FEATURES, CONTROLS))], ids=str
)
def test_every_feature_reaches_its_goal_under_every_control_or_is_refused(case, engine):
    feature, command = case
    check((feature,), command, engine)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
@pytest.mark.parametrize(("features", "command"), list(itertools.product(PAIRS, CONTROLS)), ids=str)
def test_every_pair_of_features_reaches_its_goal_under_every_control_or_is_refused(
    features, command, engine
):
    check(features, command, engine)


@pytest.mark.parametrize("native", ["0", "1"])
@pytest.mark.parametrize(
    "feature", [feature for feature, given in FEATURES.items() if "mimics" in given]
)
def test_kinematics_and_dynamics_are_those_of_the_leaders(feature, native, monkeypatch):
    monkeypatch.setenv("BATCHPID_NATIVE", native)
    robot = robot_with(feature)
    tree, g, own = robot.kinematic_tree(), robot.coupling.matrix, robot.independent
    free = replace(tree, coupling=None)
    rng = np.random.default_rng(0)
    qpos = robot.coupling.positions(rng.normal(size=(5, robot.dof)))
    qvel, qacc = (robot.coupling.rates(rng.normal(size=(5, robot.dof))) for _ in range(2))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9)
    close(ts.jacobian(tree, qpos, "l8")[..., own], ts.jacobian(free, qpos, "l8") @ g)
    close(ts.mass_matrix(tree, qpos)[:, own][..., own], g.T @ ts.mass_matrix(free, qpos) @ g)
    close(ts.bias(tree, qpos, qvel)[:, own], ts.bias(free, qpos, qvel) @ g)
    effort = ts.inverse_dynamics(tree, qpos, qvel, qacc)
    close(effort[:, own], ts.inverse_dynamics(free, qpos, qvel, qacc) @ g)
    close(ts.forward_dynamics(tree, qpos, qvel, effort), qacc)
    for unused in (
        ts.jacobian(tree, qpos, "l8")[..., ~own],
        ts.bias(tree, qpos, qvel)[:, ~own],
        effort[:, ~own],
    ):
        assert not unused.any()
    goal = ts.link_poses(tree, qpos, ["l8"])[:, 0]
    found = ts.inverse_kinematics(tree, "l8", goal, robot.coupling.positions(qpos + 0.1))
    close(found.qpos, robot.coupling.positions(found.qpos))
    close(ts.link_poses(tree, found.qpos, ["l8"])[:, 0, :3], goal[:, :3], atol=2e-5)


@pytest.mark.parametrize(("feature", "engine"), [*in_both_engines(*FEATURES)])
def test_every_feature_is_followed_along_a_trajectory(feature, engine):
    robot = robot_with(feature)
    start, goal = poses(robot)
    move = minimum_jerk(start, goal, 0.01, duration=1.0)
    with Runner(robot, 1, workers=0, engine=engine, ground=False) as runner:
        runner.reset(start)
        seen = runner.rollout(move.position, setpoint_rates=move.velocity)
    most = 1e-3 if robot.fixed_base else 0.03  # a free base moves away
    assert np.abs(off(robot, seen.qpos[:, 0], move.position)).max() < most


@pytest.mark.parametrize("kind", ["urdf", "xml"])
@pytest.mark.parametrize("feature", FEATURES)
def test_every_feature_is_in_an_exported_description(feature, kind, tmp_path):
    """Read again, it is a robot with the same joints and dynamics."""
    robot, path = robot_with(feature, folder=tmp_path), tmp_path / f"featured.{kind}"
    exported = to_urdf(robot) if kind == "urdf" else to_mjcf(robot, None, 1 / 2000)
    path.write_text(exported.text)
    other = Robot.load(path, fixed_base=robot.fixed_base)
    assert other.joint_names == robot.joint_names
    assert (other.fixed_base, tuple(other.continuous)) == (
        robot.fixed_base,
        tuple(robot.continuous),
    )
    qpos = robot.coupling.positions(np.random.default_rng(0).normal(size=(4, robot.dof)))
    np.testing.assert_allclose(other.coupling.positions(qpos), qpos, atol=1e-6)
    np.testing.assert_allclose(
        other.mass_matrix(qpos), robot.mass_matrix(qpos), rtol=1e-5, atol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("feature", FEATURES)
def test_every_feature_is_identified_or_refused(feature, tmp_path):
    """The motors found explain the held-out part of a run ten times as well as ideal ones."""
    robot = robot_with(feature)
    start, _ = poses(robot)
    time = 0.01 * np.arange(300)[:, None]
    swing = 0.25 * np.sin(2 * np.pi * (0.5 + 0.13 * np.arange(robot.dof)) * time)
    params = robot.params(kp=200.0, ki=0.0, kd=20.0)
    motors = bp.make_actuators(robot.dof, armature=0.05, coulomb=1.0, viscous=2.0)
    with Runner(robot, 1, workers=0, ground=False, params=params, actuators=motors) as runner:
        runner.reset(start)
        run = runner.rollout(robot.coupling.positions(start + swing)[:, None])
    assert run.ok.all()
    path = write_recording(run, tmp_path / "run.h5")
    try:
        found = identify(robot, [path], params=params, evaluations=6)
    except BatchPIDError:
        if feature != "floating base":
            raise
        return
    before, after = found.held_out_error
    assert feature != "floating base"
    assert after < 0.1 * before


@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
@pytest.mark.parametrize("feature", FEATURES)
def test_every_feature_is_in_the_dynamics_of_the_c_header(feature, tmp_path):
    robot = robot_with(feature)
    n, rng = robot.dof, np.random.default_rng(0)
    qpos, qvel = robot.coupling.positions(rng.normal(size=(4, n))), rng.normal(size=(4, n))
    try:
        tree = robot.kinematic_tree()
        header = to_c(
            robot.params(kp=1.0), 1 / 2000, joint_names=robot.joint_names, prefix="arm", tree=tree
        )
    except BatchPIDError:
        if feature != "floating base":
            raise
        return
    assert feature != "floating base"
    (tmp_path / "arm.h").write_text(header.text)
    binary = compiled(tmp_path, TABLE.format(n=n, t="double"), "-std=c99", "-O1")
    ran = subprocess.run(
        [binary], input=np.hstack([qpos, qvel]).tobytes(), capture_output=True, check=True
    )
    found = np.frombuffer(ran.stdout).reshape(4, -1)
    expected = (
        ts.mass_matrix(tree, qpos).reshape(4, -1),
        ts.bias(tree, qpos, qvel),
        ts.bias(tree, qpos, 0 * qpos),
    )
    np.testing.assert_allclose(found, np.hstack(expected), rtol=1e-9, atol=1e-9)
