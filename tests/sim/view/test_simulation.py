"""LiveSimulation: commands, disturbances and frames, without a browser."""

import numpy as np
import pytest
from identical import assert_identical

import batchpid.task_space as ts
from batchpid.errors import InvalidArgumentError
from batchpid.sim import FaultWarning, Robot, Runner
from batchpid.sim.view import LiveSimulation
from tests.sim.tiny_urdf import one_joint, write

STIFF = {"kp": 600.0, "ki": 900.0, "kd": 50.0, "derivative_filter_time": 2e-3}
"""Gains per effort that hold a panda under a payload."""


@pytest.fixture
def live(panda):
    live = LiveSimulation(panda, 3, workers=0, spread=0.05, physics="fast", params=panda.params(**STIFF))
    yield live
    live.close()


def run(live, seconds):
    """Advance, and return qpos and effort (robots, dof) at the end."""
    for _ in range(round(seconds / live.period)):
        live.advance()
    return live.frame().qpos[0], live.frame().effort[0]


def test_frames_equal_those_of_a_runner_before_and_after_a_gain_changes(live):
    substeps = round(live.period * 2000)
    with Runner(live.robot, 3, workers=0, physics="fast", params=live.gains["pid"].params) as runner:
        runner.reset(live.start)
        for kp in (600.0, 300.0):
            live.gains["pid"].set("kp", 0, kp)
            runner.params = live.gains["pid"].params
            for _ in range(3):
                live.advance()
                observation = runner.step(live.setpoint, substeps=substeps)
    assert observation.effort.any()
    assert_identical(live.frame().observation.for_envs(0), observation)
    assert live.time == live.frame().time[0] == pytest.approx(6 * live.period)
    history = live.history()
    assert history.time.shape == (7,)
    np.testing.assert_array_equal(history.qpos[-1], observation.qpos)


@pytest.mark.parametrize("params", [None, pytest.param("tuned", marks=pytest.mark.slow)])
def test_a_simulation_without_params_runs_the_tuned_ones_bit_identically(panda, params):
    given = None if params is None else panda.tuned()
    live = LiveSimulation(panda, 2, workers=0, physics="fast", params=given)
    live.set_setpoint(panda.settings.target)
    with Runner(panda, 2, workers=0, physics="fast", params=panda.tuned()) as runner:
        runner.reset(live.start)
        for _ in range(3):
            live.advance()
            observation = runner.step(live.setpoint, substeps=round(live.period * 2000))
    np.testing.assert_array_equal(live.frame().qpos[0], observation.qpos)
    live.payload = 0.5
    qpos, _ = run(live, 1.2)
    assert np.abs(qpos - panda.settings.target)[:, :7].max() < 0.05
    live.close()


@pytest.mark.slow
def test_gain_sets_in_other_units_are_applied_without_a_bump(panda):
    live = LiveSimulation(panda, 1, workers=0, spread=0.0, physics="fast")  # so that the setpoint weight has no effect
    live.payload = 1.0
    before, _ = run(live, 4.0)
    for name in ("tutorial", "designed"):
        live.gains["pid"].apply_set(name)
        qpos, _ = run(live, 0.2)
        assert np.abs(qpos - before)[:, :7].max() < 5e-3
    live.close()


@pytest.mark.slow
def test_the_motors_hold_a_payload(live):
    live.set_setpoint(live.robot.settings.target)
    free_qpos, free_effort = run(live, 4.0)
    live.payload = 1.5
    qpos, effort = run(live, 4.0)
    assert np.abs(qpos - free_qpos)[:, :7].max() < 5e-3  # the integral has taken it up
    weight = -9.81 * 1.5 * ts.jacobian(live.robot.rigid_tree, qpos, live.load_link)[:, 2]
    assert np.abs(weight).max() > 3
    np.testing.assert_allclose((effort - free_effort)[:, :7], -weight[:, :7], atol=0.15)
    live.payload = 0.0
    assert np.abs(run(live, 4.0)[1] - free_effort)[:, :7].max() < 0.15


@pytest.mark.slow
def test_effort_limits_bound_the_motors_and_not_the_payload(live):
    live.set_setpoint(live.robot.settings.target)
    before, _ = run(live, 3.0)
    for joint in range(7):
        live.gains["pid"].set("effort_limit", joint, 40.0)
    assert live.effort_limits(0, 3) == (-40.0, 40.0)
    live.payload = 30.0
    qpos, effort = run(live, 1.0)
    assert (np.abs(effort[:, :7]) <= 40.0 + 1e-4).all()
    assert np.abs(qpos - before)[:, :7].max() > 0.3
    assert live.frame().saturated[0].any(1).all()


@pytest.mark.slow
def test_a_push_moves_the_robots_and_ends(live):
    rest, _ = run(live, 1.0)
    live.push((0.0, 80.0, 0.0))
    moved, _ = run(live, 0.2)
    assert np.abs(moved - rest).max() > 0.01
    back, _ = run(live, 3.0)
    assert np.abs(back - rest).max() < 5e-3


def test_setpoints_are_set_for_one_robot_or_for_all(live):
    live.set_setpoint(0.5, joint=2)
    live.set_setpoint(0.7, joint=2, env=1)
    assert live.frame().setpoint[0, :, 2].tolist() == [0.5, 0.7, 0.5]
    live.randomize_setpoints()
    assert (live.setpoint >= live.robot.lower).all()
    assert (live.setpoint <= live.robot.upper).all()
    assert np.ptp(live.setpoint, axis=0).max() > 0.1
    run(live, 0.2)
    live.reset()
    assert live.time == 0.0
    assert len(live.history().time) == 1
    np.testing.assert_allclose(live.frame().qpos[0], live.start, atol=1e-6)


