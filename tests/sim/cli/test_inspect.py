"""batchpid inspect: the findings, the joints in the order of qpos, the masses of the links."""

import pytest
from tiny_urdf import joint, link, robot, write

from batchpid.sim import Robot


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_lists_the_joints_in_order(name, batchpid):
    status, out, _ = batchpid("inspect", name)
    bundled = Robot.load(name)
    assert status == 0
    rows = [line.split() for line in out.splitlines() if line[:1].isdigit()]
    assert [(int(row[0]), row[1]) for row in rows] == list(enumerate(bundled.joint_names))
    assert f"{bundled.dof} degrees of freedom" in out


def flat(text):
    """Return ``text`` with its lines joined."""
    return " ".join(text.split())


def test_one_cause_is_one_sentence(batchpid, tmp_path):
    """Joints with the same cause are listed after one sentence, their figures after their names."""
    unlimited = '<limit lower="-1" upper="1" effort="0" velocity="2"/>'
    joints = [joint(f"j{k}", f"l{k}", f"l{k + 1}", inner=unlimited) for k in range(4)]
    path = write(tmp_path, robot(*(link(f"l{k}") for k in range(5)), *joints))
    out = batchpid("inspect", path)[1]
    assert out.count("is a placeholder") == 1
    assert "motor. 4 joints: 'j0', 'j1', 'j2', 'j3' note:" in flat(out)
    assert out.count("no effort limit") == 1
    limits = Robot.load(path).design_effort_limit
    assert f"4 joints: 'j0' ({limits[0]:.3g} N m), 'j1' ({limits[1]:.3g} N m), " in flat(out)
    table = out.index("\n0 ")
    assert all(str(finding.text) in flat(out[:table]) for finding in Robot.load(path).check())


def test_pairs_that_do_not_collide_are_counted(batchpid):
    out = batchpid("inspect", "panda")[1]
    assert "Ground at height 0. 12 pairs of links excluded from collision: 12 'Adjacent'." in out


def test_masses_of_inertials_and_of_shapes(batchpid, tmp_path):
    box = '<collision><geometry><box size="0.1 0.2 0.3"/></geometry></collision>'
    parts = (link("base"), link("arm", box), link("hand"), link("frame", ""))
    ends = [("base", "arm"), ("arm", "hand"), ("hand", "frame")]
    joints = [
        joint(f"j{k}", *pair, *(("fixed", "") if k > 1 else ())) for k, pair in enumerate(ends)
    ]
    path = write(tmp_path, robot(*parts, *joints))
    out = batchpid("inspect", path)[1]
    assert "4 links, 8 kg\n" in out
    rows = [line.split() for line in out.splitlines()]
    for row in (["base", "1", "kg"], ["arm", "6", "kg"], ["hand", "1", "kg"], ["frame", "none"]):
        assert row in rows
