"""Kinematic trees: against MuJoCo, against finite differences, and errors of arguments."""

import dataclasses

import jax
import numpy as np
import pytest
from quick_jit import quick_jit
from trees import NAMES, planar, robot_of, states, tool_of, tree_of

import batchpid.task_space as ts
from batchpid.errors import InvalidArgumentError, RobotError
from batchpid.sim import Robot

POINT = np.array([0.1, -0.2, 0.3])


@pytest.fixture(params=NAMES, ids=str)
def case(request):
    return tree_of(request.param), tool_of(request.param), robot_of(request.param)


def relative(found, wanted):
    return np.abs(found - wanted).max() / max(np.abs(wanted).max(), 1e-9)


@pytest.mark.parametrize("native", ["0", "1"])
def test_mujoco_computes_the_same(case, native, monkeypatch):
    """NumPy and native code; JAX against these below."""
    monkeypatch.setenv("BATCHPID_NATIVE", native)
    import mujoco

    tree, tool, robot = case
    spec = mujoco.MjSpec.from_file(str(robot.path))
    spec.compiler.fusestatic, spec.compiler.discardvisual = False, True
    model = spec.compile()
    data, columns = (
        mujoco.MjData(model),
        [model.joint(name).qposadr[0] for name in tree.joint_names],
    )
    body, dof = model.body(tool).id, tree.dof
    qpos, qvel = states(tree, 40)
    found = (
        ts.jacobian(tree, qpos, tool, point=POINT),
        ts.jacobian_rate(tree, qpos, qvel, tool, point=POINT),
        ts.mass_matrix(tree, qpos),
        ts.bias(tree, qpos, qvel),
        ts.link_poses(tree, qpos, [tool])[:, 0],
    )
    for row, (q, v) in enumerate(zip(qpos, qvel, strict=True)):
        data.qpos[columns], data.qvel[columns] = q, v
        mujoco.mj_forward(model, data)
        mass, (jp, jr, rate_p, rate_r) = np.zeros((dof, dof)), np.zeros((4, 3, dof))
        mujoco.mj_fullM(model, data, mass)
        place = data.xpos[body] + data.xmat[body].reshape(3, 3) @ POINT
        mujoco.mj_jac(model, data, jp, jr, place, body)
        mujoco.mj_jacDot(model, data, rate_p, rate_r, place, body)
        pose = np.hstack([data.xpos[body], data.xquat[body] * np.copysign(1, data.xquat[body][0])])
        wanted = (
            np.vstack([jp, jr])[:, columns],
            np.vstack([rate_p, rate_r])[:, columns] @ v,
            mass[np.ix_(columns, columns)],
            data.qfrc_bias[columns],
            pose,
        )
        for ours, theirs in zip(found, wanted, strict=True):
            assert relative(ours[row], theirs) < 1e-12


def test_inverse_and_forward_dynamics_undo_each_other(case):
    tree, _, _ = case
    tree = dataclasses.replace(tree, armature=np.linspace(0.1, 0.3, tree.dof))
    qpos, qvel = states(tree, 20)
    effort = np.random.default_rng(1).normal(size=qpos.shape)
    acceleration = ts.forward_dynamics(tree, qpos, qvel, effort)
    back = ts.inverse_dynamics(tree, qpos, qvel, acceleration)
    np.testing.assert_allclose(back, effort, atol=1e-11 * np.abs(ts.bias(tree, qpos, qvel)).max())
    matrix = ts.mass_matrix(tree, qpos)
    np.testing.assert_allclose(
        back, (matrix * acceleration[:, None]).sum(-1) + ts.bias(tree, qpos, qvel), atol=1e-10
    )


def functions(tree, tool):
    return (
        lambda q, v: ts.link_poses(tree, q),
        lambda q, v: ts.jacobian(tree, q, tool),
        lambda q, v: ts.jacobian_rate(tree, q, v, tool),
        lambda q, v: ts.mass_matrix(tree, q),
        lambda q, v: ts.bias(tree, q, v),
        lambda q, v: ts.inverse_dynamics(tree, q, v, v),
        lambda q, v: ts.forward_dynamics(tree, q, v, v),
    )


