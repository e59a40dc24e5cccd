"""Warnings of positions outside the joint limits: one for each call, with all joints, their worst
position and envs.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from tiny_urdf import joint, link, robot, write

from batchpid.sim import Robot, Runner, SetpointWarning


@pytest.fixture
def arm(tmp_path):
    return Robot.load(
        write(tmp_path, robot(*map(link, "abc"), joint("one", "a", "b"), joint("two", "b", "c")))
    )


def warned(call):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        call()
    assert all(each.category is SetpointWarning for each in seen)
    assert all(each.filename == __file__ for each in seen)
    return [str(each.message) for each in seen]


def test_one_warning_lists_joints_and_envs(arm):
    with Runner(arm, 8, workers=0, collisions=False) as runner:
        pose = np.zeros((8, 2))
        pose[3, 0], pose[5:, 1], pose[6, 1] = 1.5, -2.0, -3.0
        (message,) = warned(lambda: runner.reset(pose))
        assert (
            message
            == "qpos is outside the joint limits, where no joint can follow: joint 'one' at 1.5"
            " rad, not in [-1, 1] (env 3 first); joint 'two' at -3 rad, not in [-1, 1] (env 5 first);"
            " move it inside"
        )
        (message,) = warned(lambda: runner.step(np.full(2, 2.0)))
        assert "setpoint" in message
        assert "(env 0 first)" in message
        assert warned(lambda: runner.rollout(np.full((2, 2), 2.0))) == []


def test_envs_that_are_not_reset_are_not_checked(arm):
    with Runner(arm, 3, workers=0, collisions=False) as runner:
        pose = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]])
        assert warned(lambda: runner.reset(pose, mask=np.array([True, False, False]))) == []
        (message,) = warned(lambda: runner.reset(pose, mask=np.array([True, False, True])))
        assert "'one'" not in message
        assert "(env 2 first)" in message
