"""OperationalSpace in a Runner: circles, workers, engines, snapshots, faults, and the errors of its
arguments.
"""

import numpy as np
import pytest
from osc_arms import START, six
from robots import load_bundled

import batchpid.task_space as ts
from batchpid.errors import InvalidArgumentError, RobotError
from batchpid.native.array_program import SWITCH
from batchpid.sim import OperationalSpace, Robot, Runner
from batchpid.task_space.frames import about, compose

HAND = "panda_hand"
OPTIONS = {"workers": 0, "timestep": 1 / 500, "substeps": 5}


@pytest.fixture(scope="module")
def panda():
    return load_bundled("panda")


@pytest.fixture(scope="module")
def six_joints(tmp_path_factory):
    return six(tmp_path_factory.mktemp("arm"))


def pose_of(of, qpos, name):
    return ts.link_poses(of.kinematic_tree(), qpos, [name])[..., 0, :]


@pytest.mark.parametrize(
    ("name", "engine"),
    [
        ("panda", "sapien"),
        ("six_joints", "mujoco"),
    ],
)
def test_a_circle_is_followed_within_a_millimetre(name, engine, request):
    """5 cm of radius, once in 2 s; the orientation is held. Damping and friction of the joints are
    compensated.
    """
    of = request.getfixturevalue(name)
    tool, start = (
        (HAND, START) if name == "panda" else ("l6", np.array([0.3, 0.4, 0.9, 0.2, 0.7, 0.1]))
    )
    control = OperationalSpace(of, tool, twist=True, acceleration=True, stiffness=400.0)
    at, ticks, dt = pose_of(of, start, tool), 100, 1 / 100
    phase = np.pi * dt * np.arange(1, ticks + 1)
    setpoints = np.tile(np.concatenate([at, np.zeros(12)]), (ticks, 1))
    setpoints[:, 0] += 0.05 * (np.cos(phase) - 1)
    setpoints[:, 1] += 0.05 * np.sin(phase)
    setpoints[:, 7:9] = 0.05 * np.pi * np.stack([-np.sin(phase), np.cos(phase)], axis=-1)
    setpoints[:, 13:15] = -0.05 * np.pi**2 * np.stack([np.cos(phase), np.sin(phase)], axis=-1)
    with Runner(
        of, 1, control=control, engine=engine, workers=0, timestep=1 / 1000, substeps=10
    ) as runner:
        assert runner.command.labels[7::6] == ("vx [m/s]", "ax [m/s^2]")
        runner.reset(start)
        rollout = runner.rollout(setpoints)
    assert rollout.ok.all()
    found = pose_of(of, rollout.qpos, tool)[30:]
    circle = (
        at[:3] + 0.05 * np.stack([np.cos(phase) - 1, np.sin(phase), 0 * phase], axis=-1)[30:, None]
    )
    assert np.linalg.norm(found[..., :3] - circle, axis=-1).max() < 1e-3
    assert np.abs((found[..., 3:] * at[3:]).sum(-1)).min() > 1 - 1e-5


