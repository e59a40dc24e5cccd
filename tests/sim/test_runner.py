"""Runner: its options, its params where none are given, and its repr."""

import numpy as np
import pytest
import tiny_urdf
from identical import are_same_params

from batchpid.sim import Robot, Runner


@pytest.fixture
def hinge(tmp_path):
    """A robot that is not bundled: one joint."""
    return Robot.load(tiny_urdf.write(tmp_path, tiny_urdf.one_joint()))


def test_a_bundled_robot_is_given_its_tuned_params(panda):
    with Runner(panda, 1, workers=0) as runner:
        assert are_same_params(runner.params, panda.tuned())


def test_another_robot_is_given_designed_params(hinge):
    with Runner(hinge, 1, workers=0) as runner:
        assert are_same_params(runner.params, hinge.designed())


def params_of(robot, control):
    with Runner(robot, 1, workers=0, control=control) as runner:
        return runner.params


def test_a_drive_is_given_the_bundled_gains_or_designed_ones(panda, hinge):
    bundled = params_of(panda, "drive")
    assert (bundled.kp == panda.settings.drive_stiffness).all()
    assert (bundled.kd == panda.settings.drive_damping).all()
    designed = hinge.designed("effort").replace(
        ki=0.0, setpoint_weight=None, derivative_filter_time=None
    )
    assert are_same_params(params_of(hinge, "drive"), designed)


@pytest.mark.parametrize("name", ["panda", "hinge"])
def test_control_by_effort_is_given_effort_limits(name, request):
    robot = request.getfixturevalue(name)
    params = params_of(robot, "effort")
    assert not params.kp.any()
    np.testing.assert_array_equal(params.effort_max, np.atleast_2d(robot.effort_limit))


def test_its_repr_has_robot_size_control_and_time(panda):
    with Runner(panda, 2, params=panda.params(), workers=0) as runner:
        runner.step(panda.start)
        expected = (
            f"Runner(panda, 2 envs, 0 workers, control 'pid', {runner.options.engine}, timestep"
            " 0.0005 s, 20 substeps, at 0.01 s)"
        )
        assert repr(runner) == expected
    assert "closed" in repr(runner)


@pytest.mark.parametrize(
    "progress", [lambda ticks: ticks[:2], lambda ticks: ticks[::-1], lambda ticks: [*ticks] * 2]
)
def test_every_tick_is_run_whatever_shows_the_progress(hinge, progress, monkeypatch):
    setpoints = np.linspace(0, 0.2, 5)[:, None]
    with Runner(hinge, 1, workers=0) as runner, Runner(hinge, 1, workers=0) as other:
        monkeypatch.setattr("batchpid.sim.runner.runner.CHECKPOINT_STEPS", 40)
        shown, plain = runner.rollout(setpoints, progress=progress), other.rollout(setpoints)
    np.testing.assert_allclose(shown.qpos, plain.qpos, atol=1e-5)
