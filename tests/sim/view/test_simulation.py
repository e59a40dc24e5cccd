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
    assert_identical(live.frame().observation.for_envs(0), observation)
    history = live.history()
    np.testing.assert_allclose(history.time, live.period * np.arange(7))
    np.testing.assert_array_equal(history.qpos[-1], observation.qpos)


def test_setpoints_are_set_for_one_joint_or_for_all(live):
    live.set_setpoint(0.5, joint=2)
    assert live.frame().setpoint[0, :, 2].tolist() == [0.5, 0.5, 0.5]
    live.randomize_setpoints()
    assert (live.setpoint >= live.robot.lower).all()
    assert (live.setpoint <= live.robot.upper).all()
    assert np.ptp(live.setpoint, axis=0).max() > 0.1
    live.advance()
    live.reset()
    assert live.history().time.tolist() == [0.0]
    np.testing.assert_allclose(live.frame().qpos[0], live.start, atol=1e-6)


@pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning")
def test_a_robot_that_diverged_comes_back_with_a_reset(panda):
    params = panda.params(kd=5000.0, effort_limit=np.inf)
    live = LiveSimulation(panda, 3, workers=0, spread=0.0, physics="fast", params=params)
    live.set_setpoint(panda.target)
    with pytest.warns(FaultWarning):
        run(live, 12)
    assert not live.frame().ok.all()
    live.reset()
    assert live.frame().ok.all()
    live.close()


def test_a_robot_without_settings_gets_gains_that_hold_it(tmp_path, panda):
    path = tmp_path / "copy.urdf"
    path.write_text(panda.path.read_text())
    robot = Robot.load(path)
    live = LiveSimulation(robot, 1, workers=0)
    run(live, 30)
    assert np.abs(live.frame().qpos[0] - robot.start)[:, :7].max() < 0.1
    live.close()


def test_bad_arguments_are_named(panda):
    for options, named in (
        ({"num_envs": 65}, "num_envs"),
        ({"num_envs": 2, "period": 0.0}, "period"),
    ):
        with pytest.raises(InvalidArgumentError, match=named):
            LiveSimulation(panda, workers=0, **options)
