"""Robots have the dynamics of their URDF as MuJoCo reads it, with drawn masses too, and both
engines obey them.
"""

from concurrent.futures import ThreadPoolExecutor
from xml.etree import ElementTree

import jax
import mujoco
import numpy as np
import pytest
from tiny_urdf import random_tree, robot, write

import batchpid.task_space as ts
from batchpid.sim import Randomization, Robot, Runner, Uniform
from batchpid.sim.robot.robot_model import link_tree

ENGINES = ("sapien", "mujoco")
FREE = {"control": "effort", "compensate": "none", "ground": False, "workers": 0}


def load(name, folder, **options):
    """Return a bundled robot, or for a number one of twelve links, with fixed joints."""
    if isinstance(name, str):
        return Robot.load(name, **options)
    path = write(folder, robot(*random_tree(np.random.default_rng(name), 12)))
    return Robot.load(path, **options)


def own_model(arm):
    """Return MuJoCo's reading of the robot's URDF, and the columns of its joints."""
    spec = mujoco.MjSpec.from_file(str(arm.path))
    for geom in spec.geoms:
        spec.delete(geom)
    if not arm.fixed_base:
        spec.worldbody.first_body().add_freejoint()
    model = spec.compile()
    return model, np.array([model.joint(name).dofadr[0] for name in arm.joint_names])


def mass_matrix(arm, qpos):
    """Return the mass matrix of the joints, whose base may yield."""
    return ts.mass_matrix(link_tree(arm), np.atleast_2d(qpos))[0]


def states(arm, rows=5):
    rng = np.random.default_rng(0)
    qpos = rng.uniform(np.maximum(arm.lower, -3), np.minimum(arm.upper, 3), (rows, arm.dof))
    return qpos, *rng.normal(size=(2, rows, arm.dof))


