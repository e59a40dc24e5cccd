"""Confidence region of an actuators file: drawn motors, and gains that hold for all of them."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.identification import Region, draw_motors, read_region
from batchpid.sim.tuning import random_moves
from batchpid.sim.tuning.evaluation import within
from tests.sim.tuning.identification.test_identify import ARM


@pytest.fixture
def robot(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM.replace("</joint>", '<dynamics friction="0.1"/></joint>'))
    return Robot.load(tmp_path / "arm.urdf")


def region(spread=1.0):
    names = (("strength", "shoulder"), ("armature", "shoulder"), ("friction", "elbow"), ("delay", None))
    correlation = np.eye(4)
    correlation[0, 1] = correlation[1, 0] = 0.99
    deviation = spread * np.array([0.05, 0.005, 0.02, 5e-4])
    return Region(names, np.array([0.9, 0.05, 0.2, 4e-3]), deviation, correlation)


def saved(path, robot, known):
    motors = bp.make_actuators(2, command_delay=4e-3, strength=[0.9, 1.0], position_resolution=1e-5)
    bp.save_actuators(path, motors, robot.joint_names, {"confidence_region": known})
    return path


def test_draws_have_the_deviations_and_correlations_of_the_file(robot, tmp_path):
    path = saved(tmp_path / "motors.yaml", robot, region().to_dict())
    drawn = draw_motors(path, robot, 2000, seed=3)
    assert drawn.points.mean(0) == pytest.approx(region().estimate, rel=0.03)
    assert drawn.points.std(0) == pytest.approx(region().deviation, rel=0.15)
    assert np.corrcoef(drawn.points[:, :2].T)[0, 1] > 0.98
    motors = drawn.actuators
    assert motors.num_envs == 2000
    np.testing.assert_array_equal(motors.strength[:, 0], drawn.points[:, 0])
    np.testing.assert_array_equal(motors.strength[:, 1], 1.0)  # not in the region: as in the file
    np.testing.assert_array_equal(motors.command_delay, np.repeat(drawn.points[:, 3:], 2, 1))
    np.testing.assert_allclose(motors.coulomb[:, 1], np.maximum(drawn.points[:, 2] - 0.1, 0))
    np.testing.assert_array_equal(motors.position_resolution, 1e-5)  # other effects are kept
    np.testing.assert_array_equal(draw_motors(path, robot, 2000, seed=3).points, drawn.points)


def test_all_draws_are_within_the_ellipsoid():
    known = region()
    points, _ = known.draw(5000, 0)
    z = np.linalg.solve(np.linalg.cholesky(known.correlation), ((points - known.estimate) / known.deviation).T)
    assert 8.5 < (z**2).sum(0).max() <= 9.6  # the 95 % quantile of chi^2 with four degrees of freedom is 9.49


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda known: None, "is missing"),
        (lambda known: known | {"correlation": [[1], [2, 1]]}, "wrong shapes, numbers"),
        (lambda known: known | {"correlation": known["correlation"][:-1]}, "wrong shapes, numbers"),
        (lambda known: known | {"estimate": [1.0]}, "wrong shapes, numbers"),
        (lambda known: known | {"unknowns": [["strength", "knee"], *known["unknowns"][1:]]}, "of other joints: knee"),
        (lambda known: known | {"unknowns": [["colour"], *known["unknowns"][1:]]}, "wrong shapes, numbers or unknowns"),
        (lambda known: known | {"unknowns": [[*known["unknowns"][0], "elbow"], *known["unknowns"][1:]]}, "or unknowns"),
        (lambda known: {"unknowns": known["unknowns"]}, "cannot be read"),
    ],
)
def test_a_file_without_a_region_is_refused(robot, tmp_path, change, problem):
    path = saved(tmp_path / "motors.yaml", robot, region().to_dict())
    document = yaml.safe_load(path.read_text())
    document["about"] = {"confidence_region": change(document["about"]["confidence_region"])}
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(InvalidArgumentError, match=problem):
        read_region(path, robot)


def test_what_holds_for_all_draws(robot, tmp_path):
    """Slow gains hold; gains beyond the bound of the latest motor do not, and that draw is named."""
    drawn = draw_motors(saved(tmp_path / "motors.yaml", robot, region().to_dict()), robot, 6)
    moves, options = random_moves(robot, 1, 0), {"workers": 0, "engine": "mujoco", "ground": False}
    good = bp.design_gains(robot, 3.0, gain_units="mass_matrix", measurement_rate="measured")
    found = within(robot, good, drawn.actuators, moves, **options)
    assert found.holds
    assert found.settling.shape == (6,)
    assert "delay" in drawn.describe(found.stability.env, "shoulder")
    with pytest.warns(UserWarning, match="stability bound"):
        bad = within(robot, good.replace(kp=good.kp * 400, kd=good.kd * 20), drawn.actuators, moves, **options)
    assert not bad.holds
    assert bad.stability.robot_ratio > 1
