"""A robot's own gains and its description in a few words."""

import numpy as np
import pytest
from tiny_urdf import one_joint, write

from batchpid.errors import InvalidArgumentError
from sim import Robot, Runner


@pytest.mark.parametrize("units", ["mass_matrix", "inertia", "effort"])
def test_designed_gains_move_any_urdf_to_its_setpoint(units, tmp_path):
    robot = Robot.load(write(tmp_path, one_joint()))
    params = robot.designed(gain_units=units)
    np.testing.assert_array_equal(params.effort_max, np.broadcast_to(robot.effort_limit, params.effort_max.shape))
    with Runner(robot, 1, params=params, workers=0) as runner:
        for _ in range(200):
            obs = runner.step([0.5])
    np.testing.assert_allclose(obs.qpos, 0.5, atol=0.01)


def test_designed_gains_have_one_bandwidth_with_the_mass_matrix(panda):
    params = panda.designed()
    np.testing.assert_allclose(params.kp, (2 * np.pi * 1.7) ** 2)
    with pytest.raises(InvalidArgumentError, match=r"gain_units.*'mass'.*use one of"):
        panda.designed("mass")
