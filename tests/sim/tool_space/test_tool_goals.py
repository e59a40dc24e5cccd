"""Goals of a tool that are reached within the joint limits."""

from __future__ import annotations

import numpy as np
import pytest
from robots import load_bundled

import batchpid.task_space as ts
from batchpid.errors import InvalidArgumentError
from batchpid.sim import OperationalSpace
from batchpid.sim.tool_space import tool_setpoints
from batchpid.sim.tool_space.tool_setpoints import default_goal, reaches

HAND = "panda_hand"


@pytest.fixture(scope="module")
def panda():
    return load_bundled("panda")


@pytest.fixture(scope="module")
def control(panda):
    return OperationalSpace(panda, HAND, posture=panda.settings.target)


def test_a_goal_is_reached_within_the_limits_or_not(panda, control, monkeypatch):
    """Near by; beyond the reach; with a joint on the way that would pass its limit."""
    target = panda.settings.target
    start = np.stack([target + 0.05 * (np.arange(9) < 7), target, target])
    goal = np.repeat(ts.link_poses(control.tree, target[None], [HAND])[:, 0], 3, axis=0)
    goal[1, :3] = [2.0, 0.0, 0.5]
    start[2, 3] = panda.upper[3] + 0.1
    np.testing.assert_array_equal(reaches(panda, control, start, goal), [True, False, False])
    monkeypatch.setattr(tool_setpoints, "SECONDS", 0.1)  # too short to arrive
    assert not reaches(panda, control, start, goal).any()


@pytest.mark.slow
def test_the_default_goal_is_the_first_that_all_reach(panda, control):
    target = panda.settings.target
    start = target + 0.1 * np.random.default_rng(0).uniform(-1, 1, (4, 9)) * (np.arange(9) < 7)
    far = target.copy()
    far[[3, 5]] = -0.07, 3.7  # a straight elbow
    poses = np.stack([far, target])
    goal = default_goal(panda, control, start, poses)
    np.testing.assert_array_equal(goal, ts.link_poses(control.tree, target, [HAND])[0])
    start[2, 3] = panda.upper[3] + 0.1
    with pytest.raises(InvalidArgumentError, match=r"setpoint, env 2: has no default: .* 1 of 4 start poses; give"):
        default_goal(panda, control, start, poses[1:])
