"""Actuators in the loop: delivered and compensated as the models say."""

import dataclasses
import json

import numpy as np
import pytest
from identical import assert_identical

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Runner

N = 5


def commands(robot, ticks, seed=0):
    noise = np.random.default_rng(seed).uniform(-0.3, 0.3, (ticks, N, robot.dof))
    return np.clip(robot.settings.target + noise, robot.lower, robot.upper)


def test_the_effort_is_that_delivered(panda):
    """Late by the delay, times the strength, under control "effort"."""
    asked = np.zeros((6, 1, panda.dof))
    asked[3:, :, :7] = [4.0, 3, 3, 3, 1, 1, 1]
    chosen = bp.make_actuators(panda.dof, command_delay=0.0015, strength=0.5)
    with Runner(
        panda, 1, workers=0, control="effort", compensate="none", substeps=1, actuators=chosen
    ) as runner:
        effort = runner.rollout(np.concatenate((asked, asked[-1:]))).effort
    np.testing.assert_allclose(
        effort[3:], np.float32(0.5 * np.concatenate((asked, asked[-1:]))[:4])
    )


@pytest.mark.parametrize("control", ["pid", "effort"])
@pytest.mark.parametrize("strength", [0.5, 1.6])
def test_a_joint_is_saturated_exactly_where_its_motor_is(panda, strength, control):
    """The law is held back at the command that the motor clips, so that the whole limit is
    delivered, and no more.
    """
    limit, moving = 12.0, slice(0, 7)
    chosen = bp.make_actuators(panda.dof, strength=strength, bias=1.0, effort_limit=limit)
    swing = np.where(np.arange(120) % 60 < 30, 1.0, -1.0)[:, None, None]
    wanted = np.clip(panda.start + 0.8 * swing, panda.lower, panda.upper)
    asked = {"pid": wanted, "effort": 40 * swing * (np.arange(panda.dof) < 7)}[control]
    params = panda.params(anti_windup="back_calculation", effort_limit=200.0)
    options = {"control": control, "params": params, "actuators": chosen, "compensate": "none"}
    with Runner(panda, 1, workers=0, substeps=1, **options) as runner:
        rollout = runner.rollout(np.ascontiguousarray(np.broadcast_to(asked, (120, 1, panda.dof))))
    saturated, effort = rollout.saturated[..., moving], rollout.effort[..., moving]
    assert 0.05 < saturated.mean() <= 1.0
    np.testing.assert_array_equal(saturated, np.abs(effort) > limit * (1 - 1e-6))


def test_a_robot_has_the_actuators_of_its_file(panda, tmp_path):
    path = tmp_path / "arm.yaml"
    arm = {
        name: {"strength": 0.9, "command_delay": 0.001, "coulomb": 0.1}
        for name in panda.joint_names[:7]
    }
    path.write_text(json.dumps({"format": "batchpid-actuators-2", "joints": arm}))
    robot, table = Robot.load("panda", actuators=path), commands(panda, 3)
    assert robot.actuators.strength.tolist() == [[0.9] * 7 + [1.0] * 2]
    with Runner(robot, N, workers=0) as runner:
        assert runner.actuators.command_delay is not None
        by_default = runner.rollout(table)
    with Runner(robot, N, workers=0, actuators=robot.actuators) as runner:
        assert_identical(by_default, runner.rollout(table))
    with Runner(robot, 1, workers=0, control="drive") as runner:
        assert runner.actuators.command_delay is None
        assert runner.actuators.coulomb.max() == 0.1
    bp.save_actuators(path, bp.make_actuators(9, strength=np.full((2, 9), 0.5)), panda.joint_names)
    with pytest.raises(InvalidArgumentError, match="one row"):
        Robot.load("panda", actuators=path)


def test_the_controller_knows_the_actuators_of_its_robot(panda):
    """Their armature, damping and friction are compensated; actuators of the runner alone are
    not.
    """
    worn = bp.make_actuators(9, armature=0.2, viscous=3.0, coulomb=[1.0] * 7 + [0.0] * 2)
    known = dataclasses.replace(panda, actuators=worn)
    errors = []
    for robot, options in ((panda, {}), (known, {}), (panda, {"actuators": worn})):
        with Runner(
            robot, 1, workers=0, params=panda.designed().replace(ki=None), **options
        ) as runner:
            rollout = runner.rollout(np.tile(panda.settings.target, (60, 1)))
        errors.append(np.abs(rollout.qpos[:, 0, :7] - panda.settings.target[:7]).sum())
    ideal, compensated, uncompensated = errors
    assert compensated - ideal < 0.3 * (uncompensated - ideal)
