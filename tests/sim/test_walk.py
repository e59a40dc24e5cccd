"""The task that walks, and its quadruped: reward and falls as stated, any number of workers, both engines."""

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from batchpid.sim import Robot, Runner  # noqa: E402
from batchpid.sim.gym import WalkVectorEnv  # noqa: E402

QUICK = {"workers": 0, "engine": "mujoco", "physics": "fast", "timestep": 1 / 500}
AHEAD = [[0.5, 0.0, 0.0]] * 2


@pytest.fixture
def walkers():
    envs = WalkVectorEnv(3, max_episode_steps=None, **QUICK)
    yield envs
    envs.close()


@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_the_quadruped_stands_in_both_engines(engine):
    robot = Robot.load("quadruped", fixed_base=False)
    assert not Robot.load("quadruped").check()
    assert [finding.severity for finding in robot.check()] == ["note"]  # the ground is below it, at any height
    assert robot.dof == 12
    gains = robot.params(kp=100.0, kd=2.5)
    with Runner(robot, 1, workers=0, engine=engine, params=gains, compensate="none") as runner:
        start = runner.observe()
        assert start.base_pose[0, 2] == pytest.approx(0.4 * np.cos(0.8) + 0.022, abs=1e-4)  # the feet on the ground
        stood = runner.rollout(np.tile(robot.start, (100, 1)))
    assert np.abs(stood.base_pose[-1, 0, :3] - start.base_pose[0, :3]).max() < 0.02
    assert np.abs(stood.base_pose[-1, 0, 4:]).max() < 0.02
    jacobian = 0.2 * np.sin(0.8)  # of a foot's height by its knee's angle [m/rad]
    knees = stood.effort[-1, 0, 8:].sum()
    assert knees == pytest.approx(15.0 * 9.81 * jacobian, rel=0.15)


def test_gymnasiums_own_checks_pass():
    env = gymnasium.make("batchpid.sim.gym:batchpid/Walk-v0", **QUICK)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_the_reward_is_the_one_that_is_documented(walkers):
    walkers.reset(seed=4)
    random, last = np.random.default_rng(0), np.zeros((3, 12))
    for _ in range(5):
        action = random.uniform(-1, 1, (3, 12))
        observation, reward, *_ = walkers.step(action)
        seen = walkers.observed
        turn = Rotation.from_quat(seen.base_pose[:, 3:], scalar_first=True).inv()
        velocity, rate = turn.apply(seen.base_twist[:, :3]), turn.apply(seen.base_twist[:, 3:])
        tilt = turn.apply([0.0, 0.0, 1.0])
        command = observation[:, 9:12]
        wanted = np.exp(-((command - velocity)[:, :2] ** 2).sum(1) / 0.1)
        wanted += 0.5 * np.exp(-((command - rate)[:, 2] ** 2) / 0.25)
        wanted -= velocity[:, 2] ** 2 + 0.02 * (rate[:, :2] ** 2).sum(1) + 2 * (1 - tilt[:, 2] ** 2)
        wanted -= 1e-4 * (seen.effort**2).sum(1) + 0.01 * ((action - last) ** 2).sum(1)
        np.testing.assert_allclose(reward, wanted, atol=1e-4)
        np.testing.assert_allclose(observation[:, :9], np.hstack([velocity, rate, tilt]), atol=1e-4)
        np.testing.assert_allclose(
            observation[:, 12:36], np.hstack([seen.qpos - walkers.posture, seen.qvel]), atol=1e-5
        )
        np.testing.assert_allclose(observation[:, 36:48], action, atol=1e-6)
        last = action
    assert (np.abs(walkers.commands[0]) <= 1).all()
    assert np.ptp(command, axis=0)[[0, 2]].min() > 0.01  # every episode has its own
    assert observation[:, 48:] ** 2 @ np.ones(2) == pytest.approx(np.ones(3), abs=1e-6)


def test_an_episode_ends_when_the_robot_falls(walkers):
    walkers.reset(seed=1)
    lying, tilted = [0, 0, 0.1, 1, 0, 0, 0], [0, 0, 0.6, np.cos(0.55), np.sin(0.55), 0, 0]
    walkers.runner.reset(base_pose=[[0, 0, 0.31, 1, 0, 0, 0], lying, tilted])
    *_, terminated, truncated, info = walkers.step(np.zeros((3, 12)))
    assert terminated.tolist() == [False, True, True]
    assert not truncated.any()
    assert not info["diverged"].any()
    observation, reward, terminated, *_ = walkers.step(np.zeros((3, 12)))  # which begins the next episodes
    assert not terminated.any()
    assert (observation[1:, 8] > 0.99).all()
    assert (reward[1:] == 0).all()


def test_the_gait_alone_walks_and_is_the_same_for_any_number_of_workers():
    runs = []
    for workers in (0, 2):
        envs = WalkVectorEnv(3, commands=AHEAD, max_episode_steps=60, **QUICK | {"workers": workers})
        rows = [envs.reset(seed=7)[0]]
        for _ in range(58):
            observation, reward, terminated, _, info = envs.step(np.zeros((3, 12)))
            rows.append(np.hstack([observation, reward[:, None], terminated[:, None]]))
        assert not terminated.any()
        assert info["speed"].min() > 0.1
        rows += [envs.step(np.full((3, 12), 0.1))[0] for _ in range(5)]  # into the next episode
        runs.append(np.hstack(rows))
        envs.close()
    np.testing.assert_array_equal(runs[0], runs[1])
