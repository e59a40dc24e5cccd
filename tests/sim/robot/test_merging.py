"""Links joined by fixed joints, merged: the tree, placements, inertia and order of the joints."""

import re

import numpy as np
import pytest
from lxml import etree
from tiny_urdf import INERTIAL, joint, link, random_tree, robot, write

import batchpid.task_space as ts
from batchpid.sim import Robot
from batchpid.sim.robot.merging import merge_fixed_links, place_links
from batchpid.task_space.rotations import from_rpy, multiply, rotate
from batchpid.task_space.spatial_inertia import SpatialInertia, total

BOX = '<collision><origin xyz="0.1 0 0"/><geometry><box size="0.1 0.2 0.3"/></geometry></collision>'


def load(tmp_path, *parts, **options) -> Robot:
    return Robot.load(write(tmp_path, robot(*parts)), **options)


def none_asked(name: str) -> SpatialInertia:
    raise AssertionError(name)


def links_of(urdf: str) -> list[str]:
    return [each.get("name") for each in etree.fromstring(urdf).findall("link")]


def test_a_rigid_body_becomes_its_first_link(tmp_path):
    text = load(
        tmp_path,
        *(link(name) for name in ("base", "stand", "arm")),
        link("flange", ""),
        link("camera", INERTIAL + BOX),
        joint("f1", "base", "stand", "fixed", ""),
        joint("hinge", "stand", "arm"),
        joint("f2", "arm", "flange", "fixed", ""),
        joint("f3", "flange", "camera", "fixed", '<origin rpy="0 0 1.5707963267948966"/>'),
    ).urdf
    merged = merge_fixed_links(text, none_asked)
    assert links_of(merged.urdf) == ["base", "arm"]
    assert {name: at.link for name, at in merged.bodies.items()} == {
        "base": "base",
        "stand": "base",
        "arm": "arm",
        "flange": "arm",
        "camera": "arm",
    }
    assert merged.owners == {"base": [], "arm": ["camera"]}
    root = etree.fromstring(merged.urdf)
    assert root.find("joint/origin").get("xyz") == "0.0 0.0 2.0"
    assert float(root.find("link[@name='arm']/inertial/mass").get("value")) == 2
    np.testing.assert_allclose(merged.bodies["camera"].position, [0, 0, 2])


def test_without_fixed_joints_nothing_changes(tmp_path):
    text = load(tmp_path, link("a"), link("b"), joint("h", "a", "b")).urdf
    assert merge_fixed_links(text, none_asked).urdf == text


def test_links_whose_wrench_is_measured_begin_a_body(tmp_path):
    fixed = joint("f", "b", "c", "fixed", ""), joint("g", "c", "d", "fixed", "")
    loaded = load(
        tmp_path, link("a"), link("b"), link("c"), link("d"), joint("h", "a", "b"), *fixed
    )
    assert [at.link for at in loaded.bodies.values()] == ["a", "b", "b", "b"]
    assert [at.link for at in place_links(loaded.urdf, ("c",)).values()] == ["a", "b", "c", "c"]


@pytest.mark.parametrize("given", [True, False])
def test_mass_of_shapes_counts_beside_given_mass_and_alone(given, tmp_path):
    asked = []

    def of_shapes(name):
        asked.append(name)
        return SpatialInertia(6.0, np.array([0.1, 0.0, 0.0]), np.eye(3))

    parts = link("base"), link("arm", INERTIAL if given else ""), link("tool", BOX)
    text = load(
        tmp_path, *parts, joint("h", "base", "arm"), joint("f", "arm", "tool", "fixed", "")
    ).urdf
    arm = etree.fromstring(merge_fixed_links(text, of_shapes).urdf).find("link[@name='arm']")
    assert asked == ["tool"]
    assert len(arm.findall("collision")) == 1
    assert float(arm.find("inertial/mass").get("value")) == (7 if given else 6)
    at = [float(value) for value in arm.find("inertial/origin").get("xyz").split()]
    np.testing.assert_allclose(at, [6 * 0.1 / 7, 0, 6 / 7] if given else [0.1, 0, 1])


