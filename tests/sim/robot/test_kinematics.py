"""Forward kinematics against SAPIEN's link poses."""

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import load_bundled
from tiny_urdf import link, write

import batchpid.task_space as ts
from batchpid.sim import Robot
from batchpid.sim.engine.protocol import SceneSpec
from batchpid.sim.engine.sapien.building import build_scene, new_system
from batchpid.sim.engine.scene_spec import PHYSICS
from batchpid.sim.robot.robot_model import link_tree
from batchpid.task_space.frames import from_rpy, to_rpy

ODD = """<robot name="odd">
  <link name="tip"/><link name="base"/><link name="mid"/><link name="side"/><link name="bracket"/>
  <joint name="last" type="prismatic"><parent link="bracket"/><child link="tip"/>
    <origin xyz="0 0.1 0.2" rpy="0.3 -0.2 0.1"/><axis xyz="0 3 4"/>
    <limit lower="-1" upper="1" effort="9" velocity="9"/></joint>
  <joint name="first" type="continuous"><parent link="base"/><child link="mid"/><origin rpy="1 2 3"/></joint>
  <joint name="weld" type="fixed"><parent link="mid"/><child link="bracket"/>
    <origin xyz="0.5 0 0" rpy="0 0.7 0"/></joint>
  <joint name="aside" type="revolute"><parent link="mid"/><child link="side"/><origin xyz="0 0 -0.4"/>
    <axis xyz="-1 1 0.5"/><limit lower="-2" upper="2" effort="9" velocity="9"/></joint>
</robot>"""


def odd_robot(folder):
    """A tree listed out of order, with every type of joint."""
    return Robot.load(
        write(folder, re.sub(r'<link name="(\w+)"/>', lambda found: link(found[1]), ODD))
    )


@pytest.fixture(
    scope="module", params=["panda", pytest.param("jaco2", marks=pytest.mark.slow), "odd"]
)
def robot(request, tmp_path_factory):
    return (
        odd_robot(tmp_path_factory.mktemp("odd"))
        if request.param == "odd"
        else load_bundled(request.param)
    )


def random_qpos(robot, count):
    low, high = np.maximum(robot.lower, -6), np.minimum(robot.upper, 6)
    return np.random.default_rng(0).uniform(low, high, (count, robot.dof))


def test_link_poses_are_those_of_sapien(robot):
    spec = SceneSpec(
        robot.tables,
        robot.self_contact.ignored,
        robot.joints,
        1e-3,
        PHYSICS["accurate"],
        ground=False,
    )
    _scene, reference = build_scene(spec, new_system(spec))
    tree, qpos = link_tree(robot), random_qpos(robot, 20)
    ours = ts.link_poses(tree, qpos)
    assert ours.shape == (20, len(tree.links), 7)
    for k, row in enumerate(qpos):
        reference.set_qpos(row.astype(np.float32))
        for body in reference.links:
            pose, index = body.entity_pose, tree.index(body.name)
            np.testing.assert_allclose(ours[k, index, :3], pose.p, atol=2e-6)
            assert np.abs(ours[k, index, 3:] @ pose.q) == pytest.approx(1, abs=2e-6)


def test_the_tool_is_the_hand_or_the_end_of_the_chain(panda, jaco2, tmp_path):
    for robot, tool in (
        (panda, "panda_hand"),
        (jaco2, "j2s7s300_link_7"),
        (odd_robot(tmp_path), "mid"),
    ):
        assert link_tree(robot).tool == tool


SPECIAL = st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi, 1.5707963])


@settings(max_examples=40)
@given(st.tuples(*[st.floats(-math.pi, math.pi) | SPECIAL] * 3))
def test_rpy_of_a_rotation_gives_the_rotation_also_at_a_right_angle(rpy):
    q = from_rpy(rpy)
    again = from_rpy(to_rpy(q))
    assert abs(again @ q) > 1 - 1e-15  # q and -q are one rotation
    np.testing.assert_allclose(again * np.sign(again @ q), q, atol=1e-14)
