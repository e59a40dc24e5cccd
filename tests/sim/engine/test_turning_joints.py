"""Continuous joints, whose positions jump in SAPIEN, against hand calculation."""

import numpy as np
import pytest
from tiny_urdf import one_joint, write

from batchpid.sim import Robot, Runner


def wheel(folder, kind="", multiplier=0.0):
    """Return a wheel of 0.02 kg m^2, with a body of 0.2 kg or 0.002 kg m^2 that follows it."""
    moments = '<inertia ixx="{0}" iyy="{0}" izz="{0}" ixy="0" ixz="0" iyz="0"/>'
    parts = ['<link name="base"/>']
    for name, mass, moment in (("rim", 1.0, 0.02), ("gear", 0.2, 0.002))[: 2 if kind else 1]:
        parts.append(
            f'<link name="{name}"><inertial><mass'
            f' value="{mass}"/>{moments.format(moment)}</inertial></link>'
        )
    limit = '<limit lower="-90" upper="90" effort="20" velocity="20"/>'
    law = f'<mimic joint="wheel" multiplier="{multiplier}"/>'
    for name, type_, child, inner in (
        ("wheel", "continuous", "rim", limit),
        ("follower", kind, "gear", limit + law),
    ):
        axis = "1 0 0" if type_ == "prismatic" else "0 0 1"  # gravity acts on neither
        ends = f'<parent link="base"/><child link="{child}"/><axis xyz="{axis}"/>{inner}'
        parts.append(f'<joint name="{name}" type="{type_}">{ends}</joint>' if type_ else "")
    return Robot.load(write(folder, f'<robot name="wheel">{"".join(parts)}</robot>'))


@pytest.mark.parametrize(
    ("kind", "multiplier"),
    [("continuous", 0.25), ("revolute", -1.0), ("prismatic", 0.01), ("continuous", np.sqrt(2))],
)
def test_a_follower_stays_with_its_leader_over_many_turns(kind, multiplier, tmp_path):
    """q = tau t^2 / (2 J), with J = J_leader + m^2 J_follower."""
    robot, ticks = wheel(tmp_path, kind, multiplier), 120
    inertia = 0.02 + multiplier**2 * (0.2 if kind == "prismatic" else 0.002)
    options = {"control": "effort", "compensate": "none", "engine": "sapien"}
    with Runner(robot, 1, workers=0, ground=False, **options) as runner:
        runner.reset([2.0, 0.0])
        seen = runner.rollout(np.tile([0.5, 0.0], (ticks, 1)))
    assert seen.ok.all()
    qvel = seen.qvel[:, 0]
    np.testing.assert_allclose(qvel[:, 1], multiplier * qvel[:, 0], rtol=2e-3, atol=0.01)
    np.testing.assert_allclose(qvel[-1, 0], 0.5 / inertia * ticks * 0.01, rtol=3e-3)


@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
@pytest.mark.parametrize("kind", ["continuous", "prismatic"])
def test_speeds_are_those_of_fast_motors(kind, engine, tmp_path):
    """v = F t / m, far beyond PhysX's defaults: 10 m/s and 50 rad/s of links, 100 of joints."""
    limit = '<limit lower="-9e3" upper="9e3" effort="900" velocity="900"/>'
    robot = Robot.load(write(tmp_path, one_joint(limit, kind)))
    options = {
        "control": "effort",
        "compensate": "gravity+coriolis",
        "ground": False,
        "engine": engine,
    }
    with Runner(robot, 1, workers=0, **options) as runner:
        seen = runner.rollout(np.full((200, 1), 20.0 if kind == "continuous" else 200.0))
    np.testing.assert_allclose(seen.qvel[-1, 0], 2 * 200, rtol=1e-2)


@pytest.mark.quick_rows(8)
@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
@pytest.mark.parametrize(
    "options", [{}, {"guard": True}, {"params": "designed"}], ids=["plain", "guard", "integral"]
)
@pytest.mark.parametrize(("start", "goal"), [(3.0, -3.0), (6.2, 6.6), (-5.9, -26.0), (0.3, 7.0)])
def test_a_drive_goes_the_short_way_round(start, goal, options, engine, tmp_path):
    robot = wheel(tmp_path)
    if "params" in options:
        options = {
            "params": (
                robot.designed("effort").replace(setpoint_weight=None, derivative_filter_time=None)
            )
        }
    with Runner(
        robot, 1, control="drive", workers=0, ground=False, engine=engine, **options
    ) as runner:
        runner.reset([start])
        seen = runner.rollout(np.full((300, 1), goal))
    left = np.remainder(seen.qpos[-1, 0, 0] - goal + np.pi, 2 * np.pi) - np.pi
    short = np.abs(np.remainder(start - goal + np.pi, 2 * np.pi) - np.pi)
    assert abs(left) < 2e-2
    assert np.abs(seen.qvel).sum() * 0.01 < 1.8 * short + 0.05
