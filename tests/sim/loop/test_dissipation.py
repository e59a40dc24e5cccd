"""Friction and damping in the URDF's units, against closed forms, with both solvers."""

import math

import numpy as np
import pytest
from tiny_urdf import joint, link, one_joint, robot, write

import batchpid as bp
from batchpid.sim import Randomization, Robot, Runner, Uniform

DT = 1 / 2000
PRESETS = ["accurate", "fast"]
FAR = '<limit lower="-1000" upper="1000" effort="1000" velocity="100"/>'


def inertial(inertia, mass=1.0, xyz="0 0 0"):
    tensor = f'<inertia ixx="{inertia}" ixy="0" ixz="0" iyy="{inertia}" iyz="0" izz="{inertia}"/>'
    return f'<inertial><origin xyz="{xyz}"/><mass value="{mass}"/>{tensor}</inertial>'


def dynamics(damping=0.0, friction=0.0, limit=FAR):
    return f'{limit}<dynamics damping="{damping}" friction="{friction}"/>'


def wheel(folder, inertia, damping=0.0, friction=0.0, **options):
    """One joint that no weight acts on."""
    text = one_joint(dynamics(damping, friction), arm=inertial(inertia))
    return Robot.load(write(folder, text), **options)


def pendulum(folder, joints, damping, friction, tip=0.2):
    """A chain of swinging links, lighter from joint to joint."""
    parts = [link("base")]
    for n in range(joints):
        parent, mass = f"link{n - 1}" if n else "base", tip ** (n / max(joints - 1, 1))
        parts.append(link(f"link{n}", inertial(0.01 * mass, mass, xyz="0 0 -0.2")))
        parts.append(
            joint(
                f"joint{n}",
                parent,
                f"link{n}",
                inner=dynamics(damping, friction),
                origin="0 0 -0.4",
            )
        )
    return Robot.load(write(folder, robot(*parts)))


def push(robot, efforts, seconds, physics="accurate", qvel=0.0, qpos=0.0, substeps=20, **options):
    """Apply constant efforts (envs,) to the first joint; return the trajectory of all joints
    (ticks, envs, dof).
    """
    efforts = np.atleast_1d(efforts)
    setpoint = np.zeros((len(efforts), robot.dof))
    setpoint[:, 0] = efforts
    options = {"engine": "sapien", "ground": False, "workers": 0} | options
    options = {"control": "effort", "compensate": "none"} | options
    with Runner(robot, len(efforts), physics=physics, substeps=substeps, **options) as runner:
        runner.reset(np.zeros_like(setpoint) + qpos, qvel=np.zeros_like(setpoint) + qvel)
        ticks = round(seconds / (substeps * DT))
        return runner.rollout(np.broadcast_to(setpoint, (ticks, *setpoint.shape)))


@pytest.mark.quick_rows(3)
@pytest.mark.parametrize("physics", PRESETS)
@pytest.mark.parametrize(("inertia", "friction"), [(0.1, 1.0), (10.0, 1.0), (1e-5, 0.1)])
def test_a_joint_sticks_below_its_friction_and_moves_above_it(physics, inertia, friction, tmp_path):
    seconds, efforts = 0.25, friction * np.array([0.95, -0.95, 0.0, 1.05, -1.2])
    if inertia < 1e-3:
        seconds = 0.01  # then it is at PhysX's largest joint speed
    rollout = push(
        wheel(tmp_path, inertia, friction=friction), efforts, seconds, physics, substeps=1
    )
    assert np.abs(rollout.qpos[:, :3]).max() < 1e-6
    acceleration = np.sign(efforts[3:]) * (np.abs(efforts[3:]) - friction) / inertia
    np.testing.assert_allclose(rollout.qvel[-1, 3:, 0], acceleration * seconds, rtol=0.01)
    np.testing.assert_allclose(rollout.effort[-1, :, 0], efforts, rtol=1e-6)  # the motor's alone


