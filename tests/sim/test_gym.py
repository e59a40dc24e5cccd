"""Gymnasium environments: Gymnasium's own checks, and the vector env against single envs."""

import importlib.util
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env, data_equivalence  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402
from tiny_urdf import LIMIT, gripper, joint, link, robot, write  # noqa: E402

from batchpid.errors import InvalidArgumentError  # noqa: E402
from batchpid.sim import CommandSpec, FaultWarning, Randomization, Robot, Uniform  # noqa: E402
from batchpid.sim.gym import ReachVectorEnv  # noqa: E402

ID = "batchpid.sim.gym:batchpid/Reach-v0"


def test_gymnasiums_own_checks_pass():
    check_env(gymnasium.make(ID).unwrapped)
    env = gymnasium.make(ID, robot="jaco2", actions="increment")
    check_env(env.unwrapped, skip_render_check=True)


def test_pictures_show_each_env(panda):
    envs = ReachVectorEnv(2, workers=0, render_mode="rgb_array")
    envs.runner.reset(panda.start)
    first, second = envs.render()
    assert (first.shape, first.dtype) == ((480, 640, 3), np.uint8)
    np.testing.assert_array_equal(first, second)
    envs.runner.reset([panda.start, panda.settings.target])
    np.testing.assert_array_equal(envs.render()[0], first)
    assert (envs.render()[1] != first).any()
    assert envs.metadata["render_fps"] == pytest.approx(50)
    envs.close()


def test_chunks_that_come_late_are_executed_whole():
    """What passes during the latency of an env is made up for, and a step is as long as its rows."""
    options = {"actions": "increment", "chunk": 6, "execute": 4, "latency": (0.02, 0.07)}
    envs = ReachVectorEnv(4, max_episode_steps=None, workers=0, **options)
    start, _ = envs.reset(seed=0)
    assert envs.step_seconds == pytest.approx(0.08)
    moves = np.full(envs.action_space.shape, 0.1)
    begin, (first, *_) = envs.runner.time, envs.step(moves)
    assert envs.runner.time - begin == pytest.approx(envs.step_seconds)
    joints = len(envs.joint_names)
    change = np.abs(first - start)[:, :joints] / envs.max_increment
    # Until its first chunk an env has no row ahead.
    waits = envs.observed.starved / envs.runner.substeps
    assert set(waits) <= {1.0, 2.0, 3.0}
    moved = change.max(1)
    assert moved[waits == waits.max()].max() < moved[waits == waits.min()].min() < 0.4
    # The observation ends in the pose that the chunk leads to.
    reached = np.minimum(start[:, :joints] + 0.4 * envs.max_increment, envs.high)
    np.testing.assert_allclose(start[:, 3 * joints :], start[:, :joints], atol=1e-6)
    np.testing.assert_allclose(first[:, 3 * joints :], reached, atol=1e-6)
    assert envs.observation_space.contains(first)
    for _ in range(25):
        last, *_ = envs.step(0 * moves)
    np.testing.assert_allclose(last[:, :joints], reached, atol=1e-3)
    envs.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
@pytest.mark.parametrize("actions", ["increment", pytest.param("setpoint", marks=pytest.mark.slow)])
def test_the_vector_env_is_bit_identical_to_gymnasiums_vector_of_single_envs(mode, actions):
    """Equal observations, rewards, flags and infos through time limits, success and resets."""
    drawn = Randomization(
        payload=Uniform(0, 1), qvel=Uniform(-0.1, 0.1), params={"kp": Uniform(-5, 5)}
    )
    options = {
        "actions": actions,
        "terminate_on_success": True,
        "tolerance": 3.6,
        "randomization": drawn,
    }
    ours = gymnasium.make_vec(
        ID, num_envs=3, workers=0, autoreset_mode=mode, max_episode_steps=4, **options
    )
    theirs = SyncVectorEnv(
        [lambda: gymnasium.make(ID, max_episode_steps=4, **options)] * 3, autoreset_mode=mode
    )
    assert ours.unwrapped.spec.id == "batchpid/Reach-v0"
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert same(ours.reset(seed=5), theirs.reset(seed=5))
    assert ours.unwrapped.runner.episodes.tolist() == [[5, 0], [6, 0], [7, 0]]
    ours.action_space.seed(1)
    ends = np.zeros(3, int)
    for _ in range(14):
        action = ours.action_space.sample()
        step = ours.step(action)
        assert same(step, theirs.step(action))
        assert ours.observation_space.contains(step[0])
        done = step[2] | step[3]
        ends += done
        if mode is AutoresetMode.DISABLED and done.any():
            assert same(
                ours.reset(options={"reset_mask": done.copy()}),
                theirs.reset(options={"reset_mask": done.copy()}),
            )
    assert (ends >= 2).all()
    assert step[0].flags.owndata
    ours.close()
    theirs.close()


