"""Closed loops of operational-space control against analytic motion, at a wall, and through
singular poses.
"""

from __future__ import annotations

import numpy as np
from trees import TOOLS, tree_of

import batchpid.task_space as ts
from batchpid.task_space import frames

DT = 1 / 2000
START = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8, 0.02, 0.02])
HAND = TOOLS["panda"]


def poses(tree, link, count, seed=0):
    """Return joint positions near START (count, dof) whose mobility has no eigenvalue below
    0.05.
    """
    rng = np.random.default_rng(seed)
    qpos = START + np.array([0.5] * 7 + [0.0] * 2) * rng.uniform(-1, 1, (20 * count, tree.dof))
    j, mass, c = ts.jacobian(tree, qpos, link), ts.mass_matrix(tree, qpos), tree.chain(link)
    mobility = j[..., c] @ np.linalg.solve(mass[:, c][..., c], j[..., c].swapaxes(1, 2))
    return qpos[np.linalg.eigvalsh(mobility)[:, 0] > 0.05][:count]


def run(
    tree,
    link,
    params,
    qpos,
    goal,
    steps,
    dt,
    *,
    known=lambda d, q: d,
    change=None,
    outside=None,
    **given,
):
    """Return errors (steps, envs, 6), efforts, and the last positions of a closed loop, exact but
    for its time step.

    ``known`` changes the dynamics that the law knows, ``change`` its effort; ``outside`` is a
    wrench on the tool.
    """
    k, q, v, state = (
        ts.discretise(params, dt),
        qpos.copy(),
        np.zeros_like(qpos),
        ts.init(params, qpos),
    )
    errors, efforts = [], []
    for n in range(steps):
        d = ts.task_dynamics(tree, q, v, link)
        target = goal(n * dt) if callable(goal) else goal
        state, terms = ts.osc(k, state, known(d, q), ts.OSCInputs(target, q, v, **given))
        effort = terms.effort if change is None else change(terms.effort, terms, d, q, v)
        errors.append(frames.pose_error(target, d.pose))
        efforts.append(effort)
        force = effort - d.bias
        if outside is not None:
            force = force + (d.jacobian * outside(d, v)[..., None]).sum(1)
        v = v + dt * np.linalg.solve(d.mass_matrix, force[..., None])[..., 0]
        q = q + dt * v
    return np.array(errors), np.array(efforts), q


def test_moves_of_10_cm_are_analytic_and_every_term_is_needed():
    """e = e0 (1 + w t) exp(-w t) from eight regular poses: to 0.25 mm, and to 0.1 mm from the time
    step's recursion.

    Without J' q', without Coriolis forces, or with a posture that is not projected, the tool is off
    by 2 mm or more.
    """
    tree, steps, each = tree_of("panda"), 800, 8
    rng, chain = np.random.default_rng(1), tree.chain(HAND)
    start = poses(tree, HAND, each)
    assert len(start) == each
    way = rng.normal(size=(each, 3))
    way *= 0.1 / np.linalg.norm(way, axis=1, keepdims=True)
    goal = ts.link_poses(tree, start, [HAND])[:, 0]
    goal[:, :3] += way
    qpos, goal, way = np.tile(start, (4, 1)), np.tile(goal, (4, 1)), np.tile(way, (4, 1))
    rows = [slice(n * each, (n + 1) * each) for n in range(4)]

    def known(d, q):
        rate, bias = d.jacobian_rate.copy(), d.bias.copy()
        rate[rows[1]], bias[rows[2]] = 0.0, ts.gravity(tree, q[rows[2]])
        return d._replace(jacobian_rate=rate, bias=bias)

    params = ts.make_osc_params(tree, position_error_limit=np.inf, posture_stiffness=10.0)

    def change(effort, terms, d, q, v):
        a_n = 10 * (qpos - q) - 2 * np.sqrt(10) * v
        whole = (d.mass_matrix * (a_n * chain)[:, None]).sum(-1)
        effort[rows[3]] += (chain * (whole - terms.posture))[rows[3]]
        return effort

    errors, _, _ = run(tree, HAND, params, qpos, goal, steps, DT, known=known, change=change)
    w, t = np.sqrt(150), np.arange(steps)[:, None, None] * DT
    off = np.linalg.norm(errors[..., :3] - (1 + w * t) * np.exp(-w * t) * way, axis=-1).max(0)
    assert off[rows[0]].max() < 0.25e-3
    assert [off[part].max() > 2e-3 for part in rows[1:]] == [True] * 3
    assert np.abs(errors[:, rows[0], 3:]).max() < 1e-4
    recursion = np.linalg.norm(errors[:, rows[0], :3] - decay(steps) * way[rows[0]], axis=-1)
    assert recursion.max() < 0.1e-3


def decay(steps):
    """Return the errors (steps, 1, 1) of a unit mass on a spring of 150 / s^2, critically damped,
    at DT.
    """
    e, rate, errors = 1.0, 0.0, np.empty((steps, 1, 1))
    for n in range(steps):
        errors[n] = e
        rate -= DT * (150 * e + 2 * np.sqrt(150) * rate)
        e += DT * rate
    return errors


def test_the_force_on_a_wall_is_the_one_asked_for():
    """A wall of 1e5 N/m in z, and 5 to 40 N: to 0.2 %. The other axes hold their place."""
    tree, asked = tree_of("panda"), np.array([5.0, 10.0, 20.0, 40.0])
    qpos = np.tile(START, (4, 1))
    at = ts.link_poses(tree, qpos, [HAND])[:, 0]
    axes = np.array([True, True, False, True, True, True])
    params = ts.make_osc_params(tree, axes=axes, force_axes=~axes, stiffness=400.0)
    wrench, forces = np.zeros((4, 6)), []
    wrench[:, 2] = -asked

    def wall(d, v):
        speed = (d.jacobian[:, 2] * v).sum(-1)
        force = np.maximum(1e5 * (at[:, 2] - d.pose[:, 2]) - 1e3 * speed, 0.0)
        forces.append(force)
        return force[:, None] * np.eye(6)[2]

    errors, _, _ = run(tree, HAND, params, qpos, at, 1000, DT, outside=wall, wrench=wrench)
    np.testing.assert_allclose(forces[-1], asked, rtol=2e-3)
    assert np.abs(errors[-1][:, axes]).max() < 1e-3
