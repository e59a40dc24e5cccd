"""Designed gains of a robot, and its repr."""

import numpy as np
import pytest
from tiny_urdf import one_joint, write

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Runner


@pytest.mark.parametrize("units", ["mass_matrix", "effort"])
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


def test_the_repr_is_short_and_names_robot_joints_mass_and_file(panda, jaco2):
    for robot, dof, mass in ((panda, 9, "17.45 kg"), (jaco2, 13, "5.557 kg")):
        text = repr(robot)
        assert len(text.splitlines()) <= 3
        assert text.startswith(f"Robot({robot.name!r}, {dof} dof, {mass}, path=")
        assert robot.joint_names[0] in text
        assert str(robot.path) in text
