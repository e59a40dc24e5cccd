"""LiveSimulation: setpoints and frames, without a browser."""

import numpy as np
import pytest
from identical import assert_identical

from batchpid.errors import InvalidArgumentError
from batchpid.sim import FaultWarning, Robot, Runner
from batchpid.sim.view import LiveSimulation


@pytest.fixture
def live(panda):
    live = LiveSimulation(panda, 3, workers=0, spread=0.05, physics="fast", params=panda.params())
    yield live
    live.close()


def run(live, frames):
    for _ in range(frames):
        live.advance()


def test_frames_equal_those_of_a_runner(live, panda):
    substeps = round(live.period * 2000)
    with Runner(panda, 3, workers=0, physics="fast", params=panda.params()) as runner:
        runner.reset(live.start)
        for _ in range(6):
            live.advance()
            observation = runner.step(live.setpoint, substeps=substeps)
    assert observation.effort.any()
    assert_identical(live.observation, observation)
    assert live.time == pytest.approx(6 * live.period)


def test_setpoints_are_set_for_one_joint_or_for_all(live):
    assert (live.setpoint == live.robot.target).all()
    live.set_setpoint(live.robot.start)
    live.set_setpoint(0.5, joint=2)
    expected = [*live.robot.start[:2], 0.5, *live.robot.start[3:]]
    assert live.setpoint.tolist() == [expected] * 3
    live.advance()
    live.reset()
    assert live.time == 0.0
    np.testing.assert_allclose(live.observation.qpos, live.start, atol=1e-6)


@pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning")
def test_a_robot_that_diverged_comes_back_with_a_reset(panda):
    params = panda.params(kd=5000.0, effort_limit=np.inf)
    live = LiveSimulation(panda, 3, workers=0, spread=0.0, physics="fast", params=params)
    with pytest.warns(FaultWarning):
        run(live, 12)
    assert not live.observation.ok.all()
    live.reset()
    assert live.observation.ok.all()
    live.close()


def test_a_robot_without_settings_gets_gains_that_hold_it(tmp_path, panda):
    path = tmp_path / "copy.urdf"
    path.write_text(panda.path.read_text())
    robot = Robot.load(path)
    live = LiveSimulation(robot, 1, workers=0)
    live.set_setpoint(robot.start)
    run(live, 30)
    assert np.abs(live.observation.qpos - robot.start)[:, :7].max() < 0.1
    live.close()


def test_bad_arguments_are_named(panda):
    for options, named in (
        ({"num_envs": 65}, "num_envs"),
        ({"num_envs": 2, "period": 0.0}, "period"),
    ):
        with pytest.raises(InvalidArgumentError, match=named):
            LiveSimulation(panda, workers=0, **options)