@pytest.mark.quick_rows(3)
@pytest.mark.parametrize("physics", PRESETS)
@pytest.mark.parametrize(("inertia", "friction"), [(0.1, 1.0), (0.02, 0.05), (1e-5, 0.1)])
def test_a_moving_joint_stops_when_the_equation_says(physics, inertia, friction, tmp_path):
    expected = inertia / friction
    rollout = push(
        wheel(tmp_path, inertia, friction=friction),
        0.0,
        1.2 * expected + 0.02,
        physics,
        1.0,
        substeps=1,
    )
    velocity, position = rollout.qvel[:, 0, 0], rollout.qpos[:, 0, 0]
    stop = np.flatnonzero(np.abs(velocity) > 1e-2)[-1] * DT if expected > DT else 0.0
    assert stop == pytest.approx(expected, rel=0.02, abs=2 * DT)
    assert position[-1] == pytest.approx(0.5 * expected, rel=0.02, abs=DT)
    assert np.abs(velocity[-10:]).max() < 2e-3


@pytest.mark.parametrize("physics", PRESETS)
def test_stick_slip_on_a_spring_has_the_analytic_period(physics, tmp_path):
    """Dragged by a spring k at speed V, a joint slips at V (1 - cos(w t)), w^2 = k / J, and stops
    once a period.
    """
    inertia, stiffness, speed, friction = 0.1, 40.0, 0.5, 1.0
    robot = wheel(tmp_path, inertia, friction=friction)
    params = robot.params(kp=stiffness, ki=0.0, kd=0.0)
    ticks = 2000
    target = (speed * DT * np.arange(ticks))[:, None, None]
    options = {"physics": physics, "substeps": 1, "compensate": "gravity+coriolis", "workers": 0}
    with Runner(robot, 1, params=params, **options) as runner:
        runner.reset(np.zeros(1))
        velocity = runner.rollout(target).qvel[:, 0, 0]
    first_slip = np.flatnonzero(np.abs(velocity) > 1e-3 * speed)[0] * DT
    assert first_slip == pytest.approx(friction / (stiffness * speed), rel=0.1)
    peaks = [
        n
        for n in range(1, ticks - 1)
        if velocity[n - 1] < velocity[n] >= velocity[n + 1] and velocity[n] > speed
    ]
    assert len(peaks) > 2
    assert np.diff(peaks) * DT == pytest.approx(
        2 * math.pi * math.sqrt(inertia / stiffness), rel=0.03
    )
    assert velocity[peaks] == pytest.approx(2 * speed, rel=0.03)


@pytest.mark.parametrize("physics", PRESETS)
@pytest.mark.parametrize("ratio", [0.01, 1.0, 20.0])
def test_damping_acts_as_the_equation_says_at_any_ratio_to_the_inertia(physics, ratio, tmp_path):
    inertia, effort = 0.01, 2.0
    damping = ratio * inertia / DT
    rollout = push(wheel(tmp_path, inertia, damping=damping), effort, 0.5, physics)
    time = rollout.time
    decay = np.exp(-damping / inertia * time)
    velocity = effort / damping * (1 - decay)
    position = effort / damping * (time - inertia / damping * (1 - decay))
    np.testing.assert_allclose(rollout.qvel[:, 0, 0], velocity, rtol=0.01)
    np.testing.assert_allclose(rollout.qpos[-1, 0, 0], position[-1], rtol=0.01)


@pytest.mark.parametrize("fixed_base", [True, False])
@pytest.mark.parametrize("gravity", ["none", "gravity+coriolis"])
def test_friction_beyond_all_efforts_keeps_the_pose(fixed_base, gravity, tmp_path):
    path = pendulum(tmp_path, 3, 0.1, 50.0).path
    robot, start = Robot.load(path, fixed_base=fixed_base), np.array([1.2, 0.4, -0.6])
    rollout = push(robot, [0.0, 30.0], 0.5, qpos=start, compensate=gravity)
    assert np.abs(rollout.qpos - start).max() < 1e-4
    assert rollout.ok.all()


