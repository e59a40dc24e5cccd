"""The rigid tree of a robot has the dynamics of SAPIEN's Pinocchio and of MuJoCo, on a fixed and on a floating base."""

from __future__ import annotations

import numpy as np
import pytest
from robots import load_bundled
from tiny_urdf import random_tree, robot, write

import batchpid as bp
import batchpid.task_space as ts
from batchpid.sim import OperationalSpace, Robot, Runner
from batchpid.sim.engine.physics import PHYSICS
from batchpid.sim.engine.protocol import SceneSpec, load_engine
from batchpid.sim.engine.robot_model import passive_force, scene_tree
from batchpid.sim.engine.sapien.building import build_scene, new_system
from batchpid.sim.identification.logged_control import LoggedDrive
from batchpid.sim.identification.plant import Plant
from batchpid.task_space import osc_state, tree_dynamics

NAMES = ["panda", "jaco2", 0, 1, 2, 3]


def load(name, folder, **options):
    """Return a bundled robot, or for a number one of twelve links, with fixed joints, merged for even numbers."""
    if isinstance(name, str):
        return Robot.load(name, **options) if options else load_bundled(name)
    path = write(folder, robot(*random_tree(np.random.default_rng(name), 12)))
    return Robot.load(path, merge_fixed=name % 2 == 0, **options)


def spec_of(arm, engine="sapien", physics=PHYSICS["fast"]):
    options = {"merge_fixed": arm.merge_fixed, "fixed_base": arm.fixed_base, "ground": False, "engine": engine}
    return SceneSpec(arm.urdf, arm.ignored_pairs, arm.joints, 1e-3, physics, **options)


def states(arm, rows=20):
    rng = np.random.default_rng(0)
    qpos = rng.uniform(np.maximum(arm.lower, -3), np.minimum(arm.upper, 3), (rows, arm.dof))
    return qpos, *rng.normal(size=(2, rows, arm.dof))


def close(ours, theirs, tolerance):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * np.abs(theirs).max())


@pytest.mark.parametrize("name", NAMES)
def test_the_dynamics_are_pinocchios(name, tmp_path):
    arm = load(name, tmp_path)
    spec, (qpos, qvel, qacc) = spec_of(arm), states(arm)
    _scene, built = build_scene(spec, new_system(spec))
    theirs = built.create_pinocchio_model()
    tree = scene_tree(spec).held
    matrices = [theirs.compute_generalized_mass_matrix(row) for row in qpos]
    close(ts.mass_matrix(tree, qpos), matrices, 1e-12)
    close(arm.mass_matrix(qpos), matrices, 1e-4)  # SAPIEN keeps masses and places in single precision
    efforts = [theirs.compute_inverse_dynamics(*rows) for rows in zip(qpos, qvel, qacc, strict=True)]
    close(ts.inverse_dynamics(tree, qpos, qvel, qacc), efforts, 1e-12)
    close(ts.forward_dynamics(scene_tree(spec), qpos, qvel, np.array(efforts)), qacc, 1e-6)
    poses = ts.link_poses(scene_tree(spec), qpos, [link.name for link in built.links])
    for row, ours in zip(qpos, poses, strict=True):
        theirs.compute_forward_kinematics(row)
        for number, pose in enumerate(ours):
            at = theirs.get_link_pose(number)
            np.testing.assert_allclose(pose[:3], at.p, atol=1e-6)
            assert abs(pose[3:] @ at.q) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("native", ["0", "1"])
