"""What drives a view, without a browser: live robots under wishes, and recorded ones."""

import numpy as np
import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from sim import FaultWarning, Robot, Runner
from sim.view import Live, Playback
from sim.view.panel import short_names

STIFF = {"kp": 600.0, "ki": 900.0, "kd": 50.0, "derivative_filter_time": 2e-3, "setpoint_weight": 1.0}


@pytest.fixture
def live():
    live = Live(Robot.load("panda"), 3, workers=0, spread=0.05, physics="fast")
    for gain, value in STIFF.items():
        live.gains["pid"][gain][:] = value
    live._changed["pid"] = True
    yield live
    live.close()


def run(live, seconds):
    for _ in range(round(seconds / live.period)):
        live.advance()
    return live.frame()


def test_frames_are_the_runners(live):
    with Runner(live.robot, 3, workers=0, physics="fast", params=live._params("pid", None)) as runner:
        runner.reset(live.start)
        for _ in range(3):
            live.advance()
            obs = runner.step(live.setpoint, substeps=round(live.period * 2000))
    np.testing.assert_array_equal(live.frame().qpos, obs.qpos)
    np.testing.assert_array_equal(live.frame().effort, obs.effort.astype(float))
    assert live.frame().time == pytest.approx(3 * live.period)
    traces = live.traces(1, 3)
    assert len(traces.time) == 4
    assert traces.qpos[-1] == obs.qpos[1, 3]


def test_a_payload_is_held_by_the_motors_and_not_by_the_disturbance(live):
    live.go_to(live.robot.settings.target)
    free = run(live, 4.0)
    live.payload = 1.5
    held = run(live, 4.0)
    assert np.abs(held.qpos - free.qpos)[:, :7].max() < 5e-3  # the integral has taken it up
    poses = live.kinematics.poses(held.qpos)
    weight = live.kinematics.efforts_of_force(poses, live.load_link, [0, 0, -9.81 * 1.5])
    assert np.abs(weight).max() > 3
    np.testing.assert_allclose((held.effort - free.effort)[:, :7], -weight[:, :7], atol=0.15)
    live.payload = 0.0
    assert np.abs(run(live, 4.0).effort - free.effort)[:, :7].max() < 0.15


def test_what_the_motors_cannot_hold_they_do_not_hold(live):
    """Limits are the motors' own: a disturbance is neither clipped by them nor eats into them."""
    live.go_to(live.robot.settings.target)
    before = run(live, 3.0)
    for joint in range(7):
        live.tune("pid", "effort_limit", joint, 40.0)
    live.payload = 30.0
    after = run(live, 1.0)
    assert (np.abs(after.effort[:, :7]) <= 40.0 + 1e-4).all()
    assert np.abs(after.qpos - before.qpos)[:, :7].max() > 0.3
    assert after.saturated.all()


def test_a_push_moves_the_robots_and_passes(live):
    rest = run(live, 1.0)
    live.push((0.0, 80.0, 0.0))
    moved = run(live, 0.2)
    assert np.abs(moved.qpos - rest.qpos).max() > 0.01
    back = run(live, 3.0)
    assert np.abs(back.qpos - rest.qpos).max() < 5e-3


def test_setpoints_go_to_one_robot_or_to_all(live):
    live.go(2, 0.5)
    live.go(2, 0.7, env=1)
    assert live.setpoint[:, 2].tolist() == [0.5, 0.7, 0.5]
    live.go_anywhere()
    assert (live.setpoint >= live.robot.lower).all()
    assert (live.setpoint <= live.robot.upper).all()
    live.reset()
    assert live.time == 0.0
    np.testing.assert_allclose(live.frame().qpos, live.start, atol=1e-6)


def test_pid_and_drive_stand_side_by_side():
    live = Live(Robot.load("jaco2"), 2, controls=("pid", "drive"), workers=0, physics="fast")
    live.go_to(live.robot.settings.target)
    frame = run(live, 0.5)
    assert frame.qpos.shape == (4, 13)
    np.testing.assert_array_equal(frame.setpoint[0], frame.setpoint[2])
    assert np.abs(frame.qpos[:2] - frame.qpos[2:]).max() > 0.05
    live.tune("drive", "kp", 0, 60.0)
    live.push((5.0, 0.0, 0.0))
    run(live, 0.1)
    live.close()


