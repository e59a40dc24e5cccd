"""Which robots get a PhysX system of their own: those that may be touched at two places in the next time step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim import Robot
from sim.building import SceneSpec, link_extents, parse
from sim.isolation import AHEAD, SURGE, WORLD, Crowding, Gap, Link
from sim.kinematics import Kinematics
from sim.physics import PHYSICS
from sim.scenes import Pack

DT = 1 / 2000
# A base, an arm that turns, and on it two fingers that slide and one that turns.
HAND = [
    Link(None, None, False, 0.0, 0.1),
    Link(0, 0, False, 0.3, 0.2),
    Link(1, 1, True, 0.1, 0.05),
    Link(1, 2, True, 0.1, 0.05),
    Link(1, 3, False, 0.1, 0.04),
]
STILL = SURGE * DT * AHEAD * DT
"""What may close from rest [m]."""


def crowding(timestep=DT):
    return Crowding(HAND, 4, timestep)


def test_one_contact_has_no_order():
    assert not crowding().foresees([Gap(2, 3, -0.001)], np.full(4, 1e3))


@pytest.mark.parametrize(("far", "expected"), [(0.9, True), (1.1, False)])
def test_two_gaps_at_rest_count_when_both_are_near(far, expected):
    gaps = [Gap(2, 3, 0.0), Gap(2, WORLD, far * STILL)]
    assert crowding().foresees(gaps, np.zeros(4)) is expected


@pytest.mark.parametrize(
    ("pair", "arms"),
    [
        ((2, 3), (0.0, 1.0, 1.0, 0.0)),  # the joint above both moves them alike
        ((2, WORLD), (0.3 + 0.05 - 0.2, 1.0, 0.0, 0.0)),
        ((1, 4), (0.0, 0.0, 0.0, 0.04)),
        ((0, 1), (0.2, 0.0, 0.0, 0.0)),
    ],
)
def test_a_gap_closes_as_fast_as_the_joints_between_its_links_move(pair, arms):
    """A link turns about a joint with its farthest point, a sliding joint's full travel apart."""
    qvel = np.array([1.0, -2.0, 3.0, -4.0])
    speed = float(np.abs(qvel) @ arms)
    closes = AHEAD * DT * (speed + SURGE * DT)
    beside = Gap(2, 3, -1.0)
    assert crowding().foresees([beside, Gap(*pair, closes * 0.999)], qvel)
    assert not crowding().foresees([beside, Gap(*pair, closes * 1.001)], qvel)


@given(
    st.lists(st.tuples(st.integers(-1, 4), st.integers(-1, 4), st.floats(-0.01, 0.02)), max_size=6),
    st.lists(st.floats(-50, 50), min_size=4, max_size=4),
    st.randoms(use_true_random=False),
)
def test_foresight_has_no_order_and_faster_is_never_safer(pairs, speeds, random):
    gaps, qvel = [Gap(*pair) for pair in pairs], np.array(speeds)
    found = crowding().foresees(gaps, qvel)
    random.shuffle(gaps)
    assert crowding().foresees(gaps, -qvel) is found
    assert crowding().foresees([Gap(b, a, d) for a, b, d in gaps], qvel) is found
    if found:
        assert crowding().foresees(gaps, 2 * qvel)
        assert crowding(2 * DT).foresees(gaps, qvel)


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_no_link_outruns_its_reach(name):
    """Every link's origin moves at most as fast as the reach about each joint allows."""
    robot = Robot.load(name)
    spec = SceneSpec(robot.urdf, robot.srdf, robot.joints, DT, PHYSICS["fast"])
    pack = Pack(parse(spec), spec, 1)
    links = link_extents(pack._robots[0])
    arm = Crowding(links, robot.dof, DT)._arm[:-1, WORLD]
    body = Kinematics(robot)
    order = [body.index(link.name) for link in pack._robots[0].links]
    pack.close()
    rng = np.random.default_rng(0)
    qpos, qvel = robot.sample(50, seed=0), rng.normal(size=(50, robot.dof))
    tiny = 1e-6
    there, here = body.poses(qpos + tiny * qvel).position, body.poses(qpos).position
    speed = np.linalg.norm(there - here, axis=-1)[:, order] / tiny
    bound = np.abs(qvel) @ arm.T
    assert (speed <= bound * (1 + 1e-4) + 1e-6).all()
    assert (bound[:, 1:].max(1) < 20 * speed.max(1)).all()  # not a bound that says nothing
