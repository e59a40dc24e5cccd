"""Links joined by fixed joints, merged: the tree, placements, inertia and order of the joints."""

import numpy as np
import pytest
from tiny_urdf import INERTIAL, joint, link, random_tree, robot, write

import batchpid.task_space as ts
from batchpid.sim import Robot
from batchpid.sim.description.merging import body_tree, link_inertias, merge_links, place_links
from batchpid.sim.robot.robot_model import link_tree
from batchpid.task_space.frames import compose, matrix_of, rotate, total

BOX = '<collision><origin xyz="0.1 0 0"/><geometry><box size="0.1 0.2 0.3"/></geometry></collision>'


def load(tmp_path, *parts, **options):
    return Robot.load(write(tmp_path, robot(*parts)), **options)


def names_of(tables):
    return [body.name for body in tables.bodies]


def test_a_rigid_body_becomes_its_first_link(tmp_path):
    tables = load(
        tmp_path,
        *(link(name) for name in ("base", "stand", "arm")),
        link("flange", ""),
        link("camera", INERTIAL + BOX),
        joint("f1", "base", "stand", "fixed", ""),
        joint("hinge", "stand", "arm"),
        joint("f2", "arm", "flange", "fixed", ""),
        joint("f3", "flange", "camera", "fixed", '<origin rpy="0 0 1.5707963267948966"/>'),
    ).tables
    merged = merge_links(tables)
    assert names_of(merged) == ["base", "arm"]
    assert {name: at.link for name, at in merged.links.items()} == {
        "base": "base",
        "stand": "base",
        "arm": "arm",
        "flange": "arm",
        "camera": "arm",
    }
    assert [(shape.body, shape.owner) for shape in merged.shapes] == [("arm", "camera")]
    arm = merged.bodies[1]
    np.testing.assert_array_equal(arm.position, [0, 0, 2])
    assert (arm.joint.name, arm.joint.parent_link, arm.mass) == ("hinge", "base", 2)
    np.testing.assert_allclose(merged.links["camera"].position, [0, 0, 2])


def test_links_whose_wrench_is_measured_begin_a_body(tmp_path):
    fixed = joint("f", "b", "c", "fixed", ""), joint("g", "c", "d", "fixed", "")
    loaded = load(
        tmp_path, link("a"), link("b"), link("c"), link("d"), joint("h", "a", "b"), *fixed
    )
    assert [at.link for at in place_links(loaded.tables).values()] == ["a", "b", "b", "b"]
    assert [at.link for at in place_links(loaded.tables, ("c",)).values()] == ["a", "b", "c", "c"]


@pytest.mark.parametrize("given", [True, False])
def test_mass_of_shapes_counts_beside_given_mass_and_alone(given, tmp_path):
    parts = link("base"), link("arm", INERTIAL if given else ""), link("tool", BOX)
    joints = joint("h", "base", "arm"), joint("f", "arm", "tool", "fixed", "")
    merged = merge_links(load(tmp_path, *parts, *joints).tables)
    arm = merged.bodies[1]
    assert len(merged.shapes_of("tool")) == len(merged.shapes) == 1
    assert arm.mass == pytest.approx(7 if given else 6)
    np.testing.assert_allclose(arm.center, [6 * 0.1 / 7, 0, 6 / 7] if given else [0.1, 0, 1])


@pytest.mark.parametrize("seed", range(8))
def test_poses_inertia_and_order_of_random_trees_stay(seed, tmp_path):
    rng = np.random.default_rng(seed)
    original = load(tmp_path, *random_tree(rng, 12))
    merged = merge_links(original.tables)
    tree, reduced = link_tree(original), body_tree(merged)
    assert reduced.joint_names == original.joint_names
    qpos = rng.uniform(-2, 2, original.dof)
    poses, bodies = ts.link_poses(tree, qpos), ts.link_poses(reduced, qpos)

    def world(inertias, tree, poses):
        """Total inertia in the world, of bodies that move together."""
        index = [tree.index(name) for name in inertias]
        return total(
            [
                inertia.moved(poses[k, :3], poses[k, 3:])
                for inertia, k in zip(inertias.values(), index, strict=True)
            ]
        )

    for name, at in merged.links.items():
        body, pose = bodies[reduced.index(at.link)], poses[tree.index(name)]
        np.testing.assert_allclose(
            body[:3] + rotate(matrix_of(body[3:]), at.position), pose[:3], atol=1e-12
        )
        assert abs(compose(body[3:], at.wxyz) @ pose[3:]) == pytest.approx(1, abs=1e-12)
    before = world(link_inertias(original.tables), tree, poses)
    after = world(link_inertias(merged), reduced, bodies)
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
    merged = merge_links(original.tables)
    assert sorted(names_of(merged)) == ["a", "b", "base", "c", "d", "mount"]
    assert [each.name for each in merged.joints if not each.moves] == ["fixed"]