def test_divergence_shows_and_a_reset_heals(live):
    for joint in range(9):
        live.tune("pid", "kd", joint, 5000.0)
        live.tune("pid", "derivative_filter_time", joint, 0.0)
        live.tune("pid", "effort_limit", joint, np.inf)
    live.go_to(live.robot.settings.target)
    with pytest.warns(FaultWarning):
        frame = run(live, 1.0)
    assert not frame.ok.all()
    assert np.isfinite(frame.qpos).all()
    assert np.isfinite(frame.effort).all()
    live.take_gains("pid", "designed")
    live.reset()
    assert run(live, 0.1).ok.all()


def test_any_urdf_gets_gains_of_its_inertia(tmp_path):
    path = tmp_path / "copy.urdf"
    path.write_text(Robot.load("panda").path.read_text())
    live = Live(Robot.load(path), 1, workers=0)
    pose = live.robot.start
    live.go_to(pose)
    assert np.abs(run(live, 1.0).qpos - pose)[:, :7].max() < 0.1
    live.close()


def test_sets_of_gains_are_the_designed_and_the_tutorials(live):
    assert live.gain_sets("pid") == ("designed", "tutorial")
    live.take_gains("pid", "tutorial")
    np.testing.assert_array_equal(live.gains["pid"]["kp"], live.robot.settings.kp)
    value, top = live.gain_range("pid", "kp", 0)
    assert value == 40.0
    assert top > 4 * value
    live.take_gains("pid", "designed")
    designed = bp.design_gains(live.robot)
    params = live._params("pid", None)
    np.testing.assert_allclose(params.kd, designed.kd)
    np.testing.assert_allclose(params.setpoint_weight, designed.setpoint_weight)
    assert params.weight_origin == designed.weight_origin
    live.go_to(live.robot.settings.target)
    assert np.abs(run(live, 2.5).qpos - live.robot.settings.target)[:, :7].max() < 0.02


def test_given_params_run_as_they_are_until_a_slider_moves():
    """Tuned ones too, which are per unit of the mass matrix."""
    robot = Robot.load("panda")
    live = Live(robot, 2, workers=0, physics="fast", params=robot.tuned())
    tuned = robot.tuned()
    assert live.gain_sets("pid") == ("given",)
    live.go_to(robot.settings.target)
    with Runner(robot, 2, workers=0, physics="fast", params=robot.tuned()) as runner:
        runner.reset(live.start)
        for _ in range(3):
            live.advance()
            obs = runner.step(live.setpoint, substeps=round(live.period * 2000))
    np.testing.assert_array_equal(live.frame().qpos, obs.qpos)
    np.testing.assert_array_equal(live._params("pid", None).kp, tuned.kp)
    kp = 1.05 * float(tuned.kp[0, 0])
    live.tune("pid", "kp", 0, kp)
    live.payload = 0.5
    run(live, 2.0)
    changed = live._runners[0].params
    assert changed.kp[0, 0] == kp
    assert type(changed.gain_units) is type(tuned.gain_units)
    assert np.abs(live.frame().qpos - robot.settings.target)[:, :7].max() < 0.05
    live.close()


def test_bad_wishes_are_named():
    robot = Robot.load("panda")
    for options, named in (
        ({"num_envs": 65}, "num_envs"),
        ({"num_envs": 40, "controls": ("pid", "drive")}, "num_envs"),
        ({"num_envs": 2, "controls": ("effort",)}, "controls"),
        ({"num_envs": 2, "period": 0.0}, "period"),
    ):
        with pytest.raises(InvalidArgumentError, match=named):
            Live(robot, workers=0, **options)


def test_a_rollout_plays_from_end_to_end_and_again():
    robot = Robot.load("panda")
    with Runner(robot, 2, workers=0) as runner:
        rollout = runner.rollout(np.broadcast_to(robot.settings.target, (30, robot.dof)))
    playback = Playback(robot, rollout)
    seen = [playback.frame()]
    while seen[-1].time < playback.duration - 1e-9:
        playback.advance()
        seen.append(playback.frame())
    np.testing.assert_array_equal(seen[0].qpos, rollout.qpos[0])
    np.testing.assert_array_equal(seen[-1].qpos, rollout.qpos[-1])
    assert len(seen) == pytest.approx(playback.duration / playback.period, abs=2)
    assert len(playback.traces(0, 0).time) == 30
    playback.advance()
    assert playback.frame().time == 0.0
    playback.seek(0.15)
    assert playback.frame().time == pytest.approx(0.15)
    with pytest.raises(InvalidArgumentError, match="joints"):
        Playback(Robot.load("jaco2"), rollout)


def test_names_lose_what_they_share():
    assert short_names(Robot.load("panda")) == (
        *(f"joint{k}" for k in range(1, 8)),
        "finger_joint1",
        "finger_joint2",
    )
    assert short_names(Robot.load("jaco2"))[6:8] == ("joint_7", "finger_1")
