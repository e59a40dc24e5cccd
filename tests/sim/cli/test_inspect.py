"""batchpid inspect: the joints in the order of qpos, then the findings."""

from __future__ import annotations

import pytest

from sim import Robot

ODD = """<robot name="odd">
  <link name="base"/>
  <link name="arm">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="base"/><child link="arm"/><axis xyz="0 0 1"/><limit effort="0"/>
    <dynamics friction="0.5" damping="0.25"/>
  </joint>
</robot>
"""


@pytest.fixture
def odd(tmp_path):
    path = tmp_path / "odd.urdf"
    path.write_text(ODD)
    return path


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_lists_the_joints_in_order(name, batchpid):
    status, out, _ = batchpid("inspect", name)
    robot = Robot.load(name)
    assert status == 0
    rows = [line.split() for line in out.splitlines() if line[:1].isdigit()]
    assert [(int(row[0]), row[1]) for row in rows] == list(enumerate(robot.joint_names))
    assert f"{robot.dof} degrees of freedom" in out


def test_fixed_joints_on_request(batchpid):
    assert "panda_hand_joint" not in batchpid("inspect", "panda")[1]
    assert "panda_hand_joint" in batchpid("inspect", "panda", "--all")[1]


def test_lists_the_findings(batchpid, odd):
    status, out, _ = batchpid("inspect", odd)
    assert status == 0
    row = next(line for line in out.splitlines() if "hinge" in line)
    assert "continuous" in row
    assert "none to none rad" in row
    assert "0.25" in row
    findings = Robot.load(odd).check()
    assert findings
    for finding in findings:
        assert str(finding) in out


def test_strict_fails_on_findings_worse_than_notes(batchpid, odd):
    assert batchpid("inspect", odd, "--strict")[0] == 1
    assert batchpid("inspect", "panda", "--strict")[0] == 0


def test_gains_are_checked_too(batchpid):
    status, out, _ = batchpid("inspect", "jaco2")
    assert status == 0
    assert "Under gains tuned:\nNothing odd." in out
    status, out, _ = batchpid("inspect", "jaco2", "--gains", "tutorial", "--strict")
    assert status == 1
    assert "Under gains tutorial:\nwarning:" in out


def test_unknown_robot(batchpid):
    status, out, err = batchpid("inspect", "panda2")
    assert (status, out) == (2, "")
    assert "'panda2'" in err
