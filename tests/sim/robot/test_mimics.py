"""Mimic joints as a coupling, and the limits that they share."""

import numpy as np
import pytest
from tiny_urdf import INERTIAL, joint, link, robot, write

from batchpid.sim import Robot


def hand(folder, **mimics):
    """Return a robot of joints side by side, with a limit and a mimic each."""
    links = [link("base", INERTIAL), *(link(f"l_{name}") for name in mimics)]
    joints = [joint(name, "base", f"l_{name}", inner=inner) for name, inner in mimics.items()]
    return Robot.load(write(folder, robot(*links, *joints)))


def limit(lower, upper):
    return f'<limit lower="{lower}" upper="{upper}" effort="10" velocity="2"/>'


def mimic(leader, multiplier=1.0, offset=0.0):
    return f'<mimic joint="{leader}" multiplier="{multiplier}" offset="{offset}"/>'


def test_limits_of_a_leader_are_narrowed_by_its_followers_through_chains(tmp_path):
    fingers = hand(
        tmp_path,
        a=limit(-1, 1),
        b=limit(-1, 1) + mimic("a", 2, 0.5),
        c=limit(-1, 0.5) + mimic("b", -1),
    )
    # b: 2 a + 0.5 in [-1, 1]; c: -2 a - 0.5 in [-1, 0.5]
    np.testing.assert_allclose(fingers.lower, [-0.5, -0.5, -1.0])
    np.testing.assert_allclose(fingers.upper, [0.25, 1.0, 0.5])
    for poses in (fingers.sample(50), fingers.start[None]):
        np.testing.assert_array_equal(poses, fingers.coupling.positions(poses))
        np.testing.assert_allclose(np.clip(poses, fingers.lower, fingers.upper), poses, atol=1e-6)


def test_a_guard_holds_the_leader_of_a_follower_that_turns_without_end(tmp_path):
    fingers = hand(tmp_path, a=limit(-1, 1), b=mimic("a", -2))
    turning = Robot.load(
        write(
            tmp_path,
            fingers.path.read_text().replace('"b" type="revolute"', '"b" type="continuous"'),
        )
    )
    assert [joint.continuous for joint in turning.joints] == [False, True]
    assert turning.guard().lower[0, 0] == -1


def test_a_follower_that_leaves_no_range_does_not_narrow_it(tmp_path):
    fingers = hand(tmp_path, a=limit(-1, 1), b=limit(3, 4) + mimic("a"))
    np.testing.assert_array_equal(fingers.lower, [-1, -1])
    np.testing.assert_array_equal(fingers.upper, [1, 1])


@pytest.mark.parametrize(
    "leaders", [{"a": "a"}, {"a": "b", "b": "a"}, {"a": "a", "b": "a", "c": "b"}]
)
def test_one_joint_of_a_loop_of_mimics_leads(leaders, tmp_path):
    fingers = hand(
        tmp_path, **{name: limit(-1, 1) + mimic(leader) for name, leader in leaders.items()}
    )
    assert fingers.independent.sum() == 1


def test_friction_and_damping_of_followers_act_on_their_leader(tmp_path):
    inner = limit(-1, 1) + '<dynamics friction="0.3" damping="0.1"/>'
    fingers = hand(tmp_path, a=inner, b=inner + mimic("a", -2))
    np.testing.assert_allclose(fingers.friction, [0.3 + 2 * 0.3, 0])
    np.testing.assert_allclose(fingers.damping, [0.1 + 4 * 0.1, 0])
