"""Dynamics of many robots at once: the extension's are NumPy's."""

from __future__ import annotations

import numpy as np
import pytest
from robots import load_bundled
from tiny_urdf import LIMIT, joint, link, random_tree, robot, write

from batchpid.sim import Robot
from batchpid.sim.engine import native
from batchpid.sim.engine.batch_dynamics import (
    Friction,
    Loaded,
    MovingJoints,
    NativeBatchDynamics,
    NumpyBatchDynamics,
    batch_dynamics,
)

DT = 5e-4
needs_extension = pytest.mark.skipif(bool(native.obstacle()), reason="there are no native calls")


def load(name, folder):
    """Return a bundled robot, or for a number one of ten links."""
    if isinstance(name, str):
        return load_bundled(name)
    return Robot.load(write(folder, robot(*random_tree(np.random.default_rng(name), 10))))


def state_of(arm, joints, rows=11):
    rng = np.random.default_rng(0)
    low, high = np.maximum(arm.lower, -2)[list(joints)], np.minimum(arm.upper, 2)[list(joints)]
    qpos = rng.uniform(low, high, (rows, len(joints)))
    return qpos, rng.normal(size=qpos.shape), rng.choice([0.0, 0.3, 2.0], (rows, 1))


def friction_of(shape, keep=0.9):
    rng = np.random.default_rng(1)
    return Friction(rng.uniform(0, 2, shape), np.full((shape[0], 1), keep), rng.uniform(0, 1e-4, shape))


CASES = [("panda", range(7)), ("panda", (1, 3, 8)), ("jaco2", None), (0, None), (1, None), (2, (0, 2))]


