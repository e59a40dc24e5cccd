"""Gain sets by name, and from files."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.cli import main
from batchpid.sim.tuning import gain_set


def same(one, other):
    return one.options().keys() == other.options().keys() and all(
        np.array_equal(value, other.options()[name]) for name, value in one.options().items()
    )


def test_names_stand_for_the_robots_own_gains(panda):
    for name, params in (
        ("tuned", panda.tuned()),
        ("designed", panda.designed()),
        ("sapien-tutorial", panda.params()),
    ):
        gains = gain_set(panda, name)
        assert (gains.name, gains.control) == (name, "pid")
        assert same(gains.params, params)


def test_default_is_tuned_where_shipped_and_designed_otherwise(panda):
    assert gain_set(panda).name == "tuned"
    assert gain_set(dataclasses.replace(panda, settings=None)).name == "designed"


def test_drive_has_a_control_stiffness_and_damping(panda):
    gains = gain_set(panda, "drive:30,4")
    assert (gains.name, gains.control) == ("drive (30, 4)", "drive")
    assert (gains.params.kp == 30).all()
    assert (gains.params.kd == 4).all()
    assert gain_set(panda, "drive").name == "drive (20, 5)"


def test_params_file_is_named_after_the_file(panda, tmp_path):
    path = tmp_path / "mine.yaml"
    bp.save_params(path, panda.designed(), panda.joint_names)
    gains = gain_set(panda, str(path))
    assert (gains.name, gains.control) == ("mine.yaml", "pid")
    assert same(gains.params, panda.designed())


@pytest.mark.parametrize("name", ["nonsense", "drive:1", "drive:a,b", "missing.yaml"])
def test_unknown_names_are_refused(panda, name):
    with pytest.raises(InvalidArgumentError, match="gains"):
        gain_set(panda, name)


def test_tuned_gains_of_a_robot_without_are_refused(panda):
    with pytest.raises(InvalidArgumentError, match="tuned"):
        gain_set(dataclasses.replace(panda, settings=None), "tuned")


def test_gains_of_an_mjcf_file_are_those_of_its_servos(panda, tmp_path):
    pytest.importorskip("mujoco", "3.17")
    params = bp.make_params(
        9,
        np.linspace(5, 80, 9),
        3.0,
        2.0,
        effort_limit=20.0,
        integral_limit=7.0,
        measurement_rate="measured",
    )
    path, gains = tmp_path / "arm.xml", tmp_path / "gains.yaml"
    bp.save_params(gains, params, panda.joint_names)
    words = (
        "export",
        "panda",
        "--to",
        "mjcf",
        "--timestep",
        1 / 2000,
        "--gains",
        gains,
        "--out",
        path,
    )
    assert not main([*map(str, words)])
    assert same(gain_set(panda, str(path)).params, params)
    path.write_text(path.read_text().replace("panda_joint1", "joint_1"))
    with pytest.raises(InvalidArgumentError, match="panda_joint1"):
        gain_set(panda, str(path))


def test_continuous_joints_of_an_mjcf_file_are_told(tmp_path):
    pytest.importorskip("mujoco", "3.17")
    geom = '<geom size=".1"/>'
    inner = f'<body pos="0 0 1"><joint name="b" range="-9 9"/>{geom}</body>'
    body = f'<body><joint name="a"/>{geom}{inner}</body>'
    actuators = "".join(f'<position joint="{each}" kp="3"/>' for each in "ab")
    text = f"<mujoco><worldbody>{body}</worldbody><actuator>{actuators}</actuator></mujoco>"
    (path := tmp_path / "r.xml").write_text(text)
    with pytest.warns(UserWarning, match="continuous: .* does not: a$"):
        gain_set(Robot.load(path), str(path))
