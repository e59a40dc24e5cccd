import numpy as np
import pytest

import batchpid as bp
from batchpid.sim.identification import excite


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_the_motion_keeps_the_limits_and_moves_every_joint(name, request):
    robot = request.getfixturevalue(name)
    motion = excite(robot, 4.0, rate=100)
    assert (motion.position >= robot.lower - 1e-9).all()
    assert (motion.position <= robot.upper + 1e-9).all()
    assert (np.abs(motion.velocity) <= robot.velocity_limit).all()
    assert motion.ticks == 400
    least = [0.02 if unit == "rad" else 0.002 for unit in robot.units]
    assert (np.ptp(motion.position, axis=0) > least).all()
    np.testing.assert_allclose(motion.position[[0, -1]], motion.position[[0, 0]], atol=1e-4)
    assert (np.abs(motion.velocity[[0, -1]]) < 0.05).all()
    # All motions differ.
    assert np.linalg.cond(np.corrcoef(motion.velocity[:, robot.independent].T)) < 100


def test_the_seed_decides(panda):
    first, again, other = (excite(panda, 2.0, rate=50, seed=seed) for seed in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first.position, other.position)
    for name, value in {"duration": 0, "rate": 1, "highest": 0.01, "seed": -1}.items():
        with pytest.raises(bp.InvalidArgumentError, match=name):
            excite(panda, **{name: value})


BAR = """<inertial><origin xyz="0.15 0 0"/><mass value="1"/>
<inertia ixx="0.001" iyy="0.008" izz="0.008" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0.15 0 0"/><geometry><box size="0.24 0.05 0.05"/></geometry></collision>"""


def arm(folder, height=0.15, effort=60.0, bend=60.0, wall=""):
    """Return an arm of two bars that turn about y above the ground; a wall in front of it is fixed
    to its base.
    """
    joint = """<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/>
    <origin xyz="{}"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="{}" velocity="9"/></joint>"""
    parts = [f'<link name="base"/><link name="upper">{BAR}</link><link name="lower">{BAR}</link>']
    parts.append(joint.format("lift", "base", "upper", f"0 0 {height}", effort))
    parts.append(joint.format("bend", "upper", "lower", "0.3 0 0", bend))
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(parts)}{wall}</robot>')
    return bp.sim.Robot.load(path, self_collision="urdf")


# In the middle of the upper bar, whatever the joints do but at their ends.
WALL = """<link name="wall"><collision><geometry><box size="0.1 1 4"/></geometry></collision></link>
<joint name="hold" type="fixed"><parent link="base"/><child link="wall"/><origin xyz="0.03 0 0"/></joint>"""


def test_joints_that_would_touch_the_ground_move_less(tmp_path):
    """The arm is level and 0.15 m above the ground: 0.25 rad of both joints touch it."""
    robot = arm(tmp_path)
    motion = excite(robot, 4.0, rate=100)
    assert (np.ptp(motion.position, axis=0) > 0.06).all()
    assert not robot.dynamics().in_contact(motion.position, 0.009).any()


def test_what_stops_every_motion_is_named(tmp_path):
    for words, options in {
        "'upper' and 'wall' touch|'wall' and 'upper' touch": {"wall": WALL},
        "joint 'lift' is too weak": {"effort": 0.01, "bend": 0.01},
    }.items():
        with pytest.raises(bp.InvalidArgumentError, match=words):
            excite(arm(tmp_path, height=1.0, **options), 2.0, rate=50)


def test_a_joint_that_is_always_too_weak_stays_still(tmp_path):
    motion = excite(arm(tmp_path, height=1.0, bend=0.01), 2.0, rate=50)
    assert np.ptp(motion.position[:, 0]) > 0.1
    assert np.ptp(motion.position[:, 1]) == 0