@needs_extension
@pytest.mark.parametrize(("name", "joints"), CASES)
def test_the_extension_gives_what_numpy_gives(name, joints, tmp_path):
    arm = load(name, tmp_path)
    joints = tuple(np.flatnonzero(arm.independent)) if joints is None else tuple(joints)
    moving = MovingJoints.of(arm, joints)
    fast, slow = NativeBatchDynamics(Loaded.of(arm), moving), NumpyBatchDynamics(Loaded.of(arm), moving)
    qpos, qvel, payload = state_of(arm, joints)
    found, expected = fast.at(qpos, qvel, payload), slow.at(qpos, qvel, payload)
    for leaf, wanted in zip(found, expected, strict=True):
        scale = np.abs(wanted).max() + 1e-9
        np.testing.assert_allclose(leaf / scale, wanted / scale, rtol=0, atol=1e-12)
    empty = np.zeros_like(payload)
    for leaf, wanted in zip(fast.at(qpos, qvel, empty)[:2], slow.at(qpos, qvel, empty)[:2], strict=True):
        np.testing.assert_allclose(leaf, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    rng = np.random.default_rng(2)
    effort, added = rng.normal(size=qpos.shape), rng.uniform(0.01, 0.2, qpos.shape)
    for keep in (0.9, 0.0):
        args = (qpos, qvel, 0.1 * effort), expected.matrix, 5 * effort, added, friction_of(qpos.shape, keep), DT
        for leaf, wanted in zip(fast.step(*args), slow.step(*args), strict=True):
            np.testing.assert_allclose(leaf, wanted, rtol=0, atol=1e-12 * (1 + np.abs(wanted).max()))


@pytest.mark.parametrize("moves", [(0, 1), (1,)], ids=str)
@pytest.mark.parametrize("kind", [pytest.param(NativeBatchDynamics, marks=needs_extension), NumpyBatchDynamics])
def test_followers_move_with_their_leaders(kind, moves, tmp_path):
    mimics = ('<mimic joint="two" multiplier="-0.5" offset="0.2"/>', '<mimic joint="three" multiplier="3"/>')
    joints = [joint("one", "a", "b"), joint("two", "b", "c")]
    joints += [joint("three", "c", "d", inner=LIMIT + mimics[0]), joint("four", "c", "e", inner=LIMIT + mimics[1])]
    arm = Robot.load(write(tmp_path, robot(*map(link, "abcde"), *joints)))
    coupling, model = arm.coupling, arm.dynamics()
    rng, places = np.random.default_rng(0), list(moves)
    qpos, qvel = np.tile(arm.start, (5, 1)), np.zeros((5, arm.dof))
    qpos[:, places], qvel[:, places] = rng.uniform(-1, 1, (2, 5, len(moves)))
    whole, rates, still = coupling.positions(qpos), coupling.rates(qvel), np.zeros((5, arm.dof))
    columns = coupling.matrix[:, places]
    found = kind(Loaded.of(arm), MovingJoints.of(arm, moves)).at(qpos[:, places], qvel[:, places], np.zeros((5, 1)))
    np.testing.assert_allclose(found.matrix, columns.T @ model.mass_matrix(whole) @ columns, rtol=1e-6)
    np.testing.assert_allclose(found.force, model.inverse_dynamics(whole, rates, still) @ columns, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("kind", [NativeBatchDynamics, NumpyBatchDynamics])
def test_a_row_does_not_depend_on_the_others(kind, panda):
    if kind is NativeBatchDynamics and native.obstacle():
        pytest.skip("the extension was not built")
    joints = tuple(range(7))
    batch = kind(Loaded.of(panda), MovingJoints.of(panda, joints))
    qpos, qvel, payload = state_of(panda, joints)
    whole, friction = batch.at(qpos, qvel, payload), friction_of(qpos.shape)
    stepped = batch.step((qpos, qvel, 0 * qpos), whole.matrix, qvel, 0 * qpos + 0.1, friction, DT)
    for rows in (slice(3, 4), slice(2, 7)):
        part = batch.at(qpos[rows], qvel[rows], payload[rows])
        of_part = Friction(*(leaf[rows] for leaf in friction))
        zero = 0 * qpos[rows]
        again = batch.step((qpos[rows], qvel[rows], zero), part.matrix, qvel[rows], zero + 0.1, of_part, DT)
        for all_rows, few in zip((*whole, *stepped), (*part, *again), strict=True):
            np.testing.assert_array_equal(few, all_rows[rows])


@needs_extension
def test_a_tool_that_is_part_of_the_base_weighs_nothing(tmp_path):
    fingers = [(f"finger{n}", "0.1") for n in range(2)]
    links = "".join(
        f'<link name="{name}"><inertial><mass value="{kg}"/><inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" '
        f'izz="1e-4"/></inertial></link><joint name="{name}" type="prismatic"><parent link="base"/>'
        f'<child link="{name}"/><axis xyz="1 0 0"/><limit lower="0" upper="0.1" effort="9" velocity="1"/></joint>'
        for name, kg in fingers
    )
    arm = Robot.load(write(tmp_path, f'<robot name="hand"><link name="base"/>{links}</robot>'))
    moving = MovingJoints.of(arm, (0, 1))
    qpos, kg = np.full((3, 2), 0.05), np.array([[0.0], [0.5], [1.0]])
    found, expected = (
        kind(Loaded.of(arm), moving).at(qpos, 0 * qpos, kg) for kind in (NativeBatchDynamics, NumpyBatchDynamics)
    )
    for leaf, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(leaf, wanted, atol=1e-7)


def test_strong_friction_stops_and_limits_hold(panda):
    batch = batch_dynamics(panda, (0, 1))
    qpos = np.array([[0.1, 0.2], [panda.upper[0] - 1e-4, 0.2]])
    qvel, still = np.array([[0.5, -0.3], [2.0, 0.0]]), np.zeros((2, 2))
    passive = batch.at(qpos, qvel, np.zeros((2, 1)))
    friction = Friction(np.array([[1e4, 1e4], [0.0, 0.0]]), np.zeros((2, 1)), still)
    state = qpos, qvel, still
    for _ in range(20):
        state = batch.step(state, passive.matrix, still, still, friction, DT)
    assert np.abs(state[1][0]).max() < 1e-3
    assert state[0][1, 0] == panda.upper[0]
    assert state[1][1, 0] == 0.0


def test_it_works_without_the_extension(panda, monkeypatch):
    monkeypatch.setenv(native.SWITCH, "0")
    assert isinstance(batch_dynamics(panda, (0,)), NumpyBatchDynamics)