def same(ours, theirs):
    def plain(value):
        if isinstance(value, dict):
            return {key: plain(entry) for key, entry in sorted(value.items())}
        return (
            [None if row is None else list(row) for row in value]
            if getattr(value, "dtype", None) == np.dtype(object)
            else value
        )

    assert set(ours[-1]) == set(theirs[-1])
    return data_equivalence(ours[:-1], theirs[:-1], exact=True) and str(plain(ours[-1])) == str(
        plain(theirs[-1])
    )


def test_a_failed_env_terminates_with_a_finite_observation_and_begins_again(panda):
    damping = panda.params().kd.repeat(2, 0)
    damping[0] = 1e9  # unstable
    params = panda.params(kd=damping, effort_limit=None)
    env = ReachVectorEnv(2, workers=0, params=params, actions="increment")
    env.reset(seed=0)
    action = np.zeros((2, 9), np.float32)
    action[0] = 1.0
    with pytest.warns(FaultWarning):
        obs, reward, terminated, _, info = env.step(action)
    assert terminated.tolist() == [True, False]
    assert info["diverged"].tolist() == [True, False]
    assert np.isfinite(obs).all()
    assert np.isfinite(reward).all()
    env.runner.params = panda.params()
    obs, _, terminated, _, info = env.step(np.zeros((2, 9)))
    assert not terminated.any()
    assert not info["diverged"].any()
    env.close()


def test_gymnasiums_vector_wrappers_wrap_the_vector_env():
    from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

    env = RecordEpisodeStatistics(
        NormalizeObservation(gymnasium.make_vec(ID, num_envs=2, max_episode_steps=3))
    )
    env.reset(seed=0)
    for _ in range(3):
        *_, info = env.step(env.action_space.sample())
    assert info["episode"]["l"].tolist() == [3, 3]
    env.close()


def test_actions_and_observations_are_those_of_independent_joints(tmp_path):
    hand = Robot.load(write(tmp_path, gripper()))
    env = ReachVectorEnv(2, hand, workers=0)
    observation, _ = env.reset(seed=0)
    assert env.single_action_space.shape == (1,)
    assert observation.shape == (2, 3)
    for _ in range(3):
        observation, *_ = env.step(np.array([[0.5], [-0.5]], np.float32))
    qpos = env.runner.observe().qpos
    left, right = hand.joint_names.index("left"), hand.joint_names.index("right")
    np.testing.assert_array_equal(observation[:, 0], qpos[:, left])
    np.testing.assert_allclose(qpos[:, right], -0.5 * qpos[:, left], atol=1e-5)
    env.close()


TURNS = np.arange(-3, 4)


@pytest.fixture(scope="module")
def carousel(tmp_path_factory):
    """Envs of a robot whose first joint is continuous, whose second cannot move, and whose third
    has a range.
    """
    still = LIMIT.replace('lower="-1" upper="1"', 'lower="0.5" upper="0.5"')
    joints = (
        joint("turn", "base", "a", "continuous", '<limit effort="50" velocity="9"/>'),
        joint("still", "a", "b", inner=still),
        joint("bend", "b", "c"),
    )
    path = write(
        tmp_path_factory.mktemp("carousel"), robot(*map(link, ("base", "a", "b", "c")), *joints)
    )
    options = {"actions": "increment", "workers": 0, "collisions": False, "max_increment": 0.05}
    envs = ReachVectorEnv(
        len(TURNS), Robot.load(path), max_episode_steps=None, tolerance=0.01, **options
    )
    yield envs
    envs.close()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), off=st.floats(-np.pi, np.pi))
def test_turns_of_a_continuous_joint_change_neither_observation_nor_reward(carousel, seed, off):
    observation, _ = carousel.reset(seed=[seed] * len(TURNS))
    assert (observation == observation[0]).all()
    pose = observation[:, 6:].astype(np.float64)
    pose[:, 0] += off + 2 * np.pi * TURNS
    carousel.runner.reset(pose)
    observation, reward, _, _, info = carousel.step(np.zeros((len(TURNS), 3)))
    assert carousel.observation_space.contains(observation)
    angle, goal = observation[:, 0].astype(np.float64), observation[:, 6].astype(np.float64)
    np.testing.assert_allclose(np.exp(1j * angle), np.exp(1j * angle[0]), atol=2e-4)
    way = np.abs(np.angle(np.exp(1j * (goal - angle))))
    error = np.maximum(way, np.abs(observation[:, 8] - observation[:, 2]))
    np.testing.assert_allclose(info["error"], error, atol=1e-5)
    np.testing.assert_array_equal(info["success"], info["error"] <= 0.01)
    np.testing.assert_allclose(reward, info["success"] - way / (6 * np.pi), atol=5e-3)


