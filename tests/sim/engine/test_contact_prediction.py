"""Which robots get a PhysX system of their own: those that may be touched in the next time step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim import Robot
from sim.benchmark.accuracy import contact_moves, follow
from sim.engine.building import SceneSpec, link_extents, parse
from sim.engine.contact_prediction import AHEAD, SURGE, WORLD, ContactPredictor, Gap, Link
from sim.engine.pack import Pack
from sim.engine.physics import PHYSICS
from sim.robot.kinematics import Kinematics

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
    return ContactPredictor(HAND, 4, timestep)


@pytest.mark.parametrize(("far", "expected"), [(0.9, True), (1.1, False)])
def test_from_rest_two_gaps_count(far, expected):
    gaps = [Gap(2, 3, 0.5 * STILL), Gap(2, WORLD, far * STILL)]
    assert crowding().predicts_contact(gaps, np.zeros(4)) == expected
    assert not crowding().predicts_contact(gaps[:1], np.zeros(4))


def test_what_touches_already_counts():
    assert crowding().predicts_contact([Gap(2, 3, 0.0)], np.zeros(4))
    assert not crowding().predicts_contact([], np.full(4, 1e3))


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
    closes = AHEAD * DT * speed
    assert crowding().predicts_contact([Gap(*pair, closes * 0.999)], qvel)
    assert not crowding().predicts_contact([Gap(*pair, closes * 1.001)], qvel)
    two = Gap(*pair, closes + 0.99 * STILL)
    assert crowding().predicts_contact([two, two], qvel)


@given(
    st.lists(st.tuples(st.integers(-1, 4), st.integers(-1, 4), st.floats(-0.01, 0.02)), max_size=6),
    st.lists(st.floats(-50, 50), min_size=4, max_size=4),
    st.randoms(use_true_random=False),
)
def test_foresight_has_no_order_and_faster_is_never_safer(pairs, speeds, random):
    gaps, qvel = [Gap(*pair) for pair in pairs], np.array(speeds)
    found = crowding().predicts_contact(gaps, qvel)
    random.shuffle(gaps)
    assert crowding().predicts_contact(gaps, -qvel) is found
    assert crowding().predicts_contact([Gap(b, a, d) for a, b, d in gaps], qvel) is found
    if found:
        assert crowding().predicts_contact(gaps, 2 * qvel)
        assert crowding(2 * DT).predicts_contact(gaps, qvel)


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_no_link_outruns_its_reach(name):
    """Every link's origin moves at most as fast as the reach about each joint allows."""
    robot = Robot.load(name)
    spec = SceneSpec(robot.urdf, robot.srdf, robot.joints, DT, PHYSICS["fast"])
    pack = Pack(parse(spec), spec, 1)
    links = link_extents(pack._robots[0])
    arm = ContactPredictor(links, robot.dof, DT)._arm[:-1, WORLD]
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


@pytest.mark.parametrize("physics", ["accurate", "fast"])
def test_a_system_of_its_own_is_like_the_shared_one(physics):
    """Solver, gravity and time step; and what is set on the robot: friction, damping, drive, qf, weightlessness."""
    robot = Robot.load("jaco2")
    spec = SceneSpec(robot.urdf, robot.srdf, robot.joints, DT, PHYSICS[physics], "sapien", gravity=(0.0, 1.0, -3.0))
    pack = Pack(parse(spec), spec, 4, system_size=4)
    pack.write_state(range(4), np.tile(robot.start, (4, 1)), np.full((4, robot.dof), 0.1))
    pack.write_drive(np.array(30.0), np.array(2.0), np.array(9.0))
    pack.write_drive_target(np.tile(robot.start, (4, 1)), np.full((4, robot.dof), 0.3))
    pack.write_qf(np.full((4, robot.dof), 0.5))
    pack.suspend(np.array([False, True, False, False]))
    pack.isolate([0, 1])
    assert pack.isolated.tolist() == [True, True, False, False]
    home, own = pack._systems[2], pack._systems[0]
    assert own is not home
    assert own.timestep == home.timestep == pytest.approx(DT)
    settings = [name for name in dir(home.config) if not name.startswith("_")]
    assert "enable_tgs" in settings
    for name in settings:
        assert np.all(getattr(own.config, name) == getattr(home.config, name)), name
    assert own.config.enable_tgs == (physics == "accurate")
    for row, other in ((0, 2), (1, 3)):
        ours, theirs = pack._robots[row], pack._robots[other]
        for name in ("qpos", "qvel", "qf") if row == 0 else ("qpos", "qvel"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), name)
        for joint, like in zip(ours.active_joints, theirs.active_joints, strict=True):
            for name in ("stiffness", "damping", "force_limit", "drive_mode", "drive_target"):
                assert getattr(joint, name) == getattr(like, name), name
            assert joint.drive_velocity_target == like.drive_velocity_target
            assert joint.friction == like.friction == pytest.approx(0.05)
        for link, like in zip(ours.links, theirs.links, strict=True):
            assert link.mass == like.mass
            assert link.linear_damping == like.linear_damping == pytest.approx(0.05)
            assert link.disable_gravity == (row == 1)
    for _ in range(20):
        pack.step()
    qpos = pack.read_qpos()
    assert np.abs(qpos[0] - robot.start).max() > 1e-3
    np.testing.assert_allclose(qpos[0], qpos[2], atol=1e-5)
    pack.close()


def test_leaving_before_the_touch_changes_no_path(monkeypatch):
    """What the engine remembers of a contact would be lost with it; so robots leave before there is one."""
    robot, left = Robot.load("panda"), []
    moves = contact_moves(robot, 2)
    move = Pack._move
    monkeypatch.setattr(Pack, "_move", lambda pack, systems: (left.extend(systems), move(pack, systems)))
    ours = follow(robot, moves, 1500, PHYSICS["fast"])
    assert sorted(left) == [0, 1]
    monkeypatch.setattr(ContactPredictor, "predicts_contact", lambda *_: False)
    theirs = follow(robot, moves, 1500, PHYSICS["fast"])
    assert len(left) == 2
    np.testing.assert_allclose(ours, theirs, atol=2e-3)