@pytest.mark.parametrize("seed", range(8))
def test_poses_inertia_and_order_of_random_trees_stay(seed, tmp_path):
    rng = np.random.default_rng(seed)
    original = load(tmp_path, *random_tree(rng, 12))
    merged = merge_fixed_links(original.urdf, none_asked)
    (tmp_path / "merged.urdf").write_text(merged.urdf)
    again = Robot.load(tmp_path / "merged.urdf")
    assert again.joint_names == original.joint_names
    qpos = rng.uniform(-2, 2, original.dof)
    tree, reduced = original.rigid_tree, again.rigid_tree
    poses, bodies = ts.link_poses(tree, qpos), ts.link_poses(reduced, qpos)

    def world(inertias, tree, poses):
        """Total inertia in the world, of bodies that move together."""
        index = [tree.index(name) for name in inertias]
        return total(
            [
                i.moved(poses[k, :3], poses[k, 3:])
                for i, k in zip(inertias.values(), index, strict=True)
            ]
        )

    for name, at in merged.bodies.items():
        body, own = bodies[reduced.index(at.link)], poses[tree.index(name)]
        np.testing.assert_allclose(body[:3] + rotate(body[3:], at.position), own[:3], atol=1e-12)
        assert abs(multiply(body[3:], at.wxyz) @ own[3:]) == pytest.approx(1, abs=1e-12)
    inertias = merge_fixed_links(merged.urdf, none_asked).inertias
    before, after = world(merged.inertias, tree, poses), world(inertias, reduced, bodies)
    for ours, theirs in zip(before, after, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


def test_a_fixed_joint_is_kept_where_its_merge_would_change_the_order_of_the_joints(tmp_path):
    names = "base", "a", "b", "mount", "c", "d", "tip"
    parts = (
        joint("ja", "base", "a"),
        joint("jb", "a", "b"),
        joint("fixed", "base", "mount", "fixed", ""),
        joint("jc", "mount", "c"),
        joint("jd", "c", "d"),
        joint("end", "d", "tip", "fixed", ""),
    )
    original = load(tmp_path, *map(link, names), *parts)
    assert original.joint_names == ("ja", "jb", "jc", "jd")
    merged = merge_fixed_links(original.urdf, none_asked).urdf
    assert links_of(merged) == ["base", "a", "b", "mount", "c", "d"]
    assert len(re.findall('type="fixed"', merged)) == 1


def test_siblings_of_a_merged_link_stay_in_order(tmp_path):
    """Joints below a fixed one come after the joints of their new siblings, in any order of the
    file.
    """
    parts = (
        joint("late", "mount", "c"),
        joint("early", "base", "a"),
        joint("fixed", "base", "mount", "fixed", ""),
    )
    original = load(tmp_path, *map(link, ("base", "a", "mount", "c")), *parts)
    merged = merge_fixed_links(original.urdf, none_asked).urdf
    assert original.joint_names == ("early", "late")
    assert [each.get("name") for each in etree.fromstring(merged).findall("joint")] == [
        "early",
        "late",
    ]


def test_placements_of_a_robot_are_those_of_its_kinematics(panda):
    tree = panda.rigid_tree
    poses = ts.link_poses(tree, np.zeros(panda.dof))
    for name, at in place_links(panda.urdf).items():
        body, own = (poses[tree.index(each)] for each in (at.link, name))
        np.testing.assert_allclose(body[:3] + rotate(body[3:], at.position), own[:3], atol=1e-12)


def test_total_of_two_masses_is_that_of_a_dumbbell():
    still = np.zeros((3, 3))
    ends = [SpatialInertia(1.0, np.array([x, 0.0, 0.0]), still) for x in (-1.0, 1.0)]
    body = total(ends)
    np.testing.assert_allclose(body.center, 0)
    np.testing.assert_allclose(body.tensor, np.diag([0.0, 2.0, 2.0]))
    turned = body.moved(np.array([0.0, 0.0, 1.0]), from_rpy([0, 0, np.pi / 2]))
    np.testing.assert_allclose(turned.tensor, np.diag([2.0, 0.0, 2.0]), atol=1e-15)
    np.testing.assert_allclose(turned.center, [0, 0, 1])
