"""Coupled joints against the coupled dynamics, worked out by hand or by reduction."""

import numpy as np
import pytest
from tiny_urdf import write

from batchpid.sim import Robot, Runner

FREE_LIMIT = '<limit lower="-3" upper="3" effort="200" velocity="10"/>'


def body(name, mass, at="0 0 0.1", shape=""):
    moments = " ".join(f'{key}="{mass * 0.01}"' for key in ("ixx", "iyy", "izz"))
    inertia = f'<mass value="{mass}"/><inertia {moments} ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><origin xyz="{at}"/>{inertia}</inertial>{shape}</link>'


def hinge(
    name,
    parent,
    child,
    axis,
    origin,
    inner=FREE_LIMIT,
    kind="revolute",
):
    ends = (
        f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{origin}"/><axis'
        f' xyz="{axis}"/>'
    )
    return f'<joint name="{name}" type="{kind}">{ends}{inner}</joint>'


def arm(folder, joints, finger=0.02):
    """Return an arm with two sliding fingers and a claw on the first, all moved by the first
    finger.
    """
    parts = [body("base", 5.0), *(body(f"l{i}", 4.0 - 0.4 * i) for i in range(joints))]
    for i in range(joints):
        parent = f"l{i - 1}" if i else "base"
        parts.append(hinge(f"j{i}", parent, f"l{i}", "0 1 0" if i % 2 else "0 0 1", "0 0 0.2"))
    wrist, slide = f"l{joints - 1}", '<limit lower="0" upper="0.04" effort="20" velocity="1"/>'
    wide = '<limit lower="-9" upper="9" effort="5" velocity="9"/>'
    law = f'{wide}<mimic joint="left" multiplier="-1"/>'
    claw = f'{wide}<mimic joint="right" multiplier="20" offset="0.3"/>'  # a chain of followers
    parts += [body(name, finger, "0 0 0.03") for name in ("left_pad", "right_pad")] + [
        body("claw", finger, "0.02 0 0")
    ]
    for name, parent, child, origin, inner, kind in (
        ("left", wrist, "left_pad", "0 0.05 0.2", slide, "prismatic"),
        ("right", wrist, "right_pad", "0 -0.05 0.2", law, "prismatic"),
        ("curl", "left_pad", "claw", "0 0 0.05", claw, "revolute"),
    ):
        parts.append(hinge(name, parent, child, "0 1 0", origin, inner, kind))
    return Robot.load(write(folder, f'<robot name="arm">{"".join(parts)}</robot>'))


def constraint_error(robot, qpos):
    return float(np.abs(qpos - robot.coupling.positions(qpos)).max())


def test_the_coupled_mass_is_that_of_two_bodies_by_hand(tmp_path):
    """Two sliders of m1, m2 with q2 = k q1 under force F: (m1 + k^2 m2) q1'' = F."""
    slide = '<limit lower="-9" upper="9" effort="100" velocity="9"/>'
    m1, m2, k, force, ticks = 2.0, 0.5, -3.0, 1.5, 20
    follows = f'{slide}<mimic joint="a" multiplier="{k}" offset="0.4"/>'
    text = "".join(
        [
            body("base", 1.0),
            body("one", m1),
            body("two", m2),
            hinge("a", "base", "one", "1 0 0", "0 0 1", slide, "prismatic"),
            hinge("b", "base", "two", "1 0 0", "0 1 1", follows, "prismatic"),
        ]
    )
    robot = Robot.load(write(tmp_path, f'<robot name="sliders">{text}</robot>'))
    share = 0.25  # an effort u2 on the follower acts as k u2 on the leader
    for effort in ([force, 0.0], [force * (1 - share), force * share / k]):
        with Runner(robot, 1, control="effort", workers=0) as runner:
            last = runner.rollout(np.tile(effort, (ticks, 1)))
        expected = force / (m1 + k**2 * m2) * last.time[-1]
        np.testing.assert_allclose(last.qvel[-1, 0], [expected, k * expected], rtol=2e-3)
        np.testing.assert_allclose(last.effort[-1, 0], [force, 0.0], rtol=1e-6)


@pytest.mark.parametrize("physics", ["accurate", pytest.param("fast", marks=pytest.mark.slow)])
def test_free_motion_is_that_of_the_reduced_equations(physics, tmp_path):
    """Unforced swing under gravity: the engine against the coupled forward dynamics at a finer
    step.
    """
    robot = arm(tmp_path, joints=3)
    dynamics, free, still = robot.dynamics(), robot.independent, np.zeros((1, robot.dof))
    q, v = robot.coupling.positions(np.array([[0.3, 0.5, -0.4, 0.02, 0, 0]])), still.copy()
    with Runner(
        robot,
        1,
        control="effort",
        compensate="none",
        workers=0,
        substeps=1,
        physics=physics,
        ground=False,
        timestep=1 / 4000,
    ) as runner:
        runner.reset(q)
        seen = runner.rollout(np.zeros((400, robot.dof)))
    dt = 1 / 40000
    for _ in range(4000):
        v = v + dt * dynamics.forward_dynamics(q, v, still)
        q = q + dt * v
    assert constraint_error(robot, seen.qpos) < 1e-5
    np.testing.assert_allclose(seen.qpos[-1, 0, free], q[0, free], atol=1e-3)


def add_post(scene, env):
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[0.025, 0.01, 0.15])
    builder.build_static()


@pytest.mark.parametrize("physics", [pytest.param("accurate", marks=pytest.mark.slow), "fast"])
def test_reset_puts_followers_in_place_and_a_blocked_follower_holds_its_leader(physics, tmp_path):
    """The right finger closes on a post; the left one touches nothing."""
    pad = (
        '<collision><origin xyz="0 0 0.03"/><geometry><box size="0.02 0.01'
        ' 0.06"/></geometry></collision>'
    )
    slide = '<limit lower="0" upper="0.08" effort="20" velocity="1"/>'
    parts = [
        body("base", 1.0),
        *(body(name, 0.02, "0 0 0.03", pad) for name in ("left_pad", "right_pad")),
        hinge("left", "base", "left_pad", "0 -1 0", "0 0.2 0", slide, "prismatic"),
        hinge(
            "right",
            "base",
            "right_pad",
            "0 1 0",
            "0 -0.06 0",
            f'{slide}<mimic joint="left"/>',
            "prismatic",
        ),
    ]
    gripper = Robot.load(write(tmp_path, f'<robot name="gripper">{"".join(parts)}</robot>'))
    with Runner(
        gripper,
        1,
        engine="sapien",
        control="effort",
        workers=0,
        physics=physics,
        ground=False,
        build=add_post,
    ) as runner:
        np.testing.assert_array_equal(runner.reset([0.01, 5.0]).qpos[0], np.float32([0.01, 0.01]))
        rollout = runner.rollout(np.tile([10.0, 0.0], (50, 1)))
    assert rollout.ok.all()
    # Surfaces meet at 0.045; half of 10 N goes through the coupling, whose stiffness is m / (8
    # dt^2).
    np.testing.assert_allclose(rollout.qpos[-10:, 0], 0.045, atol=2e-3)
    assert np.ptp(rollout.qpos[-10:, 0], axis=0).max() < 1e-4
