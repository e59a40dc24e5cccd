"""Contact prediction: which robots get a PhysX system to themselves, and the state they keep."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import load_bundled
from scripts import load_script

from batchpid.sim import Runner
from batchpid.sim.engine.link_reach import LinkExtent
from batchpid.sim.engine.sapien.building import build_scene, new_system
from batchpid.sim.engine.sapien.contact_prediction import (
    LISTED_DISTANCE,
    LOOKAHEAD_STEPS,
    MAX_ACCELERATION,
    STEP_FACTOR,
    WORLD,
    ContactPredictor,
    NearPair,
    SafeRegions,
)
from batchpid.sim.engine.sapien.dynamics import scene_dynamics
from batchpid.sim.engine.sapien.extents import link_extents, touching_pairs
from batchpid.sim.engine.sapien.pack import Pack
from batchpid.sim.engine.sapien.physics import PHYSICS
from batchpid.sim.engine.scene_spec import SceneSpec

DT = 1 / 2000


def shifted(offset):
    """Return the pose (4, 4) of a joint that is ``offset`` away, across the axis."""
    pose = np.eye(4)
    pose[1, 3] = offset
    return pose


# A base, an arm that turns, and on it two fingers that slide and one that turns.
LINKS = [
    LinkExtent(parent, dof, slides, shifted(offset), np.eye(4), 0.0, np.array([[0.0, 0.0, 0.0, radius]]))
    for parent, dof, slides, offset, radius in (
        (None, None, False, 0.0, 0.1),
        (0, 0, False, 0.3, 0.2),
        (1, 1, True, 0.1, 0.05),
        (1, 2, True, 0.1, 0.05),
        (1, 3, False, 0.1, 0.04),
    )
]
PAIRS = [(0, 2), (0, 3), (0, 4), (2, 3), (2, 4), (3, 4), *((link, WORLD) for link in range(5))]
FROM_REST = MAX_ACCELERATION * DT * LOOKAHEAD_STEPS * DT
"""Distance that may close from rest [m]."""


def predicts_contact(pairs, qvel, timestep=DT):
    return ContactPredictor(LINKS, PAIRS, 4, timestep).predicts_contact(
        [NearPair(*pair) for pair in pairs], np.array(qvel)
    )


@pytest.mark.parametrize(("far", "expected"), [(0.9, True), (1.1, False)])
def test_from_rest_two_near_pairs_predict_contact(far, expected):
    pairs = [(2, 3, 0.5 * FROM_REST), (2, WORLD, far * FROM_REST)]
    assert predicts_contact(pairs, np.zeros(4)) == expected
    assert not predicts_contact(pairs[:1], np.zeros(4))


def test_a_pair_in_contact_predicts_contact():
    assert predicts_contact([(2, 3, 0.0)], np.zeros(4))
    assert not predicts_contact([], np.full(4, 1e3))


@pytest.mark.parametrize(
    ("links", "reach"),
    [
        ((2, 3), (0.0, 1.0, 1.0, 0.0)),  # the joint above both moves both equally
        ((2, WORLD), (0.3 + 0.05 - 0.2, 1.0, 0.0, 0.0)),
        ((1, 4), (0.0, 0.0, 0.0, 0.04)),
        ((0, 1), (0.2, 0.0, 0.0, 0.0)),
    ],
)
def test_a_pair_closes_as_fast_as_the_joints_between_its_links_move(links, reach):
    """A link turns about a joint with its farthest point, a sliding joint's full travel away."""
    qvel = np.array([1.0, -2.0, 3.0, -4.0])
    closes = LOOKAHEAD_STEPS * DT * float(np.abs(qvel) @ reach)
    assert predicts_contact([(*links, closes * 0.999)], qvel)
    assert not predicts_contact([(*links, closes * 1.001)], qvel)
    assert predicts_contact([(*links, closes + 0.99 * FROM_REST)] * 2, qvel)


@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.integers(-1, 4), st.integers(-1, 4), st.floats(-0.01, 0.02)), max_size=6),
    st.lists(st.floats(-50, 50), min_size=4, max_size=4),
    st.randoms(use_true_random=False),
)
def test_prediction_has_no_order_and_more_speed_predicts_no_less(pairs, qvel, random):
    qvel = np.array(qvel)
    found = predicts_contact(pairs, qvel)
    random.shuffle(pairs)
    assert predicts_contact(pairs, -qvel) is found
    assert predicts_contact([(b, a, distance) for a, b, distance in pairs], qvel) is found
    if found:
        assert predicts_contact(pairs, 2 * qvel)
        assert predicts_contact(pairs, qvel, 2 * DT)


def reach_between(predictor: ContactPredictor, first: int, second: int) -> np.ndarray:
    """Return how fast two links close per unit of each joint's speed: a joint above both moves both equally."""
    a, b = predictor.reach[first], predictor.reach[second]
    return np.where((a > 0) != (b > 0), a + b, 0.0)