@pytest.mark.parametrize(
    ("discretization", "backend", "native"),
    [
        ("explicit", "numpy", "1"),
        ("explicit", "numpy", "0"),
        ("implicit", "numpy", "1"),
        ("implicit", "numpy", "0"),
        ("implicit", "jax", "1"),
        pytest.param("explicit", "jax", "1", marks=pytest.mark.slow),
    ],
)
def test_a_pose_moves_with_its_twist_within_a_tick(
    panda, discretization, backend, native, monkeypatch
):
    """A tick of many sim steps under a constant acceleration is many ticks of one sim step."""
    if backend == "jax":
        pytest.importorskip("jax")
    monkeypatch.setenv(SWITCH, native)
    options = {"twist": True, "acceleration": True, "discretization": discretization}
    control = OperationalSpace(panda, HAND, **options)
    dt, substeps, twist = 1 / 500, 20, np.array([0.1, -0.2, 0.1, 0.48, 0.0, 0.64])
    acceleration = np.array([4.0, 0.0, -4.0, 0.0, 0.0, 0.0])
    start = pose_of(panda, panda.start, HAND)
    time = dt * np.arange(1, substeps + 1)[:, None]
    places = start[:3] + (time * twist + time**2 / 2 * acceleration)[:, :3]
    # The axis is constant: 0.8 rad/s about (0.6, 0, 0.8).
    turned = compose(about(np.array([0.6, 0.0, 0.8]), 0.8 * time[:, 0]), start[3:])
    rates = [twist + time * acceleration, 0 * time + acceleration]
    setpoints = np.hstack([places, turned, *rates])
    ends = []
    for steps, rows in ((1, setpoints), (substeps, setpoints[-1:])):
        with Runner(
            panda, 1, control=control, backend=backend, workers=0, timestep=dt, substeps=steps
        ) as runner:
            runner.reset(panda.start)
            rollout = runner.rollout(rows)
        assert rollout.ok.all()
        ends.append(rollout.qpos[-1, 0])
    assert np.abs(ends[0] - panda.start).max() > 1e-3
    np.testing.assert_allclose(*ends, atol=2e-6)


def test_quaternions_have_any_length_but_zero_and_fingers_their_setpoint(panda):
    control = OperationalSpace(panda, HAND, joints=["panda_finger_joint2"], posture_stiffness=400.0)
    assert control.command.labels[7:] == ("panda_finger_joint2 [m]",)
    goals = np.tile([*pose_of(panda, START, HAND), 0.035], (4, 1))
    goals[:, 1] += 0.02
    goals[1, 3:7] *= -50.0
    goals[2, 3:7] = 0.0
    with Runner(panda, 4, control=control, **OPTIONS) as runner:
        runner.reset(START)
        with pytest.warns(UserWarning, match="env 2"):
            rollout = runner.rollout(np.broadcast_to(goals, (60, 4, 8)))
    np.testing.assert_array_equal(rollout.ok[-1], [True, True, False, True])
    np.testing.assert_array_equal(rollout.qpos[:, 0], rollout.qpos[:, 3])
    np.testing.assert_allclose(rollout.qpos[:, 1], rollout.qpos[:, 0], atol=1e-6)
    np.testing.assert_allclose(rollout.qpos[-1, 0, 7:], [panda.start[7], 0.035], atol=1e-3)


def test_a_tool_has_a_point_and_the_neutral_setpoint_is_its_pose(panda):
    point = [0.0, 0.0, 0.1]
    control = OperationalSpace(panda, HAND, point=point, posture=START)
    tree = panda.kinematic_tree()
    pose = ts.task_dynamics(tree, START[None], 0 * START[None], HAND, point=point).pose[0]
    np.testing.assert_array_equal(control.command.neutral, pose)
    state = control.init(panda, 1, 1 / 2000)
    _, effort = control(state, pose[None], START[None], np.zeros((1, 9)), np.ones((1, 9)))
    np.testing.assert_allclose(effort, 1.0, atol=1e-9)


@pytest.mark.parametrize(
    ("argument", "options"),
    [
        ("link", {"link": "panda_hnd"}),
        ("joints", {"joints": ["panda_joint1"]}),  # the pose of the hand controls it
        ("joints", {"joints": ["finger"]}),
        ("stiffness", {"stiffness": np.ones((3, 6))}),
        ("point", {"point": [1.0, 2.0]}),
        ("posture", {"posture": np.full(9, np.nan)}),
        ("stifness", {"stifness": 1.0}),
    ],
)
def test_arguments_are_checked(panda, argument, options):
    with pytest.raises(InvalidArgumentError) as caught:
        OperationalSpace(panda, **{"link": HAND} | options)
    assert caught.value.argument == argument


