"""Integral, limits of joints, implicit gains and forces of operational-space control, in closed
loops.
"""

import numpy as np
import pytest
from trees import TOOLS, planar, states, tree_of

import batchpid.task_space as ts
from batchpid.task_space import frames

START = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8, 0.02, 0.02])
HAND = TOOLS["panda"]


def run(tree, link, params, qpos, goal, steps, dt, *, load=0.0, **given):
    """Return the errors of the pose (steps, envs, 6), the last state, positions and velocities of a
    closed loop. ``dt`` is that of the params.

    ``load`` (envs, 6), or a function of dynamics and velocities, is a wrench on the tool that the
    law does not know.
    """
    q, v, errors = qpos.copy(), np.zeros_like(qpos), []
    state = ts.init(params, qpos)
    for _ in range(steps):
        d = ts.task_dynamics(tree, q, v, link)
        state, terms = ts.osc(params, state, d, ts.OSCInputs(goal, q, v, **given))
        errors.append(frames.pose_error(goal, d.pose))
        wrench = np.broadcast_to(load(d, v) if callable(load) else load, (len(q), 6))
        force = terms.effort - d.bias + (d.jacobian * wrench[..., None]).sum(1)
        v = v + dt * np.linalg.solve(d.mass_matrix, force[..., None])[..., 0]
        q = q + dt * v
    return np.array(errors), state, q, v


@pytest.mark.slow
def test_an_integral_learns_a_load_that_the_model_does_not_know():
    tree, qpos = tree_of("panda"), np.tile(START, (2, 1))
    goal, load = ts.link_poses(tree, qpos, [HAND])[:, 0], np.array([0, 0, -20.0, 0, 1.0, 0])
    gains = {"stiffness": 400.0, "posture_stiffness": 40.0}
    without, *_ = run(
        tree, HAND, ts.make_osc_params(tree, 1 / 500, **gains), qpos, goal, 800, 1 / 500, load=load
    )
    assert np.abs(without[-1, :, 2]).min() > 5e-3
    for extra in ({}, {"discretization": "implicit"}):
        params = ts.make_osc_params(tree, 1 / 500, integral_gain=2000.0, **gains, **extra)
        found, state, *_ = run(tree, HAND, params, qpos, goal, 800, 1 / 500, load=load)
        assert np.abs(found[-1]).max() < 1e-4
        assert np.abs(state.integral).max() > 1
    small = ts.make_osc_params(tree, 1 / 500, integral_gain=2000.0, integral_limit=0.5, **gains)
    _, state, *_ = run(tree, HAND, small, qpos, goal, 200, 1 / 500, load=load)
    assert np.abs(state.integral).max() == 0.5


def test_the_integral_does_not_wind_up():
    """It does not grow while efforts are at their limits or the pose is out of reach, and shrinks
    at once.
    """
    tree = planar()
    qpos = np.array([[0.3, 0.8]] * 2)
    params = ts.make_osc_params(
        tree,
        1e-3,
        axes=[True, True, *[False] * 4],
        integral_gain=500.0,
        effort_limit=[[0.05], [1e3]] * np.ones((2, 2)),
    )
    near = ts.link_poses(tree, qpos, ["tip"])[:, 0]
    far = np.add(near, [3.0, 0, 0, 0, 0, 0, 0])
    held = ts.init(params, qpos)
    d = ts.task_dynamics(tree, qpos, 0 * qpos, "tip")
    for _ in range(3):
        held, _ = ts.osc(params, held, d, ts.OSCInputs(far, qpos, 0 * qpos))
    np.testing.assert_array_equal(held.integral[0], 0.0)
    assert held.integral[1, 0] > 0.1
    back = held._replace(integral=np.full((2, 6), 5.0))
    free, _ = ts.osc(params, back, d, ts.OSCInputs(near - [0.01, 0, 0, 0, 0, 0, 0], qpos, 0 * qpos))
    assert (free.integral[:, 0] < 5.0).all()
    straight = np.array([[0.3, 1e-3]] * 2)
    d = ts.task_dynamics(tree, straight, 0 * straight, "tip")
    state, _ = ts.osc(
        params, ts.init(params, straight), d, ts.OSCInputs(far, straight, 0 * straight)
    )
    np.testing.assert_array_equal(state.integral, 0.0)