@settings(max_examples=40)
@given(
    st.lists(
        st.tuples(st.sampled_from([(2, 3), (2, 4), (3, WORLD), (0, 4)]), st.floats(1e-4, LISTED_DISTANCE)), max_size=4
    ),
    *(st.lists(st.floats(-1, 1), min_size=4, max_size=4) for _ in range(3)),
    st.floats(0, 0.999),
)
def test_no_contact_is_predicted_within_a_region(near, qvel, moved, step, share):
    """Pairs close as fast as they can, those that were not listed from LISTED_DISTANCE on."""
    predictor, qvel = ContactPredictor(LINKS, PAIRS, 4, DT), np.array(qvel)
    pairs = [NearPair(*links, distance) for links, distance in near]
    if not pairs or predictor.predicts_contact(pairs, qvel):
        return
    touching = np.zeros((len(LINKS), 4, 4))  # so that balls around the links say nothing
    sizes, regions = predictor.region(pairs, qvel, lambda: touching), SafeRegions(1, predictor.arms)
    if sizes is None:
        return
    regions.enter(0, np.zeros(4), sizes)
    moved, step = np.array(moved), np.array(step)
    used = (predictor.arms @ (np.abs(moved + step) + STEP_FACTOR * np.abs(step)) / sizes).max()
    if used > 0:
        moved, step = share / used * moved, share / used * step
    regions.left(moved[None])
    if regions.left((moved + step)[None]):
        return  # the step to ``moved`` was too large to count
    unlisted = [(2, 3), (2, 4), (3, 4), (0, 4), (1, WORLD), (2, WORLD)]
    later = [
        NearPair(a, b, distance - reach_between(predictor, a, b) @ (np.abs(moved) + DT * np.abs(qvel)))
        for a, b, distance in [*pairs, *((*links, LISTED_DISTANCE) for links in unlisted)]
    ]
    assert not predictor.predicts_contact([pair for pair in later if pair.distance < LISTED_DISTANCE], step / DT)


def test_a_region_ends_where_a_joint_has_moved_by_its_weight():
    regions = SafeRegions(3, np.array([[10.0, 0.0], [0.0, 3.0]]))
    regions.enter(1, np.array([0.5, 0.0]), np.ones(2))
    qpos = np.array([[9.0, 9.0], [0.5, 0.0], [np.nan, 0.0]])
    assert regions.any
    assert regions.left(qpos) == []
    qpos[1, 0] += 0.5 / (10 * (1 + STEP_FACTOR))
    assert regions.left(qpos) == []
    qpos[1, 0] += 0.11
    assert regions.left(qpos) == [1]
    regions.drop([1])
    assert not regions.any
    assert regions.left(qpos) == []


