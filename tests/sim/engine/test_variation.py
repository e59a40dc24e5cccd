"""Varied packs: a live robot that changes moves as a fresh one, and has the inertia and weight of its drawn masses."""

import dataclasses
from xml.etree import ElementTree

import numpy as np
import pytest
from robots import load_bundled

import batchpid.task_space as ts
from batchpid.sim.engine.physics import PHYSICS
from batchpid.sim.engine.protocol import SceneSpec, Variation
from batchpid.sim.engine.robot_model import scene_tree
from batchpid.sim.engine.sapien.pack import Pack

STEPS = 120


def spec_of(robot, physics="accurate"):
    return SceneSpec(
        urdf=robot.urdf, ignored=robot.ignored_pairs, joints=robot.joints, timestep=1 / 2000, physics=PHYSICS[physics]
    )


def links_of(robot):
    return [link.name for link in robot.links]


def random_variation(robot, seed, rows=1):
    rng, dof = np.random.default_rng(seed), robot.dof
    return Variation(
        payload=rng.uniform(0, 1, rows),
        link_mass=rng.uniform(0.5, 2, (rows, len(robot.links))),
        center_of_mass=rng.uniform(-0.02, 0.02, (rows, 3 * len(robot.links))),
        friction=rng.uniform(0, 1, (rows, dof)),
        damping=rng.uniform(0, 1, (rows, dof)),
        armature=rng.uniform(0, 0.1, (rows, dof)),
        ground_friction=rng.uniform(0.1, 1, rows),
        gravity=rng.uniform(-1, 1, (rows, 3)) - [0, 0, 9.81],
    )


def make(robot, variation, rows=1, spec=None):
    carrier = "panda_hand" if "panda" in robot.name else "j2s7s300_link_7"
    return Pack(spec or spec_of(robot), rows, 0, variation, carrier, links_of(robot))


def swing(pack, robot, steps=STEPS, seed=0):
    """Place the robots and push them at random; return their motion."""
    rng, rows = np.random.default_rng(seed), pack.size
    pack.write_state(range(rows), np.tile(robot.start, (rows, 1)), np.zeros((rows, robot.dof)))
    seen = []
    for _ in range(steps):
        pack.write_qf(pack.passive_force(True, True) + rng.uniform(-1, 1, (1, robot.dof)))
        pack.step()
        seen.append(np.concatenate([pack.read_qpos(), pack.read_qvel()], 1))
    return np.array(seen)


@pytest.mark.parametrize(("name", "collisions"), [("panda", True), ("jaco2", True), ("panda", False)])
def test_a_live_robot_that_changes_moves_as_a_fresh_one(name, collisions):
    robot = load_bundled(name)
    spec = dataclasses.replace(spec_of(robot), collisions=collisions)
    fresh = swing(make(robot, random_variation(robot, 1), spec=spec), robot)
    changed = make(robot, random_variation(robot, 2), spec=spec)
    assert np.abs(swing(changed, robot) - fresh).max() > 1e-3
    for seed in (3, 1):
        changed.vary([0], random_variation(robot, seed))
        changed.write_joints(None, [0])
    np.testing.assert_array_equal(swing(changed, robot), fresh)


def test_a_robot_that_changes_leaves_the_others_of_its_pack_alone(panda):
    both, first = random_variation(panda, 1, 2), random_variation(panda, 1, 2)
    expected = swing(make(panda, both, 2), panda)
    pack = make(panda, Variation(*(rows.copy() for rows in first)), 2)
    swing(pack, panda)
    pack.vary([1], random_variation(panda, 5))
    pack.write_joints(None, [1])
    np.testing.assert_array_equal(swing(pack, panda)[:, 0], expected[:, 0])


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_mass_matrix_and_gravity_are_proportional_to_the_masses(name):
    robot = load_bundled(name)
    twice = make(robot, Variation(link_mass=np.full((1, len(robot.links)), 2.0)))
    plain, varied = Pack(spec_of(robot), 1), twice.robots[0]
    for pack in (plain, twice):
        pack.write_state([0], robot.start[None], np.zeros((1, robot.dof)))
    once = plain.robots[0]
    np.testing.assert_allclose(
        varied.compute_passive_force(True, False), 2 * once.compute_passive_force(True, False), rtol=1e-4, atol=1e-5
    )
    matrices = [
        np.array(each.create_pinocchio_model().compute_generalized_mass_matrix(robot.start)) for each in (once, varied)
    ]
    np.testing.assert_allclose(matrices[1], 2 * matrices[0], rtol=1e-4, atol=2e-6)


@pytest.mark.parametrize("fixed_base", [True, False])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_centers_of_mass_are_displaced_along_the_axes_of_their_links(name, fixed_base):
    """Equal to a robot whose URDF has them there."""
    robot, rng = load_bundled(name), np.random.default_rng(0)
    moved = rng.uniform(-0.05, 0.05, (len(robot.links), 3))
    urdf = ElementTree.fromstring(robot.urdf)
    for link, displacement in zip(robot.links, moved, strict=True):
        element = urdf.find(f"link[@name='{link.name}']/inertial")
        if element is not None:
            origin = element.find("origin")
            origin = ElementTree.SubElement(element, "origin", xyz="0 0 0") if origin is None else origin
            center = np.array(origin.get("xyz", "0 0 0").split(), float) + displacement
            origin.set("xyz", " ".join(map(repr, center.tolist())))
    spec = dataclasses.replace(spec_of(robot), fixed_base=fixed_base)
    edited = scene_tree(dataclasses.replace(spec, urdf=ElementTree.tostring(urdf, encoding="unicode")))
    pack = make(robot, Variation(center_of_mass=moved.reshape(1, -1)), spec=spec)
    model, still = pack.robots[0].create_pinocchio_model(), np.zeros((1, robot.dof))
    for qpos in rng.uniform(robot.lower.clip(-3), robot.upper.clip(None, 3), (5, 1, robot.dof)):
        np.testing.assert_allclose(pack.joint_mass_matrix(qpos), ts.mass_matrix(edited, qpos), rtol=1e-4, atol=1e-6)
        weight = model.compute_inverse_dynamics(qpos[0], still[0], still[0])
        np.testing.assert_allclose(weight, ts.gravity(edited.held, qpos)[0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_the_mass_matrix_is_that_of_the_varied_robot(name):
    robot, rng = load_bundled(name), np.random.default_rng(0)
    pack = make(robot, random_variation(robot, 0, 2), 2)
    pack.vary([1], random_variation(robot, 3))
    qpos = rng.uniform(robot.lower.clip(-3), robot.upper.clip(None, 3), (2, robot.dof))
    for each, position, matrix in zip(pack.robots, qpos, pack.joint_mass_matrix(qpos), strict=True):
        expected = np.array(each.create_pinocchio_model().compute_generalized_mass_matrix(position))
        np.testing.assert_allclose(matrix, expected, rtol=1e-5, atol=1e-6)


def test_the_controller_compensates_the_model(panda):
    """A robot with twice the mass sinks under the efforts that hold the model."""
    heavy, plain = make(panda, Variation(link_mass=np.full((1, len(panda.links)), 2.0))), Pack(spec_of(panda), 1)
    for pack in (heavy, plain):
        pack.write_state([0], panda.start[None], np.zeros((1, panda.dof)))
    np.testing.assert_allclose(heavy.passive_force(True, True), plain.passive_force(True, True), atol=1e-4)