def test_joints_keep_away_from_their_limits_within_the_null_space():
    tree = tree_of("panda")
    qpos = np.tile(START, (1, 1))
    qpos[:, 5] = tree.lower[5] + 0.02
    goal = ts.link_poses(tree, qpos, [HAND])[:, 0]
    options = {"axes": [True] * 3 + [False] * 3, "posture_stiffness": 4.0}
    ends = {}
    for margin in (0.0, 0.3):
        params = ts.make_osc_params(tree, 1 / 500, limit_margin=margin, **options)
        errors, _, ends[margin], _ = run(tree, HAND, params, qpos, goal, 800, 1 / 500)
        assert np.abs(errors[..., :3]).max() < 1e-3
    assert abs(ends[0.0][0, 5] - qpos[0, 5]) < 1e-3
    assert 0.2 < ends[0.3][0, 5] - tree.lower[5] < 0.35
    fingers = ~tree.chain(HAND)
    np.testing.assert_allclose(
        ends[0.3][:, fingers], qpos[:, fingers], atol=1e-6
    )  # of the setpoint, not of the chain


def test_implicit_gains_act_on_the_end_of_the_step():
    """One decoupled axis: a = kp (r+ - y+) + kd (V+ - v+) + V' + I+, with y+ and v+ at the end of
    the step.
    """
    tree, dt, rng = tree_of("panda"), 0.02, np.random.default_rng(0)
    qpos, qvel = states(tree, 5)
    kp, kd, ki = 300.0, 30.0, 900.0
    options = {
        "position_error_limit": np.inf,
        "rotation_error_limit": np.inf,
        "smallest_eigenvalue": 1e-9,
    }
    params = ts.make_osc_params(
        tree,
        dt,
        stiffness=kp,
        damping_ratio=kd / 2 / np.sqrt(kp),
        integral_gain=ki,
        discretization="implicit",
        **options,
    )
    d = ts.task_dynamics(tree, qpos, qvel, HAND)
    goal, twist, acc = d.pose.copy(), *rng.normal(size=(2, 5, 6))
    goal[:, :3] += 0.05 * rng.normal(size=(5, 3))
    state = ts.init(params, qpos)._replace(integral=rng.normal(size=(5, 6)))
    new, terms = ts.osc(params, state, d, ts.OSCInputs(goal, qpos, qvel, twist, acc))
    qacc = np.linalg.solve(d.mass_matrix, (terms.effort - d.bias)[..., None])[..., 0]
    a = (d.jacobian * qacc[:, None]).sum(-1) + d.jacobian_rate
    e, v = frames.pose_error(goal, d.pose), (d.jacobian * qvel[:, None]).sum(-1)
    share = 1 + dt * kd + dt**2 * kp + dt**3 * ki
    end = e - dt * v - dt**2 * a
    wanted = kp * end + kd * (twist - v - dt * a) + acc + share * state.integral + ki * dt * end
    np.testing.assert_allclose(a, wanted, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(
        share * (new.integral - state.integral), ki * dt * (e - dt * twist), atol=1e-9
    )


def test_the_force_on_a_wall_is_the_one_asked_for():
    """A wall of 1e5 N/m in z, and 5 to 40 N: to 0.2 %. The other axes hold their place."""
    tree, asked = tree_of("panda"), np.array([5.0, 10.0, 20.0, 40.0])
    qpos = np.tile(START, (4, 1))
    at = ts.link_poses(tree, qpos, [HAND])[:, 0]
    axes = np.array([True, True, False, True, True, True])
    params = ts.make_osc_params(tree, 1 / 2000, stiffness=400.0 * axes)
    wrench, forces = np.zeros((4, 6)), []
    wrench[:, 2] = -asked

    def wall(d, v):
        speed = (d.jacobian[:, 2] * v).sum(-1)
        force = np.maximum(1e5 * (at[:, 2] - d.pose[:, 2]) - 1e3 * speed, 0.0)
        forces.append(force)
        return force[:, None] * np.eye(6)[2]

    errors, *_ = run(tree, HAND, params, qpos, at, 1000, 1 / 2000, load=wall, wrench=wrench)
    np.testing.assert_allclose(forces[-1], asked, rtol=2e-3)
    assert np.abs(errors[-1][:, axes]).max() < 1e-3


def test_moves_of_10_cm_are_analytic():
    """e = e0 (1 + w t) exp(-w t) to 0.25 mm, in any direction."""
    tree, steps, dt = tree_of("panda"), 800, 1 / 2000
    qpos, way = np.tile(START, (6, 1)), 0.1 * np.vstack([np.eye(3), -np.eye(3)])
    goal = ts.link_poses(tree, qpos, [HAND])[:, 0]
    goal[:, :3] += way
    params = ts.make_osc_params(tree, dt, position_error_limit=np.inf, posture_stiffness=10.0)
    errors, *_ = run(tree, HAND, params, qpos, goal, steps, dt)
    w, t = np.sqrt(150), np.arange(steps)[:, None, None] * dt
    off = errors[..., :3] - (1 + w * t) * np.exp(-w * t) * way
    assert np.linalg.norm(off, axis=-1).max() < 0.25e-3
    assert np.abs(errors[..., 3:]).max() < 1e-4