def test_a_row_does_not_depend_on_the_others_to_the_last_bit(case):
    tree, tool, _ = case
    qpos, qvel = states(tree, 37)
    qpos[3], qvel[5], qpos[7] = np.nan, np.inf, np.inf
    for function in functions(tree, tool):
        whole = function(qpos, qvel)
        for rows in (slice(4, 5), slice(6, 7), slice(8, 30), slice(36, 37)):
            np.testing.assert_array_equal(function(qpos[rows], qvel[rows]), whole[rows])
        np.testing.assert_array_equal(function(qpos[10], qvel[10]), whole[10])
        grid = function(qpos[8:32].reshape(4, 6, -1), qvel[8:32].reshape(4, 6, -1))
        np.testing.assert_array_equal(grid.reshape(24, *grid.shape[2:]), whole[8:32])


def test_jax_computes_the_same(x64):
    tree = planar()  # small: XLA takes seconds for a panda
    inputs = states(tree, 3)

    def all_of_them(qpos, qvel):
        _, jacobian, rate, *_, forward = functions(tree, "tip")  # which has mass matrix and bias
        return [function(qpos, qvel) for function in (jacobian, rate, forward)]

    with jax.numpy_rank_promotion("allow"):
        found = quick_jit(all_of_them)(*map(jax.numpy.asarray, inputs))
    for ours, wanted in zip(found, all_of_them(*inputs), strict=True):
        np.testing.assert_allclose(ours, wanted, rtol=1e-9, atol=1e-9)


def test_merged_links_are_known_by_name():
    robot = robot_of(0)
    tree = tree_of(0)
    assert set(tree.links) == set(robot.tables.links)
    moving = {joint.child_link for joint in robot.joints}
    fixed = next(link for link in tree.links[1:] if link not in moving)
    assert ts.link_poses(tree, robot.start, [fixed]).shape == (1, 7)


def test_the_dynamics_are_those_of_the_engine():
    robot, tree = robot_of("panda"), tree_of("panda")
    qpos, qvel = states(tree, 5)
    wanted = robot.dynamics().inverse_dynamics(qpos, qvel, 0 * qpos)
    np.testing.assert_allclose(
        ts.bias(tree, qpos, qvel), wanted, atol=2e-4
    )  # SAPIEN rounds masses to float32
    np.testing.assert_allclose(ts.mass_matrix(tree, qpos), robot.mass_matrix(qpos), atol=1e-5)


@pytest.mark.parametrize(
    "changes",
    [
        {"gravity": -9.81},
        {"gravity": (0, 0, np.nan)},
        {"armature": -1.0},
        {"armature": [1.0, 2.0, 3.0, 4.0]},
    ],
)
def test_a_wrong_option_of_a_tree_is_refused(changes):
    with pytest.raises(InvalidArgumentError, match=next(iter(changes))):
        dataclasses.replace(planar(), **changes)


def test_the_mass_of_collision_shapes_is_sapiens_and_a_floating_base_is_refused(tmp_path):
    from tiny_urdf import joint, link, robot, write

    box = '<collision><geometry><box size="0.1 0.2 0.3"/></geometry></collision>'
    text = robot(link("base"), link("arm", box), joint("hinge", "base", "arm"))
    tree = Robot.load(write(tmp_path, text)).kinematic_tree()
    np.testing.assert_allclose(tree.mass[1], 6, rtol=1e-6)
    np.testing.assert_allclose(tree.inertia[1].diagonal(), [0.065, 0.05, 0.025], rtol=1e-6)
    with pytest.raises(
        RobotError, match=r"needs? a robot with.*fixed_base=True, or control its joints"
    ):
        Robot.load("panda", fixed_base=False).kinematic_tree()
    with pytest.raises(InvalidArgumentError, match="did you mean 'gravity'"):
        robot_of("panda").kinematic_tree(gravty=0)
