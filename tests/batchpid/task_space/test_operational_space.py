"""Operational-space control: the accelerations it asks for, closed loops, singular poses,
saturation.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trees import planar, states, tree_of

import batchpid.task_space as ts
from batchpid.errors import InvalidArgumentError
from batchpid.task_space import frames

DT = 1 / 2000
START = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8, 0.02, 0.02])
HAND = "panda_hand"


def terms_of(params, state, goal, qpos, qvel, dynamics, **options):
    return ts.osc(params, state, dynamics, ts.OSCInputs(goal, qpos, qvel, **options))[1]


def accelerations(d, effort):
    """Return q'' = M^-1 (u - h), and the acceleration of the tool."""
    qacc = np.linalg.solve(d.mass_matrix, (effort - d.bias)[..., None])[..., 0]
    return qacc, (d.jacobian * qacc[:, None]).sum(-1) + d.jacobian_rate


def moved_by(d, chain, effort):
    """Return the acceleration J M_cc^-1 u of the tool by efforts of the chain, where the other
    joints are held.
    """
    mass = d.mass_matrix[:, chain][:, :, chain]
    return (d.jacobian[..., chain] @ np.linalg.solve(mass, effort[:, chain, None]))[..., 0]


def goals(tree, link, seed=3):
    """Return poses of the tool at other random states than :func:`states` gives."""
    return lambda rows: ts.link_poses(tree, states(tree, rows, seed)[0], [link])[:, 0]


@pytest.mark.parametrize(("name", "link"), [("panda", HAND), ("jaco2", "j2s7s300_link_7")])
def test_the_tool_has_the_acceleration_and_fingers_their_own(name, link):
    tree, rows = tree_of(name), 20
    qpos, qvel = states(tree, rows)
    rng = np.random.default_rng(1)
    goal, twist, acceleration = goals(tree, link)(rows), *rng.normal(size=(2, rows, 6))
    stiffness, ratio = rng.uniform(50, 200, (rows, 6)), rng.uniform(0.5, 1, (rows, 6))
    options = {"stiffness": stiffness, "damping_ratio": ratio, "smallest_eigenvalue": 1e-6}
    params = ts.make_osc_params(tree, DT, posture_stiffness=30.0, **options)
    state = ts.OSCState(qpos + 0.1 * rng.normal(size=qpos.shape))
    d = ts.task_dynamics(tree, qpos, qvel, link)
    inputs = {"twist": twist, "acceleration": acceleration, "feedforward": np.full_like(qpos, 0.5)}
    terms = terms_of(params, state, goal, qpos, qvel, d, **inputs)
    qacc, tool = accelerations(d, terms.effort - 0.5)
    error = frames.pose_error(goal, d.pose)
    for part, most in ((error[:, :3], 0.1), (error[:, 3:], 0.5)):
        part *= np.minimum(1, most / np.linalg.norm(part, axis=1, keepdims=True))
    rate = twist - (d.jacobian * qvel[:, None]).sum(-1)
    wanted = stiffness * error + 2 * ratio * np.sqrt(stiffness) * rate + acceleration
    np.testing.assert_allclose(tool, wanted, atol=1e-8 * np.abs(wanted).max())
    others = ~tree.chain(link)
    a_n = 30 * (state.posture - qpos) - 2 * np.sqrt(30) * qvel
    np.testing.assert_allclose(qacc[:, others], a_n[:, others], atol=1e-8)
    assert not terms.near_singular.any()
    assert (terms.task_share == 1).all()


def test_the_posture_does_not_move_the_tool():
    tree = tree_of("panda")
    qpos, qvel = states(tree, 50)
    for axes in ([True] * 6, [True] * 3 + [False] * 3, [False, True, True, True, False, True]):
        params = ts.make_osc_params(tree, DT, axes=axes, smallest_eigenvalue=1e-9)
        d = ts.task_dynamics(tree, qpos, qvel, HAND)
        state, goal = ts.init(params, qpos + 0.3), goals(tree, HAND)(50)
        terms = terms_of(params, state, goal, qpos, qvel, d)
        moved = moved_by(d, tree.chain(HAND), terms.posture)[:, axes]
        assert np.abs(moved).max() < 1e-9 * np.abs(terms.posture).max()
        assert np.abs(terms.posture).max() > 1


@settings(max_examples=30)
@given(seed=st.integers(0, 2**31), tight=st.sampled_from([0.3, 1.0, 3.0]))
def test_saturation_scales_the_task_first_and_then_the_posture(seed, tight):
    tree, rows = tree_of("panda"), 6
    rng = np.random.default_rng(seed)
    qpos, qvel = states(tree, rows, seed)
    goal, state = goals(tree, HAND, seed + 1)(rows), ts.OSCState(qpos + rng.normal(size=qpos.shape))
    d = ts.task_dynamics(tree, qpos, 0.1 * qvel, HAND)
    limit = np.abs(d.bias).max() * tight * rng.uniform(0.5, 2, (rows, tree.dof))
    params = ts.make_osc_params(tree, DT, effort_limit=limit)
    terms = terms_of(params, state, goal, qpos, 0.1 * qvel, d)
    chain = tree.chain(HAND)
    base = (terms.unsaturated - terms.task - terms.posture)[:, chain]
    task, posture, effort, limit = (
        x[:, chain] for x in (terms.task, terms.posture, terms.effort, limit)
    )
    s1, s2 = terms.task_share[:, None], terms.posture_share[:, None]
    able = (np.abs(base) <= limit).all(1)
    assert (np.abs(effort) <= limit * (1 + 1e-12)).all()
    assert ((s1 >= 0) & (s1 <= 1) & (s2 >= 0) & (s2 <= 1)).all()
    # not joint by joint: the direction of each part stays
    np.testing.assert_allclose(effort[able], (base + s1 * task + s2 * posture)[able], atol=1e-9)
    # and no share could be larger
    with_task = np.abs(base + s1 * task)
    full = np.isclose(np.abs(base + s1 * task), limit).any(1)
    assert (full | (s1[:, 0] == 1))[able].all()
    assert (np.isclose(np.abs(effort), limit).any(1) | (s2[:, 0] == 1) | full)[able].all()
    assert (with_task <= limit * (1 + 1e-9))[able].all()


def test_a_row_does_not_depend_on_the_others_and_nan_stays_alone():
    tree, rows = tree_of("panda"), 24
    qpos, qvel = states(tree, rows)
    qpos[2], qvel[3] = np.nan, np.inf
    goal, state = goals(tree, HAND)(rows), ts.OSCState(qpos + 0.1)
    goal[5, 0] = np.nan
    for options in ({}, {"axes": [True] * 3 + [False] * 3}):
        params = ts.make_osc_params(
            tree, DT, effort_limit=60.0, smallest_eigenvalue=0.05, **options
        )

        def terms_for(chosen, params=params):
            part = ts.OSCState(state.posture[chosen])
            return terms_of(
                params, part, goal[chosen], qpos[chosen], qvel[chosen], ts.Tool(tree, HAND)
            )

        terms = terms_for(slice(None))
        effort = terms.effort
        bad = [2, 3, 5]
        assert np.isnan(effort[bad]).any(1).all()
        assert np.isfinite(np.delete(effort, bad, 0)).all()
        assert terms.near_singular[6:].any()
        assert not terms.near_singular[6:].all()
        for chosen in (slice(0, 1), slice(4, 5), slice(6, 7), slice(6, 23)):
            for part, whole in zip(terms_for(chosen), terms, strict=True):
                np.testing.assert_array_equal(part, whole[chosen])


def test_the_state_is_the_posture():
    params = ts.make_osc_params(planar(), DT)
    state = ts.init(params, np.ones((3, 2)))
    np.testing.assert_array_equal(state.posture, 1.0)
    assert "kp (1, 6)" in repr(params)


@pytest.mark.parametrize("native", ["0", "1"])
@pytest.mark.parametrize("name", ["setpoint", "twist", "wrench", "feedforward", "qvel"])
def test_inputs_of_a_step_are_checked(monkeypatch, name, native):
    tree, qpos = planar(), np.zeros((2, 2))
    goal, params = ts.link_poses(tree, qpos, ["tip"])[:, 0], ts.make_osc_params(tree, DT)
    inputs = ts.OSCInputs(goal, qpos, qpos)._replace(**{name: np.zeros((2, 4))})
    monkeypatch.setenv("BATCHPID_NATIVE", native)
    with pytest.raises(InvalidArgumentError, match=f"{name}: has shape"):
        ts.osc(params, ts.init(params, qpos), ts.Tool(tree, "tip"), inputs)
