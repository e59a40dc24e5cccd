"""The repaired robot as a URDF: it loads as the same robot, without repairs."""

import numpy as np
import pytest
from faulty_urdfs import REPAIRED
from tiny_urdf import INERTIAL, LIMIT, joint, link, one_joint, random_tree, robot, write

from batchpid.sim import Robot, to_urdf
from batchpid.task_space.frames import matrix_of


def written_again(loaded, folder):
    return Robot.load(write(folder, to_urdf(loaded).text, "again.urdf"), strict=True)


def assert_same(one, other):
    """Names, joints with all numbers, and the numbers of links and shapes but for rounding."""
    assert (one.name, one.joints, one.tables.joints) == (
        other.name,
        other.joints,
        other.tables.joints,
    )
    for rows in ("bodies", "shapes"):
        for ours, theirs in zip(
            getattr(one.tables, rows), getattr(other.tables, rows), strict=True
        ):
            for name, values in ours._asdict().items():
                others = getattr(theirs, name)
                if name.endswith("wxyz"):  # of either sign
                    values, others = matrix_of(values), matrix_of(others)
                if isinstance(values, np.ndarray):
                    np.testing.assert_allclose(values, others, atol=1e-14)
                elif name != "file":
                    assert values == others


@pytest.mark.parametrize("case", REPAIRED)
def test_a_repaired_robot_needs_no_repair_again(case, tmp_path):
    loaded = Robot.load(write(tmp_path, REPAIRED[case][0]))
    exported = to_urdf(loaded)
    assert len(exported.differences) >= 1
    assert_same(written_again(loaded, tmp_path), loaded)


@pytest.mark.parametrize("name", ["panda", pytest.param("jaco2", marks=pytest.mark.slow)])
def test_bundled_robots_keep_their_numbers(name, tmp_path):
    loaded = Robot.load(name)
    again = written_again(loaded, tmp_path)
    assert_same(again, loaded)
    poses = loaded.sample(3)
    np.testing.assert_allclose(
        again.mass_matrix(poses), loaded.mass_matrix(poses), rtol=1e-12, atol=1e-14
    )


@pytest.mark.parametrize("seed", range(4))
def test_trees_with_fixed_joints_keep_them(seed, tmp_path):
    loaded = Robot.load(write(tmp_path, robot(*random_tree(np.random.default_rng(seed), 9))))
    assert to_urdf(loaded).differences == ()
    assert_same(written_again(loaded, tmp_path), loaded)


def test_mimics_soft_limits_and_limits_of_continuous_joints_are_kept(tmp_path):
    soft = '<safety_controller k_velocity="3" soft_lower_limit="-0.5" soft_upper_limit="0.5"/>'
    parts = [
        *(link(name, INERTIAL) for name in ("x", "y", "z", "w")),
        joint("a", "x", "y", "revolute", LIMIT + soft),
        joint("b", "y", "z", "revolute", LIMIT + '<mimic joint="a" multiplier="0.5"/>'),
        joint("c", "z", "w", "continuous", '<limit effort="3" velocity="2"/>'),
    ]
    loaded = Robot.load(write(tmp_path, robot(*parts)))
    again = written_again(loaded, tmp_path)
    assert_same(again, loaded)
    assert (again.joints[0].soft_upper, again.joints[2].effort_limit) == (0.5, 3.0)
    assert to_urdf(loaded).differences == ("k_velocity of each <safety_controller> is 1",)


def test_visuals_are_kept(tmp_path):
    shape = '<geometry><box size="1 2 3"/></geometry>'
    red = '<material name="r"><color rgba="1 0 0 1"/></material>'
    seen = f"<visual>{shape}{red}</visual><visual>{shape}</visual>"
    loaded = Robot.load(write(tmp_path, one_joint(arm=INERTIAL + seen)))
    again = written_again(loaded, tmp_path)
    assert [visual.rgba for visual in again.tables.visuals["arm"]] == [(1, 0, 0, 1), None]
    assert again.tables.visuals["arm"][1].shape.size == (0.5, 1, 1.5)