@pytest.mark.parametrize(
    ("added", "speed"), [(0.0, 0.9 / 0.1 * 0.5), (0.4, 0.5 / 0.1 * 0.5), (2.0, 0.0)]
)
def test_friction_that_is_drawn_is_in_the_urdfs_units(added, speed, tmp_path):
    drawn = Randomization(friction=Uniform(added, added))
    rollout = push(wheel(tmp_path, 0.1, friction=0.1), 1.0, 0.5, randomization=drawn)
    np.testing.assert_allclose(rollout.qvel[-1, 0, 0], speed, rtol=1e-3)


def test_sapiens_own_dissipation_is_the_engines(tmp_path):
    robots = [wheel(tmp_path, 0.1, 0.5, friction, dissipation="sapien") for friction in (0.0, 1.0)]
    one, other = (push(robot, 2.0, 0.2).qvel for robot in robots)
    assert np.abs(one[-1]).max() > 0.1
    np.testing.assert_array_equal(one, other)


@pytest.mark.quick_rows(2)
@pytest.mark.parametrize("control", ["pid", "drive"])
@pytest.mark.parametrize("physics", PRESETS)
def test_known_friction_is_compensated_without_chatter(control, physics, tmp_path):
    robot = wheel(tmp_path, 0.1, friction=1.0)
    params = bp.design_gains(robot, 2.0).replace(effort_limit=20.0) if control == "pid" else None
    params = params or robot.params(kp=20.0, ki=0.0, kd=3.0, effort_limit=20.0)
    ends = {}
    for compensate in ("gravity+coriolis+friction", "gravity+coriolis"):
        options = {"compensate": compensate, "control": control, "physics": physics, "workers": 0}
        with Runner(robot, 1, params=params, **options) as runner:
            runner.reset(np.zeros(1))
            rollout = runner.rollout(np.full((200, 1, 1), 0.01))
        ends[compensate] = abs(rollout.qpos[-1, 0, 0] - 0.01)
        late = rollout.effort[150:, 0, 0]
        assert np.abs(np.diff(late)).sum() < 1.0
    assert ends["gravity+coriolis+friction"] < 2e-4
    if (control, physics) == ("drive", "fast"):  # without an integral the joint stays where it is
        assert ends["gravity+coriolis"] == pytest.approx(0.01, abs=1e-4)


@pytest.mark.parametrize("control", ["pid", "drive", "effort"])
def test_light_joints_neither_chatter_nor_diverge(control, tmp_path):
    robot = wheel(tmp_path, 1e-5, friction=0.1, damping=1e-4)
    gains = {} if control == "effort" else {"kp": 0.02, "ki": 0.0, "kd": 1e-3}
    filters = {} if control == "drive" else {"derivative_filter_time": 0.002}
    params = robot.params(**({"kp": 0.0} | gains | filters))
    with Runner(robot, 1, params=params, control=control, substeps=1, workers=0) as runner:
        runner.reset(np.zeros(1), qvel=np.full(1, 20.0))
        rollout = runner.rollout(np.zeros((800, 1, 1)) + (0.0 if control == "effort" else 0.3))
    assert rollout.ok.all()
    assert np.abs(rollout.qvel[700:]).max() < 0.05


@pytest.mark.parametrize("native", ["1", "0"])
def test_a_robot_that_moves_at_its_reset_slides_from_the_first_step(native, tmp_path, monkeypatch):
    monkeypatch.setenv("BATCHPID_NATIVE", native)
    inertia, coulomb, speed, seconds = 0.1, 0.5, 4.0, 0.15
    motors = bp.make_actuators(1, coulomb=coulomb, static=5 * coulomb)
    gone = push(
        wheel(tmp_path, inertia), 0.0, seconds, qvel=speed, engine="mujoco", actuators=motors
    ).qpos[-1, 0, 0]
    assert gone == pytest.approx(speed * seconds - 0.5 * coulomb / inertia * seconds**2, abs=1e-3)
