"""Inverse kinematics: reachable poses are reached within the limits, others are reported."""

import dataclasses

import numpy as np
import pytest
from osc_arms import six
from trees import TOOLS, planar, robot_of, tree_of

import batchpid.task_space as ts
from batchpid.errors import InvalidArgumentError
from batchpid.task_space import frames


def reachable(name, rows, seed=5):
    """Return poses of the tool, and joint positions within the limits that have them."""
    tree = tree_of(name)
    low, high = np.maximum(tree.lower, -np.pi), np.minimum(tree.upper, np.pi)
    qpos = np.random.default_rng(seed).uniform(low, high, (rows, tree.dof))
    return ts.link_poses(tree, qpos, [TOOLS[name]])[:, 0], qpos


def check(tree, link, pose, found):
    """Check that every success is one, and the errors that are reported."""
    reached = ts.link_poses(tree, found.qpos, [link])[:, 0]
    error = frames.pose_error(pose, reached)
    np.testing.assert_allclose(
        np.linalg.norm(error[:, :3], axis=1), found.position_error, atol=1e-12
    )
    np.testing.assert_allclose(
        np.linalg.norm(error[:, 3:], axis=1), found.rotation_error, atol=1e-12
    )
    good = (found.position_error <= 1e-5) & (found.rotation_error <= 1e-4)
    np.testing.assert_array_equal(good, found.success)
    assert ((found.qpos >= tree.lower) & (found.qpos <= tree.upper)).all()


@pytest.mark.parametrize("name", list(TOOLS))
def test_reachable_poses_are_reached(name):
    tree, start, rows = tree_of(name), robot_of(name).start, 500
    pose, _ = reachable(name, rows)
    found = ts.inverse_kinematics(tree, TOOLS[name], pose, start, on_failure="return")
    check(tree, TOOLS[name], pose, found)
    assert found.success.mean() >= 0.995
    others = ~tree.chain(TOOLS[name])
    np.testing.assert_array_equal(found.qpos[:, others], np.tile(start[others], (rows, 1)))


def test_an_arm_with_limits_of_half_a_turn_reaches_its_poses(tmp_path):
    tree = dataclasses.replace(six(tmp_path).kinematic_tree(), lower=-np.pi, upper=np.pi)
    rng = np.random.default_rng(0)
    pose = ts.link_poses(tree, rng.uniform(tree.lower, tree.upper, (500, 6)), ["l6"])[:, 0]
    start = np.array([0.0, -1.5, 1.5, -1.5, -1.5, 0.0])
    found = ts.inverse_kinematics(tree, "l6", pose, start, on_failure="return")
    check(tree, "l6", pose, found)
    assert found.success.mean() >= 0.995


@pytest.mark.parametrize("name", [*TOOLS, "six joints"])
def test_five_steps_suffice_from_nearby(name, tmp_path):
    """From 0.3 rad away; without the acceleration, and with a bias of 1e-5 of the damping, for 98 %
    of them.
    """
    is_six = name == "six joints"
    tree = six(tmp_path).kinematic_tree() if is_six else tree_of(name)
    tool = "l6" if is_six else TOOLS[name]
    rng, chain = np.random.default_rng(5), tree.chain(tool)
    qpos = rng.uniform(
        np.maximum(tree.lower, -np.pi), np.minimum(tree.upper, np.pi), (1000, tree.dof)
    )
    pose, way = ts.link_poses(tree, qpos, [tool])[:, 0], chain * rng.normal(size=qpos.shape)
    near = qpos + 0.3 * way / np.linalg.norm(way, axis=1, keepdims=True)
    found = ts.inverse_kinematics(
        tree, tool, pose, near, starts=1, iterations=5, on_failure="return"
    )
    check(tree, tool, pose, found)
    assert found.success.mean() >= 0.99


def test_a_point_of_a_link_is_a_tool():
    tree, point = tree_of("panda"), np.array([0.0, 0.0, 0.1])
    pose, qpos = reachable("panda", 10)
    pose[:, :3] += frames.rotate(frames.matrix_of(pose[:, 3:]), point)
    found = ts.inverse_kinematics(tree, TOOLS["panda"], pose, qpos + 0.05, point=point)
    assert found.success.all()


def test_the_result_of_an_env_does_not_depend_on_the_others():
    tree, start = tree_of("panda"), robot_of("panda").start
    pose, _ = reachable("panda", 12)
    pose[3, 0] += 3.0
    whole = ts.inverse_kinematics(tree, TOOLS["panda"], pose, start, starts=5, on_failure="return")
    assert not whole.success[3]
    for rows in (slice(3, 4), slice(0, 5), slice(8, 12)):
        part = ts.inverse_kinematics(
            tree, TOOLS["panda"], pose[rows], start, starts=5, on_failure="return"
        )
        for few, all_rows in zip(part, whole, strict=True):
            np.testing.assert_array_equal(few, all_rows[rows])


def test_joints_stop_at_their_limits():
    tree = planar((1.0, 1.0))
    limited = dataclasses.replace(tree, lower=-0.5, upper=0.5)
    pose = ts.link_poses(limited, [0.5, 0.4], ["tip"])[0]
    found = ts.inverse_kinematics(limited, "tip", pose, [-0.4, -0.4])
    np.testing.assert_allclose(found.qpos, [[0.5, 0.4]], atol=1e-4)
    beyond = ts.link_poses(limited, [0.8, 0.4], ["tip"])[0]
    found = ts.inverse_kinematics(limited, "tip", beyond, [0.0, 0.0], on_failure="return")
    assert not found.success[0]
    assert found.qpos[0, 0] == 0.5  # the nearest


def test_a_failure_is_not_silent():
    tree = tree_of("panda")
    pose, qpos = reachable("panda", 3)
    pose[1, 0] += 2.0
    message = r"pose, env 1: was not reached in 1 of 3 envs: .* mm and .*check that it is in reach"
    with pytest.raises(InvalidArgumentError, match=message) as caught:
        ts.inverse_kinematics(tree, "panda_hand", pose, qpos, starts=2)
    assert caught.value.env == 1
    found = ts.inverse_kinematics(tree, "panda_hand", pose, qpos, starts=2, on_failure="return")
    np.testing.assert_array_equal(found.success, [True, False, True])
    for bad in (2 * pose, np.nan * pose):
        with pytest.raises(InvalidArgumentError, match=r"^pose") as caught:
            ts.inverse_kinematics(tree, "panda_hand", bad, qpos)
        assert caught.value.env == 0