def test_a_joint_that_cannot_move_does_not_enter_the_reward(carousel):
    observation, _ = carousel.reset(seed=3)
    assert np.isfinite(carousel.step(np.zeros((len(TURNS), 3)))[1]).all()
    assert (observation[:, 7] == 0.5).all()


class Hold:
    """Controller whose setpoints are not of joints."""

    command = CommandSpec(("x", "z"))

    def init(self, robot, num_envs, timestep):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return state, passive


REFUSED = [
    (ReachVectorEnv, {"robto": "panda"}, "robto"),
    (ReachVectorEnv, {"timestep": 0}, "timestep"),
    (ReachVectorEnv, {"actions": "torque"}, "actions"),
    (ReachVectorEnv, {"render_mode": "human"}, "render_mode"),
    (ReachVectorEnv, {"autoreset_mode": "Never"}, "autoreset_mode"),
    (ReachVectorEnv, {"terminate_on_success": "no"}, "terminate_on_success"),
    (ReachVectorEnv, {"control": Hold()}, "control"),
    (ReachVectorEnv, {"control": "osc"}, "control"),
    (lambda num, **options: gymnasium.make_vec(ID, num, **options), {"robto": "panda"}, "robto"),
]


@pytest.mark.parametrize(("make", "options", "argument"), REFUSED)
def test_refused_arguments_are_named(make, options, argument):
    with pytest.raises(InvalidArgumentError) as caught:
        make(1, **options)
    assert caught.value.argument == argument


def test_refused_calls_name_their_argument_and_the_env_goes_on():
    env = ReachVectorEnv(2, workers=0, autoreset_mode="Disabled", max_episode_steps=1)
    for arguments, argument in (
        *(({"seed": seed}, "seed") for seed in ([1], -1, [0, -1], [0, 1.5], "ab")),
        ({"options": {"reset_masks": [True, False]}}, "reset_masks"),
        ({"options": {"reset_mask": [True]}}, "reset_mask"),
    ):
        with pytest.raises(InvalidArgumentError, match=argument):
            env.reset(**arguments)
    env.reset(seed=[1, 3])
    with pytest.raises(InvalidArgumentError, match="actions, entry 'panda_joint1'"):
        env.step(np.full((2, 9), np.nan))
    env.step(np.zeros((2, 9)))
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((2, 9)))
    env.close()


@pytest.fixture
def without_torch(monkeypatch):
    """Packages of Stable-Baselines3 whose own imports, PyTorch among them, are left out."""
    spec = importlib.util.find_spec("stable_baselines3")
    if spec is None:
        pytest.skip("needs stable-baselines3; without PyTorch: pip install --no-deps")
    folder = Path(spec.submodule_search_locations[0])
    for name in ("", "common", "common/vec_env"):
        module = types.ModuleType(".".join(["stable_baselines3", *name.split("/")]).rstrip("."))
        module.__path__ = [str(folder / name)]
        monkeypatch.setitem(sys.modules, module.__name__, module)


@pytest.mark.usefixtures("without_torch")
def test_stable_baselines3_gets_the_same_steps_and_the_last_observations():
    from batchpid.sim.gym import SB3VecEnv

    options = {"num_envs": 2, "workers": 0, "max_episode_steps": 3, "autoreset_mode": "Disabled"}
    with pytest.raises(InvalidArgumentError, match="reset themselves"):
        SB3VecEnv(gymnasium.make_vec(ID, num_envs=1, workers=0))
    plain = gymnasium.make_vec(ID, **options)
    adapted = SB3VecEnv(gymnasium.make_vec(ID, **options))
    adapted.seed(7)
    assert data_equivalence(adapted.reset(), plain.reset(seed=[7, 8])[0])
    assert adapted.env_is_wrapped(object) == [False, False]
    for step in range(5):
        action = plain.action_space.sample()
        observation, reward, terminated, truncated, _ = plain.step(action)
        last = observation
        if step == 2:
            observation, _ = plain.reset(options={"reset_mask": terminated | truncated})
        found, rewards, ends, infos = adapted.step(action)
        np.testing.assert_array_equal(found, observation)
        np.testing.assert_allclose(rewards, reward, rtol=1e-6)
        assert ends.tolist() == (terminated | truncated).tolist() == [step == 2] * 2
        if step == 2:
            assert infos[1]["TimeLimit.truncated"]
            np.testing.assert_array_equal(infos[1]["terminal_observation"], last[1])
    adapted.close()
    plain.close()
