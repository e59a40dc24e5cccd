"""Varied packs: a live robot that changes moves as a fresh one, and has the inertia and weight of its drawn masses."""

import numpy as np
import pytest
from robots import load_bundled

from sim.engine.building import SceneSpec
from sim.engine.pack import Pack
from sim.engine.physics import PHYSICS
from sim.engine.variation import Variation, VariedPack

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
        friction=rng.uniform(0, 1, (rows, dof)),
        damping=rng.uniform(0, 1, (rows, dof)),
        armature=rng.uniform(0, 0.1, (rows, dof)),
    )


def make(robot, variation, rows=1):
    carrier = "panda_hand" if "panda" in robot.name else "j2s7s300_link_7"
    return VariedPack(spec_of(robot), rows, 0, rows, variation, carrier, links_of(robot))


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


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_a_live_robot_that_changes_moves_as_a_fresh_one(name):
    robot = load_bundled(name)
    fresh = swing(make(robot, random_variation(robot, 1)), robot)
    changed = make(robot, random_variation(robot, 2))
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


def test_the_controller_compensates_the_model(panda):
    """A robot with twice the mass sinks under the efforts that hold the model."""
    heavy, plain = make(panda, Variation(link_mass=np.full((1, len(panda.links)), 2.0))), Pack(spec_of(panda), 1)
    for pack in (heavy, plain):
        pack.write_state([0], panda.start[None], np.zeros((1, panda.dof)))
    np.testing.assert_allclose(heavy.passive_force(True, True), plain.passive_force(True, True), atol=1e-4)
    assert (heavy.joint_mass_matrix(panda.start[None]) == plain.joint_mass_matrix(panda.start[None])).all()
    light = make(panda, Variation(link_mass=np.linspace(0.25, 3, len(panda.links))[None]))
    np.testing.assert_allclose(
        light.joint_mass_matrix(panda.start[None]), 0.25 * plain.joint_mass_matrix(panda.start[None])
    )
