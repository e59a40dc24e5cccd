"""The guard in the loop: limits of the URDF, told in the observation, independent of workers and
restores.
"""

import numpy as np
import pytest
from tiny_urdf import joint, link, write
from tiny_urdf import robot as urdf

import batchpid as bp
from batchpid.sim import Robot, Runner

ARM = """<robot name="arm">
<link name="base"/>
<link name="upper">
<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="50" velocity="3"/>{safety}</joint>
</robot>"""


def load(tmp_path, safety=""):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.format(safety=safety))
    return Robot.load(path)


def test_limits_are_those_of_the_urdf(tmp_path):
    plain = load(tmp_path).guard()
    assert [plain.lower.item(), plain.upper.item(), plain.rate.item()] == [-2, 2, 3]
    assert plain.acceleration is None
    soft = load(
        tmp_path,
        '<safety_controller k_velocity="1" soft_lower_limit="-1.5" soft_upper_limit="2.5"/>',
    )
    assert [leaf.item() for leaf in soft.guard(rate=1.0, acceleration=9.0)[:4]] == [-1.5, 2, 1, 9]
    unset = load(tmp_path, '<safety_controller k_velocity="1"/>').guard()
    assert [unset.lower.item(), unset.upper.item()] == [-2, 2]


def test_the_setpoint_ramps_at_the_largest_rate_and_the_observation_tells(tmp_path):
    robot = load(tmp_path)
    with Runner(robot, 2, workers=0, guard=True, timestep=0.001, substeps=100) as runner:
        far = [runner.step([[1.0], [0.0]]) for _ in range(6)]
        assert [obs.guarded[:, 0].tolist() for obs in far] == [[True, False]] * 3 + [
            [False, False]
        ] * 3
        for _ in range(20):
            obs = runner.step([5.0])  # outside the limits
        assert obs.guarded.all()
        np.testing.assert_allclose(obs.qpos, 2.0, atol=0.01)
    with Runner(robot, 1, workers=0, timestep=0.001, substeps=100) as runner:
        assert not runner.step([1.0]).guarded.any()


@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
@pytest.mark.parametrize(("multiplier", "offset"), [(2.82, 0.0), (-3.0, 0.2), (0.5, -0.1)])
def test_limits_of_a_follower_hold_under_the_guard(multiplier, offset, engine, tmp_path):
    fast, slow = (
        f'<limit lower="-2" upper="2" effort="50" velocity="{rate}"/>' for rate in (20, 2)
    )
    law = f'<mimic joint="a" multiplier="{multiplier}" offset="{offset}"/>'
    soft = '<safety_controller k_velocity="1" soft_lower_limit="-1" soft_upper_limit="1.5"/>'
    parts = [link("base"), link("one"), link("two"), joint("a", "base", "one", inner=fast)]
    robot = Robot.load(
        write(tmp_path, urdf(*parts, joint("b", "base", "two", inner=slow + law + soft)))
    )
    with Runner(robot, 1, workers=0, guard=True, ground=False, engine=engine) as runner:
        runner.reset([0.0, 0.0])
        seen = runner.rollout(np.tile([2.0 * np.sign(multiplier), 0.0], (250, 1)))
    assert np.abs(seen.qvel[..., 1]).max() < 2.0
    np.testing.assert_allclose(
        seen.qpos[-1, 0, 1], min(1.5, 2.0 * abs(multiplier) + offset), atol=5e-3
    )
    with pytest.raises(bp.InvalidArgumentError, match=r"rate.*'b'.*limits a follower.*leader"):
        Runner(robot, 1, workers=0, guard=bp.make_guard(2, rate=[np.inf, 2.0]))
