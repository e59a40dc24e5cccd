"""The repaired robot as a URDF: it loads as the same robot, without repairs."""

import numpy as np
import pytest
from faulty_urdfs import REPAIRED
from tiny_urdf import INERTIAL, LIMIT, joint, link, one_joint, random_tree, robot, write

from batchpid.errors import RobotError
from batchpid.sim import Robot, to_urdf
from batchpid.task_space.frames import matrix_of


def written_again(loaded, folder):
    return Robot.load(write(folder, to_urdf(loaded, folder).text, "again.urdf"), strict=True)


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
    np.testing.assert_allclose(again.mass_matrix(poses), loaded.mass_matrix(poses), rtol=1e-12)


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
    assert 'k_velocity="3"' in to_urdf(loaded).text


def test_visuals_are_copied_and_meshes_are_relative_to_the_folder(tmp_path):
    (tmp_path / "meshes").mkdir()
    corners = "\n".join(
        f"v {x} {y} {z}" for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    )
    (tmp_path / "meshes/arm.obj").write_text(f"{corners}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    mesh = '<geometry><mesh filename="package://meshes/{}.obj"/></geometry>'
    arm = f"{INERTIAL}<visual>{mesh.format('arm')}</visual><visual>{mesh.format('gone')}</visual>"
    text = one_joint(arm=f"{arm}<collision>{mesh.format('arm')}</collision>")
    loaded = Robot.load(write(tmp_path, text.replace("</robot>", '<material name="red"/></robot>')))
    (there := tmp_path / "out").mkdir()
    exported = to_urdf(loaded, there)
    assert exported.text.count('filename="../meshes/arm.obj"') == 2
    assert '<material name="red"/>' in exported.text
    assert "package://meshes/gone.obj" in exported.text
    assert exported.differences == ()
    assert_same(Robot.load(write(there, exported.text), strict=True), loaded)


def test_a_file_that_has_changed_is_refused(tmp_path):
    loaded = Robot.load(path := write(tmp_path, one_joint()))
    path.write_text(one_joint().replace('effort="10"', 'effort="11"'))
    with pytest.raises(RobotError, match="changed"):
        to_urdf(loaded)