@pytest.mark.parametrize("fixed_base", [True, False])
@pytest.mark.parametrize("name", NAMES)
def test_the_dynamics_are_mujocos(name, fixed_base, native, tmp_path, monkeypatch):
    mujoco = pytest.importorskip("mujoco", "3.17")
    monkeypatch.setenv("BATCHPID_NATIVE", native)
    arm = load(name, tmp_path, fixed_base=fixed_base)
    engine = load_engine("mujoco")
    spec, (qpos, qvel, _) = spec_of(arm, "mujoco", engine.physics["fast"]), states(arm, 4)
    pack = engine.make_pack(spec, len(qpos))
    pack.write_state(range(len(qpos)), qpos, qvel)
    turning = None if fixed_base else np.random.default_rng(1).normal(size=(len(qpos), 3))
    tree, joints = scene_tree(spec), pack._robot.qvel
    matrices, forces, held = [], [], []
    for row, (model, data) in enumerate(zip(pack.models, pack._data, strict=True)):
        if turning is not None:
            data.qvel[3:6] = turning[row]
        mujoco.mj_step1(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        full[joints, joints] -= model.dof_armature[joints]
        base = np.setdiff1d(np.arange(model.nv), joints)
        falls = np.linalg.solve(full[np.ix_(base, base)], full[np.ix_(base, joints)])
        matrices.append(full[np.ix_(joints, joints)] - full[np.ix_(joints, base)] @ falls)
        forces.append(data.qfrc_bias[joints] - falls.T @ data.qfrc_bias[base])
        held.append(data.qfrc_bias[joints].copy())
    close(ts.mass_matrix(tree, qpos), matrices, 1e-12)
    motion = None if fixed_base else np.hstack([np.tile(spec.gravity, (len(qpos), 1)), turning])
    close(passive_force(tree, qpos, qvel, True, True, motion), forces, 1e-12)
    close(passive_force(tree.held, qpos, qvel, True, True, motion), held, 1e-12)
    close(pack.joint_mass_matrix(qpos), matrices, 1e-12)
    close(pack.passive_force(True, True), held, 1e-12)


def test_masses_that_differ_are_those_of_another_tree(tmp_path):
    """Spatial inertias added to links, in the model of the robots and as a robot of its own."""
    arm = load(0, tmp_path, fixed_base=False)
    tree, rng = arm.rigid_tree, np.random.default_rng(0)
    factors = rng.uniform(0.5, 2, (3, len(tree.links)))
    qpos, qvel, _ = states(arm, 3)
    added = {
        name: (factors[:, index, None, None] - 1) * matrix_of_link(tree, index) for index, name in enumerate(tree.links)
    }
    bodies = tree.varied(added)
    for row, factor in enumerate(factors):
        heavier = type(tree)(
            **{
                **{field: getattr(tree, field) for field in tree.__dataclass_fields__ if field != "_"},
                "mass": factor * tree.mass,
                "inertia": factor[:, None, None] * tree.inertia,
            }
        )
        at = slice(row, row + 1)
        close(ts.mass_matrix(tree, qpos, bodies)[at], ts.mass_matrix(heavier, qpos[at]), 1e-12)
        close(ts.bias(tree, qpos, qvel, bodies=bodies)[at], ts.bias(heavier, qpos[at], qvel[at]), 1e-12)


def matrix_of_link(tree, index):
    """Return the spatial inertia (6, 6) of a link, linear parts first."""
    mass, (x, y, z) = tree.mass[index], tree.center[index]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    upper = np.hstack([mass * np.eye(3), -mass * cross])
    return np.vstack([upper, np.hstack([mass * cross, tree.inertia[index] - mass * cross @ cross])])


def test_jax_computes_the_same(panda):
    jax = pytest.importorskip("jax")
    qpos, model = panda.sample(6), panda.dynamics()
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(model.mass_matrix)(jax.numpy.asarray(qpos)))
    close(found, model.mass_matrix(qpos), 1e-12)


def uses(engine, panda):
    """Yield a name and a call for each user of the mass matrix."""

    def run(**options):
        with Runner(panda, 1, workers=0, engine=engine, ground=False, **options) as runner:
            control = options.get("control")
            runner.step(panda.start if control is None else control.command.neutral)

    drive = LoggedDrive(1e-3, None, "none")
    yield "law", lambda: run(compensate="gravity+coriolis")
    yield "friction", lambda: run(params=panda.params(), actuators=bp.make_actuators(panda.dof, coulomb=0.5))
    yield "task space", lambda: run(control=OperationalSpace(panda, "panda_hand", posture=panda.settings.target))
    yield "design", lambda: panda.designed("effort")
    yield "identification", lambda: Plant(panda, (0, 1), drive).mass_matrix(np.zeros((1, 2)), np.zeros((1, 1)))


@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_there_is_one_mass_matrix(engine, panda, monkeypatch):
    """Law, friction, task space, design and identification take it from the rigid tree."""
    if engine == "mujoco":
        pytest.importorskip("mujoco", "3.17")
    monkeypatch.setenv("BATCHPID_NATIVE", "0")
    calls, compute = [], tree_dynamics.mass_matrix_of

    def recorded(*arguments):
        calls.append(arguments)
        return compute(*arguments)

    for module in (tree_dynamics, osc_state):
        monkeypatch.setattr(module, "mass_matrix_of", recorded)
    for name, use in uses(engine, panda):
        calls.clear()
        use()
        assert calls, name
