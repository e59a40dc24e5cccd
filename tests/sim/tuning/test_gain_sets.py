"""Gain sets by name, and from files."""

import dataclasses

import pytest
from identical import are_same_params

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim.tuning.gain_sets import gain_set


def test_names_stand_for_the_robots_own_gains(panda):
    for name, params in (
        ("tuned", panda.tuned()),
        ("designed", panda.designed()),
        ("sapien-tutorial", panda.params()),
    ):
        gains = gain_set(panda, name)
        assert (gains.name, gains.control) == (name, "pid")
        assert are_same_params(gains.params, params)


def test_default_is_tuned_where_shipped_and_designed_otherwise(panda):
    assert gain_set(panda).name == "tuned"
    assert gain_set(dataclasses.replace(panda, settings=None)).name == "designed"


def test_drive_has_a_control_stiffness_and_damping(panda):
    gains = gain_set(panda, "drive")
    assert (gains.name, gains.control) == ("drive (20, 5)", "drive")
    assert (gains.params.kp == 20).all()
    assert (gains.params.kd == 5).all()


def test_params_file_is_named_after_the_file(panda, tmp_path):
    path = tmp_path / "mine.yaml"
    bp.save_params(path, panda.designed(), panda.joint_names)
    gains = gain_set(panda, str(path))
    assert (gains.name, gains.control) == ("mine.yaml", "pid")
    assert are_same_params(gains.params, panda.designed())


def test_tuned_gains_of_a_robot_without_are_refused(panda):
    with pytest.raises(InvalidArgumentError, match="tuned"):
        gain_set(dataclasses.replace(panda, settings=None), "tuned")