def test_gains_that_the_time_step_makes_unstable_are_refused_unless_implicit(panda):
    options = {"workers": 0, "timestep": 1 / 100}
    message = r"^stiffness, entry 'x': is unstable at a time step of 0.01 s .*implicit"
    with pytest.raises(InvalidArgumentError, match=message):
        Runner(panda, 1, control=OperationalSpace(panda, HAND, stiffness=1e4), **options)
    control = OperationalSpace(panda, HAND, stiffness=1e4, discretization="implicit")
    Runner(panda, 1, control=control, **options).close()
    Runner(panda, 1, control="osc", **options).close()


def test_the_robot_is_that_of_the_runner(panda, six_joints):
    with pytest.raises(InvalidArgumentError, match="make it for the robot of the runner"):
        Runner(panda, 1, control=OperationalSpace(six_joints, "l6"), **OPTIONS)


def test_control_osc_is_a_controller_of_a_link(panda):
    goal = np.add(pose_of(panda, START, HAND), [0.05, 0, -0.05, 0, 0, 0, 0])
    runs = []
    for options in ({"control": "osc", "tool": HAND}, {"control": OperationalSpace(panda, HAND)}):
        with Runner(panda, 2, **options, **OPTIONS) as runner:
            runner.reset(START)
            runs.append(runner.rollout(np.broadcast_to(goal, (20, 7))).qpos)
    np.testing.assert_array_equal(*runs)
    assert np.abs(runs[0] - START).max() > 0.01
    with Runner(panda, 1, control="osc", workers=0) as runner:  # the hand, and not a finger
        np.testing.assert_allclose(runner.command.neutral, pose_of(panda, panda.start, HAND))


def test_the_pose_of_the_tool_is_observed(panda):
    control, point = OperationalSpace(panda, HAND, point=[0, 0, 0.1]), [0.0, 0.0, 0.1]
    goals = np.broadcast_to(
        np.multiply(control.command.neutral, [1, 1, 1, -1, -1, -1, -1]), (6, 2, 7)
    )
    with Runner(panda, 2, control=control, **OPTIONS) as runner:
        first = runner.reset()
        rollout = runner.rollout(goals)
        last = runner.step(goals[0])
    for seen in (first, last, rollout):
        wanted = ts.link_poses(panda.kinematic_tree(), seen.qpos, [HAND], point=point)[..., 0, :]
        np.testing.assert_array_equal(seen.tool_pose, wanted.astype(np.float32))
    assert rollout.info.tool == HAND
    assert rollout.info.units_of("tool_pose") == ("m",) * 3 + ("",) * 4
    assert rollout.for_envs([1]).for_ticks(0, 2).tool_pose.shape == (2, 1, 7)
    with Runner(panda, 1, **OPTIONS) as runner:
        assert runner.reset().tool_pose is None


def test_a_floating_base_is_refused():
    message = r"fixed base; load .* with fixed_base=True, or control its joints"
    with pytest.raises(RobotError, match=message):
        OperationalSpace(Robot.load("panda", fixed_base=False), HAND)


@pytest.mark.parametrize("native", ["0", "1"])
@pytest.mark.parametrize("backend", ["numpy", pytest.param("jax", marks=pytest.mark.slow)])
def test_joints_with_limited_efforts_are_reported(panda, native, backend, monkeypatch):
    """The law scales its efforts to the limits, so that the runner has nothing to clip."""
    if backend == "jax":
        pytest.importorskip("jax")
    monkeypatch.setenv(SWITCH, native)
    control = OperationalSpace(panda, HAND, effort_limit=np.where(np.arange(9) < 7, 30.0, 100.0))
    goals = np.tile(control.command.neutral, (4, 2, 1))
    goals[:, 1, 2] += 0.3
    with Runner(
        panda, 2, control=control, compensate="gravity", backend=backend, **OPTIONS
    ) as runner:
        rollout = runner.rollout(goals)
    assert not rollout.saturated[:, 0].any()
    assert rollout.saturated[0, 1, :7].any()
    assert not rollout.saturated[0, 1, 7:].any()
