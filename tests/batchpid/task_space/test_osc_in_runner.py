"""The controller of the guide in a Runner: it reaches its pose, and an env does not depend on the others."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from trees import robot_of, tree_of

import batchpid.task_space as ts
from batchpid.sim import Runner

GUIDE = Path(__file__).parents[3] / "docs/task-space.md"
START = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8, 0.02, 0.02])
OPTIONS = {"workers": 0, "timestep": 1 / 500, "substeps": 5}


@pytest.fixture(scope="module")
def control():
    (source,) = re.findall(r"\nclass OperationalSpace:.*?\n\n\n", GUIDE.read_text(), re.DOTALL)
    names: dict = {"np": np, "ts": ts}
    exec("from batchpid.sim import CommandSpec\n" + source, names)
    return names["OperationalSpace"](robot_of("panda"), "panda_hand")


def test_it_reaches_its_pose_and_holds_it(control):
    tree = tree_of("panda")
    goal = ts.link_poses(tree, START, ["panda_hand"])[0] + [0.03, 0.0, -0.03, 0, 0, 0, 0]
    with Runner(robot_of("panda"), 3, control=control, **OPTIONS) as runner:
        assert runner.command.labels[0] == "x [m]"
        runner.reset(START)
        rollout = runner.rollout(np.broadcast_to(goal, (80, 7)))
    reached = ts.link_poses(tree, rollout.qpos[-1], ["panda_hand"])[:, 0]
    assert np.abs(reached[:, :3] - goal[:3]).max() < 3e-4
    assert (np.abs(reached[:, 3:] @ goal[3:]) > 1 - 1e-6).all()
    assert rollout.ok.all()


def test_an_env_does_not_depend_on_the_others(control):
    starts = START + 0.1 * np.random.default_rng(0).normal(size=(5, 9)) * (np.arange(9) < 7)
    goals = ts.link_poses(tree_of("panda"), starts, ["panda_hand"])[:, 0]
    goals[:, 0] += 0.05
    goals[1, :3] = [0.9, 0.3, 0.9]  # out of reach: near a singularity
    courses = []
    for chosen in (slice(0, 5), slice(2, 3)):
        with Runner(robot_of("panda"), len(starts[chosen]), control=control, **OPTIONS) as runner:
            runner.reset(starts[chosen])
            courses.append(runner.rollout(np.broadcast_to(goals[chosen], (20, *goals[chosen].shape))))
    together, alone = courses
    np.testing.assert_array_equal(alone.qpos[:, 0], together.qpos[:, 2])
    np.testing.assert_array_equal(alone.effort[:, 0], together.effort[:, 2])