@pytest.mark.parametrize("fixed_base", [True, False])
@pytest.mark.parametrize("name", ["panda", "jaco2", 0, 1, 2, 3])
def test_the_dynamics_are_mujocos(name, fixed_base, tmp_path):
    """On a free base the joints have less inertia: the base yields."""
    arm = load(name, tmp_path, fixed_base=fixed_base)
    model, joints = own_model(arm)
    data, dynamics = mujoco.MjData(model), arm.dynamics(ground=False)
    base = np.setdiff1d(np.arange(model.nv), joints)
    for qpos, qvel, qacc in zip(*states(arm), strict=True):
        data.qpos[[model.jnt_qposadr[model.dof_jntid[column]] for column in joints]] = qpos
        data.qvel[joints], data.qacc[joints] = qvel, qacc
        mujoco.mj_inverse(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        yields = np.linalg.solve(full[np.ix_(base, base)], full[np.ix_(base, joints)])
        matrix = full[np.ix_(joints, joints)] - full[np.ix_(joints, base)] @ yields
        at = qpos[None], qvel[None]
        np.testing.assert_allclose(
            mass_matrix(arm, qpos), matrix, rtol=0, atol=1e-10 * np.abs(matrix).max()
        )
        if fixed_base:
            effort = full @ data.qacc + data.qfrc_bias
            effort = effort[joints]
            ours = dynamics.inverse_dynamics(*at, qacc[None])
            np.testing.assert_allclose(ours[0], effort, rtol=0, atol=1e-9 * np.abs(effort).max())
            np.testing.assert_allclose(
                dynamics.forward_dynamics(*at, ours)[0], qacc, rtol=0, atol=1e-7
            )


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("fixed_base", [True, False])
@pytest.mark.parametrize("name", ["panda", 2])
def test_a_sim_step_obeys_the_mass_matrix(name, fixed_base, engine, tmp_path):
    """The change of velocity by an effort, without the fall that all robots share, is M^-1 u dt."""
    arm = load(name, tmp_path, fixed_base=fixed_base)
    pose = np.clip(arm.start, arm.lower + 0.01, arm.upper - 0.01)
    matrix = mass_matrix(arm, pose)
    efforts = np.vstack([np.zeros(arm.dof), np.diag(np.diagonal(matrix))])
    with Runner(arm, len(efforts), engine=engine, substeps=1, **FREE) as runner:
        runner.reset(pose)
        qvel = runner.step(efforts).qvel.astype(float)
    accelerations = (qvel[1:] - qvel[0]) / runner.timestep
    np.testing.assert_allclose(
        accelerations @ matrix, efforts[1:], rtol=0, atol=5e-3 * efforts.max()
    )


def edited(arm, change):
    """Return the URDF of a robot whose links ``change(link, inertial)`` has edited."""
    urdf = ElementTree.fromstring(arm.path.read_text())
    for number, link in enumerate(urdf.findall("link")):
        if (inertial := link.find("inertial")) is not None:
            change(number, inertial)
    return ElementTree.tostring(urdf, encoding="unicode")


def scale(inertial, factor):
    inertial.find("mass").set("value", str(factor * float(inertial.find("mass").get("value"))))
    tensor = inertial.find("inertia")
    for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
        tensor.set(key, str(factor * float(tensor.get(key))))


def shift(inertial, by):
    origin = inertial.find("origin")
    origin = ElementTree.SubElement(inertial, "origin", xyz="0 0 0") if origin is None else origin
    center = np.array(origin.get("xyz", "0 0 0").split(), float) + by
    origin.set("xyz", " ".join(map(repr, center.tolist())))


WORLDS = {
    "masses": (
        {"link_mass": Uniform(1.7, 1.7, operation="scale")},
        lambda number, inertial: scale(inertial, 1.7),
    ),
    "centers": (
        {"center_of_mass": Uniform(0.03, 0.03)},
        lambda number, inertial: shift(inertial, [0.03] * 3),
    ),
}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("fixed_base", [True, False])
@pytest.mark.parametrize("world", WORLDS)
def test_a_robot_of_drawn_masses_moves_as_one_whose_urdf_has_them(
    world, fixed_base, engine, tmp_path
):
    drawn, change = WORLDS[world]
    arm = load(1, tmp_path, fixed_base=fixed_base)
    other = Robot.load(write(tmp_path, edited(arm, change), "other.urdf"), fixed_base=fixed_base)
    efforts, runs = np.tile(np.linspace(-9.0, 9.0, arm.dof), (20, 1)), []
    for each, options in ((arm, {"randomization": Randomization(**drawn)}), (other, {}), (arm, {})):
        with Runner(each, 1, engine=engine, substeps=10, **FREE, **options) as runner:
            runs.append(runner.rollout(efforts).qpos)
    np.testing.assert_allclose(runs[0], runs[1], rtol=0, atol=1e-4)
    assert np.abs(runs[0] - runs[2]).max() > 2e-3


def test_the_controller_compensates_the_model_and_not_the_drawn_masses(panda):
    """A robot with twice the mass sinks under the efforts that hold the model."""
    fallen = []
    for factor in (1.0, 2.0):
        drawn = Randomization(link_mass=Uniform(factor, factor, operation="scale"))
        with Runner(panda, 1, workers=0, control="effort", randomization=drawn) as runner:
            fallen.append(
                np.abs(runner.rollout(np.zeros((50, panda.dof))).qpos[-1] - panda.start).max()
            )
    assert fallen[0] < 1e-3
    assert fallen[1] > 0.05


def test_dynamics_give_every_thread_its_own_results(panda):
    dynamics, poses = panda.dynamics(), panda.sample(80)

    def figures(qpos):
        return dynamics.in_contact(qpos), dynamics.mass_matrix(qpos)

    parts = np.array_split(poses, 4)
    with ThreadPoolExecutor(4) as threads:
        for alone, shared in zip(map(figures, parts), threads.map(figures, parts), strict=True):
            for one, other in zip(alone, shared, strict=True):
                np.testing.assert_array_equal(one, other)


def test_dynamics_take_arrays_of_jax():
    """In JAX's usual float32, compiled."""
    dynamics = Robot.load("panda").dynamics()
    qpos = np.full((2, 9), 0.3)
    for quantity in (dynamics.forward_dynamics, dynamics.inverse_dynamics):
        expected = quantity(qpos, qpos, qpos)
        found = jax.jit(quantity)(qpos, qpos, qpos)
        assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()