def test_pid_and_drive_run_in_two_groups_under_the_same_setpoints(jaco2):
    live = LiveSimulation(jaco2, 2, controls=("pid", "drive"), workers=0, physics="fast")
    live.set_setpoint(jaco2.settings.target)
    qpos, _ = run(live, 0.5)
    frame = live.frame()
    assert qpos.shape == (4, 13)
    np.testing.assert_array_equal(frame.setpoint[0, 0], frame.setpoint[0, 2])
    assert np.abs(qpos[:2] - qpos[2:]).max() > 0.05
    live.gains["drive"].set("kp", 0, 60.0)
    live.push((5.0, 0.0, 0.0))
    run(live, 0.1)
    live.close()


@pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning")
def test_a_diverged_robot_stays_finite_until_a_reset(live):
    for joint in range(9):
        live.gains["pid"].set("kd", joint, 5000.0)
        live.gains["pid"].set("derivative_filter_time", joint, 0.0)
        live.gains["pid"].set("effort_limit", joint, np.inf)
    live.set_setpoint(live.robot.settings.target)
    with pytest.warns(FaultWarning):
        qpos, effort = run(live, 0.4)
    assert not live.frame().ok.all()
    assert np.isfinite(qpos).all()
    assert np.isfinite(effort).all()
    live.gains["pid"].apply_set("given")
    live.reset()
    run(live, 0.1)
    assert live.frame().ok.all()


@pytest.mark.parametrize(
    ("control", "fixed_base"),
    [
        ("pid", True),
        ("drive", False),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in (("pid", False), ("drive", True))),
    ],
)
def test_a_robot_without_settings_gets_gains_that_hold_it(tmp_path, panda, control, fixed_base):
    path = tmp_path / "copy.urdf"
    path.write_text(panda.path.read_text())
    robot = type(panda).load(path, fixed_base=fixed_base)
    live = LiveSimulation(robot, 1, controls=(control,), workers=0)
    live.set_setpoint(robot.start)
    qpos, _ = run(live, 1.0)
    assert np.abs(qpos - robot.start)[:, :7].max() < (0.1 if fixed_base else 0.5)
    live.close()


def test_bad_arguments_are_named(panda):
    for options, named in (
        ({"num_envs": 65}, "num_envs"),
        ({"num_envs": 40, "controls": ("pid", "drive")}, "num_envs"),
        ({"num_envs": 2, "controls": ("effort",)}, "controls"),
        ({"num_envs": 2, "controls": ()}, "controls"),
        ({"num_envs": 2, "period": 0.0}, "period"),
    ):
        with pytest.raises(InvalidArgumentError, match=named):
            LiveSimulation(panda, workers=0, **options)


def test_a_drive_has_no_sliders_of_options_that_it_lacks(jaco2):
    live = LiveSimulation(jaco2, 1, controls=("drive",), workers=0, physics="fast")
    for gain in ("setpoint_weight", "derivative_filter_time"):
        with pytest.raises(InvalidArgumentError, match=gain):
            live.gains["drive"].set(gain, 0, 0.5)
    live.close()


def test_a_jump_of_a_joint_without_velocity_limit_is_a_step(tmp_path):
    robot = Robot.load(write(tmp_path, one_joint('<limit lower="-1" upper="1" effort="50" velocity="0"/>')))
    live = LiveSimulation(robot, 1, workers=0, spread=0.0)
    live.advance()
    live.set_setpoint([0.5])
    live.advance()
    with Runner(robot, 1, workers=0, params=live.gains["pid"].params) as runner:
        runner.reset(live.start)
        for setpoint in ([0.0], [0.5]):
            observation = runner.step(setpoint, substeps=round(live.period * 2000))
    assert np.isinf(robot.velocity_limit).all()
    np.testing.assert_array_equal(live.frame().qpos[0], observation.qpos)
    live.close()


def test_pid_and_drive_in_two_groups_follow_a_dragged_slider(jaco2):
    live = LiveSimulation(jaco2, 1, controls=("pid", "drive"), workers=0, spread=0.0, physics="fast")
    for _ in range(15):  # 0.5 rad/s
        live.set_setpoint(live.setpoint[0, 1] + 0.5 * live.period, joint=1)
        live.advance()
    behind = live.setpoint[0, 1] - live.frame().qpos[0, :, 1]
    with Runner(jaco2, 1, control="drive", workers=0, physics="fast", substeps=round(live.period * 2000)) as runner:
        runner.reset(live.start)
        steps = jaco2.start + np.eye(jaco2.dof)[1] * 0.5 * live.period * np.arange(1, 16)[:, None]
        without = runner.rollout(steps).qpos[-1, 0, 1]
    np.testing.assert_allclose(live.setpoint[0], steps[-1])
    assert np.abs(behind[0]) < 0.02
    assert behind[1] < steps[-1, 1] - without - 0.02
    live.close()


def test_a_dragged_slider_is_followed_at_once_and_a_jump_is_a_step(panda):
    live = LiveSimulation(panda, 1, workers=0, spread=0.0, physics="fast")
    for _ in range(15):  # 1 rad/s
        live.set_setpoint(live.setpoint[0, 0] + live.period, joint=0)
        live.advance()
    assert live.setpoint[0, 0] - live.frame().qpos[0, 0, 0] < 0.05
    live.reset()
    live.set_setpoint(panda.settings.target)
    live.advance()
    with Runner(panda, 1, workers=0, physics="fast", params=panda.tuned()) as runner:
        runner.reset(live.start)
        observation = runner.step(live.setpoint, substeps=round(live.period * 2000))
    np.testing.assert_array_equal(live.frame().qpos[0], observation.qpos)
    live.close()