@pytest.mark.parametrize("physics", ["accurate", pytest.param("fast", marks=pytest.mark.slow)])
def test_regions_change_no_prediction(physics, panda, monkeypatch):
    """Limp robots that fall, looked at in every step and only where they leave their regions."""
    spec = SceneSpec(panda.urdf, panda.srdf, panda.joints, DT, PHYSICS[physics])
    runs, looks = [], [0]
    predicts = ContactPredictor.predicts_contact

    def count(*arguments):
        looks[-1] += 1
        return predicts(*arguments)

    monkeypatch.setattr(ContactPredictor, "predicts_contact", count)
    for enter in (SafeRegions.enter, lambda *_: None):
        monkeypatch.setattr(SafeRegions, "enter", enter)
        looks.append(0)
        pack = Pack(spec, 4, system_size=4)
        pack.write_state(range(4), panda.sample(4, seed=2), np.zeros((4, panda.dof)))
        isolated = []
        for _ in range(800):
            pack.step()
            isolated.append(pack.isolated.copy())
        runs.append((np.array(isolated), pack.read_qpos()))
    assert 0 < runs[0][0].sum() < runs[0][0].size
    for ours, theirs in zip(*runs, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert looks[1] < looks[2]


def test_a_closed_gripper_at_rest_needs_no_look(panda, monkeypatch):
    spec = SceneSpec(panda.urdf, panda.srdf, panda.joints, DT, PHYSICS["fast"])
    pack = Pack(spec, 2, system_size=2)
    pack.write_state(range(2), np.tile(panda.start, (2, 1)), np.zeros((2, panda.dof)))
    looks = []
    monkeypatch.setattr(ContactPredictor, "predicts_contact", lambda *arguments: looks.append(arguments))
    for _ in range(100):
        pack.write_qf(pack.passive_force(True, True))
        pack.step()
    assert pack.systems[0].get_contacts()
    assert not looks
    assert not pack.isolated.any()


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_pairs_that_the_engine_lists_may_touch_and_are_no_nearer_than_their_balls(name):
    """At sampled poses: a region counts on both where a pair is not listed."""
    robot = load_bundled(name)
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, DT, PHYSICS["fast"])
    _scene, built = build_scene(spec, new_system(spec))
    pairs, model = touching_pairs(built, ground=True), scene_dynamics(spec)
    predictor = ContactPredictor(link_extents(built), pairs, robot.dof, DT)
    pairs = [pair for pair in pairs if (predictor.reach[list(pair)] > 0).any()]
    seen = 0
    for qpos in robot.sample(200, seed=0):
        apart = predictor.distances(model.link_poses(qpos))
        for first, second, distance in model.near_pairs(qpos):
            pair = next(pair for pair in ((first, second), (second, first)) if pair in pairs)
            assert apart[pairs.index(pair)] <= distance + 1e-5
            seen += 1
    assert seen > 10


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_balls_cover_the_shapes(name):
    robot = load_bundled(name)
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, DT, PHYSICS["fast"])
    _scene, built = build_scene(spec, new_system(spec))
    for link, extent in zip(built.links, link_extents(built), strict=True):
        if link.collision_shapes:
            pose = link.entity_pose.to_transformation_matrix()
            centers, radii = extent.balls[:, :3] @ pose[:3, :3].T + pose[:3, 3], extent.balls[:, 3:]
            low, high = link.compute_global_aabb_tight()
            assert ((centers - radii).min(0) <= low + 1e-5).all()
            assert ((centers + radii).max(0) >= high - 1e-5).all()


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_no_link_is_faster_than_its_reach_allows(name):
    robot = load_bundled(name)
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, DT, PHYSICS["fast"])
    _scene, built = build_scene(spec, new_system(spec))
    extents, poses = link_extents(built), scene_dynamics(spec).link_poses
    reach = ContactPredictor(extents, (), robot.dof, DT).reach[:-1]

    def surface(qpos):
        """Return points on each link's balls, farthest along x, y and z."""
        return [
            [(extent.balls[:, :3] + extent.balls[:, 3:] * side) @ pose[:3, :3].T + pose[:3, 3] for side in np.eye(3)]
            for extent, pose in zip(extents, poses(qpos), strict=True)
        ]

    rng, tiny = np.random.default_rng(0), 1e-4
    for qpos in robot.sample(50, seed=0):
        qvel = rng.normal(size=robot.dof) * (rng.random(robot.dof) < 0.3)
        moved = zip(surface(qpos + tiny * qvel), surface(qpos - tiny * qvel), strict=True)
        speed = np.array([np.linalg.norm(np.subtract(a, b), axis=-1).max(initial=0.0) / (2 * tiny) for a, b in moved])
        assert (speed <= reach @ np.abs(qvel) * (1 + 1e-3) + 1e-3).all()
        assert (reach @ np.abs(qvel) < 20 * speed.max() + 1e-3).all()  # the bound is of the order of the speed


@pytest.mark.parametrize("physics", ["accurate", "fast"])
def test_an_isolated_robot_keeps_its_state_and_settings(physics, jaco2):
    """Solver, gravity and time step of the system; friction, damping, drives, qf and suspension of the robot."""
    robot = jaco2
    spec = SceneSpec(
        robot.urdf, robot.ignored_pairs, robot.joints, DT, PHYSICS[physics], "sapien", gravity=(0.0, 1.0, -3.0)
    )
    pack = Pack(spec, 4, system_size=4)
    pack.write_state(range(4), np.tile(robot.start, (4, 1)), np.full((4, robot.dof), 0.1))
    pack.write_drive(np.array(30.0), np.array(2.0), np.array(9.0))
    pack.write_drive_target(np.tile(robot.start, (4, 1)), np.full((4, robot.dof), 0.3))
    pack.write_qf(np.full((4, robot.dof), 0.5))
    pack.suspend(np.array([False, True, False, False]))
    pack.isolate([0, 1])
    assert pack.isolated.tolist() == [True, True, False, False]
    shared, own = pack.systems[2], pack.systems[0]
    assert own is not shared
    assert own.timestep == shared.timestep == pytest.approx(DT)
    settings = [name for name in dir(shared.config) if not name.startswith("_")]
    assert "enable_tgs" in settings
    for name in settings:
        assert np.all(getattr(own.config, name) == getattr(shared.config, name)), name
    assert own.config.enable_tgs == (physics == "accurate")
    for row, other in ((0, 2), (1, 3)):
        ours, theirs = pack.robots[row], pack.robots[other]
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


@pytest.mark.slow
def test_isolation_before_contact_does_not_change_the_path(panda, packs, monkeypatch):
    """A robot that is rebuilt in contact would lose the engine's contact cache."""
    moves, runs = load_script("accuracy").contact_moves(panda, 2), []
    for isolated in (2, 0):
        with Runner(panda, 2, workers=0, params=panda.tuned(), physics="fast", pack_size=2) as runner:
            runner.reset(moves.start)
            runs.append(runner.rollout(np.broadcast_to(moves.target, (75, *moves.target.shape))))
            assert packs.isolated() == isolated
        monkeypatch.setattr(ContactPredictor, "predicts_contact", lambda *_: False)
    np.testing.assert_allclose(runs[0].qpos, runs[1].qpos, atol=2e-3)
