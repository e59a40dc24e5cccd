"""Joint control whose setpoints are poses of a tool."""

from __future__ import annotations

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

import batchpid.task_space as ts
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Runner, Snapshot

HAND = "panda_hand"
START = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8, 0.02, 0.02])
UP = np.array([0, 0, 0.01, 0, 0, 0, 0])
OPTIONS = {"workers": 0, "timestep": 1 / 500, "substeps": 5, "setpoint_space": "tool", "tool": HAND}


@pytest.fixture(scope="module")
def panda():
    return load_bundled("panda")


def line(panda, ticks, envs):
    """Return setpoints (ticks, envs, 7): 10 cm along y, differently tilted quaternions."""
    goals = np.tile(ts.link_poses(panda.kinematic_tree(), START, [HAND])[0], (ticks, envs, 1))
    goals[..., 1] += 0.1 * np.minimum(np.arange(ticks) / 30, 1.0)[:, None]
    goals[..., 3:] *= np.linspace(-3, 2, envs)[None, :, None]
    return goals


def test_the_tool_arrives_and_ticks_are_those_of_a_rollout(panda, tmp_path):
    goals = line(panda, 150, 2)
    with Runner(panda, 2, **OPTIONS) as runner:
        assert runner.command.labels[:3] == ("x [m]", "y [m]", "z [m]")
        assert runner.command.names[7:] == ("panda_finger_joint1", "panda_finger_joint2")
        runner.reset(START)
        rollout = runner.rollout(goals)
        runner.snapshot().save(tmp_path / "end.npz")
        last = runner.step(goals[-1] + UP)
    np.testing.assert_allclose(rollout.tool_pose[-1, :, :3], goals[-1, :, :3], atol=2e-3)
    np.testing.assert_allclose(rollout.setpoint[..., 7:], 0.02)
    assert np.abs(np.diff(rollout.setpoint, axis=0)).max() < 0.02  # continuous
    found = ts.link_poses(panda.kinematic_tree(), rollout.setpoint, [HAND])[..., 0, :3]
    np.testing.assert_allclose(found, goals[..., :3], atol=1e-5)
    with Runner(panda, 2, **OPTIONS | {"workers": 1}) as other:
        other.reset(START)
        for goal in goals[:20]:
            other.send(goal)
            seen = other.recv()
        assert_identical(rollout.observation.for_envs(19), seen)
        other.restore(Snapshot.load(tmp_path / "end.npz"))
        assert_identical(other.step(goals[-1] + UP), last)


def test_other_joints_are_set_too_and_a_reset_begins_anew(panda):
    goals = np.concatenate([line(panda, 1, 2)[0], [[0.01, 0.03]] * 2], axis=1)
    with Runner(panda, 2, **OPTIONS) as runner:
        runner.reset(START)
        first = runner.rollout(goals[None]).setpoint[0]
        np.testing.assert_allclose(first[:, 7:], [[0.01, 0.03]] * 2)
        again = np.add(START, [0.4, 0, -0.4, 0, 0, 0, 0, 0, 0])
        runner.reset(again, mask=[False, True])
        both = runner.rollout(goals[None, :, :7]).setpoint[0]
    np.testing.assert_array_equal(both[0], first[0])
    np.testing.assert_allclose(both[1, 7:], 0.02)
    assert np.abs(both[1] - first[1]).max() > 0.1  # the other solution, which is nearer


def test_a_pose_out_of_reach_is_a_warning_and_invalid_numbers_are_contained(panda):
    goals = line(panda, 1, 3)[0]
    goals[1, 0] = 3.0
    with Runner(panda, 3, **OPTIONS, on_invalid_input="contain") as runner:
        runner.reset(START)
        with pytest.warns(ts.InverseKinematicsWarning, match=r"setpoint, env 1.*not reached.*mm") as seen:
            runner.step(goals)
        assert seen[0].filename == __file__
        goals[2, 3:] = 0.0
        goals[0, 2] = np.nan
        with pytest.warns(UserWarning, match="env 0"):
            assert runner.step(goals).ok.tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"control": "effort"}, "setpoint_space: 'tool' makes joint setpoints"),
        ({"control": "osc"}, "setpoint_space: 'tool' makes joint setpoints"),
        ({"setpoint_space": "hand"}, "setpoint_space: unknown option"),
        ({"setpoint_space": "joints"}, "tool: is for control 'osc' or setpoint_space 'tool'"),
        ({"tool": "panda_hnd"}, "did you mean 'panda_hand'"),
    ],
)
def test_options_are_checked(panda, options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Runner(panda, 1, **OPTIONS | options)


def test_setpoints_are_checked(panda):
    goals = line(panda, 1, 2)[0]
    with Runner(panda, 2, **OPTIONS) as runner:
        for setpoint, message in (
            (goals[:, :6], r"setpoint: has shape"),
            (goals * [1, 1, 1, 0, 0, 0, 0], "setpoint, entry 'qw', env 0.*quaternion of length 0"),
            (goals * np.nan, "setpoint, entry 'x', env 0"),
        ):
            with pytest.raises(InvalidArgumentError, match=message):
                runner.step(setpoint)
        runner.reset(START)
        with pytest.raises(InvalidArgumentError, match=r"setpoint_rate: has shape \(2, 7\), not \(2, 8\)"):
            runner.step(goals, setpoint_rate=goals)
        with pytest.raises(InvalidArgumentError, match="setpoint_rate, entry 'wx', env 1"):
            runner.step(goals, setpoint_rate=[[0.0] * 6, [0.0, 0.0, 0.0, np.inf, 0.0, 0.0]])
        with pytest.raises(InvalidArgumentError, match="setpoint_acceleration: is for joint setpoints"):
            runner.step(goals, setpoint_acceleration=goals)


@pytest.mark.filterwarnings("ignore::batchpid.sim.MovingSetpointWarning")
def test_a_tool_that_moves_follows_its_poses_with_its_twist(panda):
    """The joints' rates are those whose tool has the twist; without them the tool stays behind."""
    ticks, dt = 100, 0.01
    time = dt * np.arange(1, ticks + 1)
    goals = np.tile(ts.link_poses(panda.kinematic_tree(), START, [HAND])[0], (ticks, 2, 1))
    twist = np.zeros((ticks, 2, 6))
    goals[..., 1] += 0.1 * (1 - np.cos(np.pi * time))[:, None]
    twist[..., 1] = 0.1 * np.pi * np.sin(np.pi * time)[:, None]
    behind = {}
    for rates in (None, twist):
        with Runner(panda, 2, **OPTIONS) as runner:
            runner.reset(START)
            rollout = runner.rollout(goals, setpoint_rates=rates)
            behind[rates is None] = np.linalg.norm(rollout.tool_pose[..., :3] - goals[..., :3], axis=-1).max()
    assert behind[True] > 0.03
    assert behind[False] < 0.01
