"""Tasks: the hooks of the base class, the tool's and the box's tasks, pictures, and adapters of other libraries."""

import importlib
import os
import signal
import sys
from types import ModuleType

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium import spaces  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from batchpid.errors import InvalidArgumentError  # noqa: E402
from batchpid.sim import RecoveryWarning, Robot, Runner  # noqa: E402
from batchpid.sim.gym import PushVectorEnv, RobotEnv, RobotVectorEnv, ToolReachVectorEnv  # noqa: E402
from tests.sim.tiny_urdf import one_joint, write  # noqa: E402


def rotation_error(wanted, measured):
    """Return the rotation vectors (..., 3) from orientations to others (w, x, y, z)."""
    turn = [Rotation.from_quat(np.asarray(each), scalar_first=True) for each in (wanted, measured)]
    return (turn[0] * turn[1].inv()).as_rotvec()


class Swing(RobotVectorEnv):
    """A hinge that swings to one side: the action is the effort."""

    returned = None  # another value of a hook, by name

    def runner_options(self):
        return {"control": "effort"}

    def spaces(self):
        return spaces.Box(-50, 50, (2,)), spaces.Box(-3.0, 3.0, (1,), np.float32)

    def draw(self, env, random):
        return self._or("draw", random.uniform(-0.1, 0.1, 1))

    def command(self, action, setpoint):
        self.last = setpoint
        return self._or("command", action)

    def rate(self, setpoint, last):
        return self._or("rate", None)

    def observe(self, observed):
        return self._or("observe", np.concatenate([observed.qpos, observed.qvel], axis=1))

    def success(self, observation):
        return self._or("success", observation[:, 0] > 0.2)

    def reward(self, observation, success):
        return self._or("reward", observation[:, 0] - 0.01 * self.action[:, 0] ** 2)

    def terminated(self, observation, success):
        return self._or("terminated", observation[:, 0] < -0.2)

    def info(self, observation):
        return {"speed": self._or("info", np.abs(self.observed.qvel[:, 0]))}

    def _or(self, hook, value):
        name, other = self.returned or (None, None)
        return other if name == hook else value


class Jaco(Swing):
    def __init__(self, num_envs, robot="jaco2", **options):
        super().__init__(num_envs, robot, **options)


def test_one_robot_of_a_task_is_by_default_the_tasks_own(hinge):
    single = type("JacoEnv", (RobotEnv,), {"task": Jaco})
    for given, name in (((), "jaco2"), (("jaco2",), "jaco2"), ((hinge,), hinge.name)):
        env = single(*given)
        assert env.runner.robot.name == name
        env.close()


@pytest.fixture(scope="module")
def hinge(tmp_path_factory):
    return Robot.load(write(tmp_path_factory.mktemp("hinge"), one_joint()))


@pytest.fixture
def swings(hinge):
    envs = Swing(3, hinge, workers=0, rate_hz=100.0, autoreset_mode="SameStep", max_episode_steps=20)
    yield envs
    envs.close()


def test_a_task_is_defined_by_its_hooks(swings):
    observation, info = swings.reset(seed=1)
    assert np.abs(observation[:, 0]).max() <= 0.1
    ends, actions = set(), np.array([[9.0], [-9.0], [0.0]])  # beyond the action space
    for _ in range(20):
        before = observation[:, 0]
        observation, reward, terminated, truncated, info = swings.step(actions)
        assert swings.action.ravel().tolist() == [3.0, -3.0, 0.0]
        final = np.where(info.get("_final_obs", np.zeros(3, bool)), 0, observation[:, 0])
        np.testing.assert_allclose(reward[final != 0], (final - [0.09, 0.09, 0.0])[final != 0], atol=1e-6)
        ends |= {(env, "terminated") for env in np.flatnonzero(terminated)}
        ends |= {(env, "truncated") for env in np.flatnonzero(truncated)}
        assert (info["success"] == (observation[:, 0] > 0.2)).all()
    assert before.shape == (3,)
    assert ends >= {(1, "terminated"), (2, "truncated")}
    assert not any(env == 0 and how == "terminated" for env, how in ends)  # success does not end it
    assert swings.last.shape == (3, 1)


def test_an_effort_is_zero_until_the_first_action(swings):
    swings.reset(seed=1)
    swings.step(np.ones((3, 1)))
    assert swings.last.tolist() == [[0.0]] * 3


@pytest.mark.parametrize(
    ("hook", "value"),
    [
        ("draw", np.zeros(2)),
        ("observe", np.zeros((3, 1))),
        ("observe", np.array([[0.0, 0], [0, np.nan], [0, 0]])),
        ("command", np.zeros(3)),
        ("rate", np.zeros(3)),
        ("rate", np.full((3, 1), np.inf)),
        ("success", np.zeros((3, 1), bool)),
        ("reward", 0.0),
        ("reward", np.array([0, np.inf, 0])),
        ("terminated", np.zeros(2, bool)),
        ("info", np.zeros(2)),
    ],
)
def test_a_wrong_result_of_a_hook_is_named(swings, hook, value):
    swings.reset(seed=0)
    swings.returned = hook, value
    with pytest.raises(InvalidArgumentError, match=f"^Swing.{hook}: "):
        swings.reset() if hook == "draw" else swings.step(np.zeros((3, 1)))
    swings.returned = None
    swings.reset(seed=0)  # the task goes on
    assert np.isfinite(swings.step(np.zeros((3, 1)))[0]).all()


class Nod(RobotVectorEnv):
    """A hinge whose setpoint moves by the action; its runner's ticks are repeated by the test."""

    def spaces(self):
        return spaces.Box(-50, 50, (2,)), spaces.Box(-1.0, 1.0, (1,), np.float32)

    def command(self, action, setpoint):
        return setpoint + 0.02 * action

    def observe(self, observed):
        return np.concatenate([observed.qpos, observed.qvel], axis=1)

    def reward(self, observation, success):
        return observation[:, 0]


class SmoothNod(Nod):
    def rate(self, setpoint, last):
        return (setpoint - last) / self.step_seconds


@pytest.mark.parametrize("task", [Nod, SmoothNod])
def test_setpoints_are_steps_unless_a_task_gives_their_rates(hinge, task):
    envs, actions = task(2, hinge, workers=0, max_episode_steps=4), np.array([[1.0], [-0.5]])
    observation, _ = envs.reset(seed=0)
    with Runner(hinge, 2, workers=0, substeps=envs.runner.substeps) as runner:
        setpoint = runner.reset(observation[:, :1]).qpos.astype(float)
        for number in range(6):
            begins = number == 4  # the step after a time limit begins the next episode
            rate = np.zeros((2, 1)) if begins else 0.02 * actions / envs.step_seconds
            setpoint = setpoint if begins else setpoint + 0.02 * actions
            seen = runner.step(setpoint, setpoint_rate=rate if task is SmoothNod else None)
            if begins:
                seen = runner.reset()
                setpoint = seen.qpos.astype(float)
            observation, *_ = envs.step(actions)
            np.testing.assert_array_equal(observation, np.concatenate([seen.qpos, seen.qvel], axis=1))
    assert np.abs(observation[:, 1]).min() > 0
    envs.close()


def test_a_step_whose_hook_was_interrupted_can_be_waited_for_again(swings, monkeypatch):
    def interrupted(observed):
        monkeypatch.undo()
        raise KeyboardInterrupt

    first, _ = swings.reset(seed=2)
    expected = swings.step(np.ones((3, 1)))[0]
    assert (swings.reset(seed=2)[0] == first).all()
    swings.step_async(np.ones((3, 1)))
    monkeypatch.setattr(swings, "observe", interrupted)
    with pytest.raises(KeyboardInterrupt):
        swings.step_wait()
    assert (swings.step_wait()[0] == expected).all()


def test_options_that_a_task_chooses_are_refused(hinge):
    with pytest.raises(TypeError, match="observe"):
        RobotVectorEnv(1)
    with pytest.raises(InvalidArgumentError) as caught:
        Swing(1, hinge, control="pid")
    assert caught.value.argument == "control"


# -- tasks of a tool ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_targets_at_the_goals_bring_the_tools_there(engine):
    if engine == "mujoco":
        pytest.importorskip("mujoco")
    envs = ToolReachVectorEnv(3, workers=0, rotation=0.4, engine=engine, terminate_on_success=True)
    observation, info = envs.reset(seed=4)
    goals, first = observation[:, -7:].astype(float), info["distance"]
    turns = rotation_error(goals[:, 3:], envs.pose_at(np.zeros(6))[3:])
    assert np.abs(turns).max() <= 0.4
    action = np.concatenate([(goals[:, :3] - envs.center) / 0.15, turns / 0.4], axis=1)
    reached = np.zeros(3, bool)
    for _ in range(40):
        if reached.all():
            break
        observation, reward, terminated, _, info = envs.step(action)
        assert (terminated == info["success"]).all()
        assert (reward[terminated & ~reached] > 0.98).all()
        reached |= terminated
    assert reached.all()
    assert (first > 0.05).all()
    envs.close()


def test_increments_move_the_target_within_the_workspace():
    envs = ToolReachVectorEnv(2, workers=0, actions="increment", workspace=(0.05, 0.1, 0.1), rotation=0.2)
    observation, _ = envs.reset(seed=0)
    tool = observation[:, -14:-7]
    envs.step(np.array([[0, 0.5, 0, 0, 0, 0]] * 2))
    moved = envs._setpoint - tool
    np.testing.assert_allclose(moved[:, :3], [[0, 0.01, 0]] * 2, atol=2e-7)
    np.testing.assert_allclose(moved[:, 3:], 0, atol=2e-7)  # the orientation is the one drawn at the start
    np.testing.assert_allclose(envs._rate, [[0, 0.5, 0, 0, 0, 0]] * 2, atol=1e-5)  # 0.01 m in 20 ms
    for _ in range(12):
        observation, *_ = envs.step(np.array([[1.0, -1, 0, 1, 0, 0]] * 2))
    np.testing.assert_allclose(envs._setpoint[:, :2] - envs.center[:2], [[0.05, -0.1]] * 2, atol=1e-12)
    turn = rotation_error(envs._setpoint[:, 3:7], envs.pose_at(np.zeros(6))[3:])
    np.testing.assert_allclose(turn[:, 0], 0.2, atol=1e-12)
    assert np.abs(envs._rate).max() < 1e-9  # at rest at the limits
    assert envs.observation_space.contains(observation)
    envs.close()


def tool_after_increments(action, steps, **osc):
    """Return the targets and the tools (1, 3) after equal increments, and the last change of the target per second."""
    options = {"rotation": 0.6} if len(action) == 6 else {}
    envs = ToolReachVectorEnv(1, workers=0, actions="increment", osc={"stiffness": 400.0, **osc}, **options)
    envs.reset(seed=0)
    first = envs._setpoint
    for _ in range(steps):
        last = envs._setpoint
        envs.step(np.array([action]))
    setpoint, tool, seconds = envs._setpoint, envs.observed.tool_pose.astype(float), envs.step_seconds
    envs.close()
    np.testing.assert_array_equal(first[:, 7:], 0.0)
    rate = np.concatenate([setpoint[:, :3] - last[:, :3], rotation_error(setpoint[:, 3:7], last[:, 3:7])], axis=1)
    error = np.concatenate([setpoint[:, :3] - tool[:, :3], rotation_error(setpoint[:, 3:7], tool[:, 3:])], axis=1)
    return setpoint, error[0], rate[0] / seconds


def test_a_tool_follows_increments_with_less_lag_than_without_twist():
    action = [0.0, -0.1, 0.0, 0.0, 0.0, 0.2]
    _, error, rate = tool_after_increments(action, 20)
    assert np.abs(rate)[[1, 5]] == pytest.approx([0.1, 1.0], rel=0.01)
    _, late, _ = tool_after_increments(action, 20, twist=False)
    lag, lag_without = error[[1, 5]] / rate[[1, 5]], late[[1, 5]] / rate[[1, 5]]
    assert (lag_without > 0.08).all()
    assert (np.abs(lag) < 0.015).all()  # the pose is held for a step of 20 ms, half of which the tool is ahead


def test_a_target_that_returns_to_the_workspace_is_a_step_without_twist():
    envs = ToolReachVectorEnv(1, workers=0, actions="increment")
    envs.reset(seed=0)
    envs.step(np.array([[0.0, 0.1, 0.0]]))
    assert envs._rate[0].tolist() == pytest.approx([0.0, 0.1, 0.0, 0.0, 0.0, 0.0])
    envs.close()
    envs = ToolReachVectorEnv(1, workers=0, actions="increment", workspace=0.0)
    envs.reset(seed=0)
    envs.step(np.array([[0.0, 0.1, 0.0]]))
    assert (envs._setpoint[0, :3] == envs.center).all()
    np.testing.assert_array_equal(envs._rate[0], 0.0)
    envs.close()


def test_targets_in_the_workspace_are_steps_of_the_pose():
    for osc, size in ({"stiffness": 400.0}, 7), ({"twist": True}, 13):
        envs = ToolReachVectorEnv(1, workers=0, osc=osc)
        envs.reset(seed=0)
        envs.step(np.full((1, 3), 0.5))
        assert (envs._setpoint.shape, envs.runner.command.size) == ((1, 7), size)
        np.testing.assert_array_equal(envs._rate[0], 0.0)
        envs.close()


@pytest.mark.slow
def test_a_pushed_box_is_the_same_in_workers_and_after_a_lost_one():
    """Both tools go straight ahead; the goal of each is beyond its box."""
    runs = []
    for workers in (0, 1):
        envs = PushVectorEnv(2, workers=workers, actions="increment", rate_hz=100.0, max_episode_steps=22)
        observation, first = envs.reset(seed=1)
        rows, action = [observation], np.array([[0.35, 0, 0], [0, 0.2, 0]])
        for step in range(24):
            if workers and step == 17:
                os.kill(envs.runner.pids[0], signal.SIGKILL)
                with pytest.warns(RecoveryWarning):
                    observation, *_, info = envs.step(action)
            else:
                observation, *_, info = envs.step(action)
            rows.append(observation)
            if step == 21:
                nearer = info["distance"] < first["distance"] - 0.01
            np.testing.assert_array_equal(observation[:, -9:-2], envs.runner.poses()[:, 0])
        runs.append(rows)
        if not workers:
            snapshot, there = envs.runner.snapshot(), envs.runner.poses()
            envs.step(action)
            assert (envs.runner.poses() != there).any()
            envs.runner.restore(snapshot)
            np.testing.assert_array_equal(envs.runner.poses(), there)
        assert nearer.tolist() == [True, False]
        np.testing.assert_array_equal(rows[-2][:, -9:-2], rows[0][:, -9:-2])  # a new episode: the boxes are back
        assert (rows[-2][:, -2:] != rows[0][:, -2:]).all()  # and have other goals
        envs.close()
    np.testing.assert_array_equal(*runs)


@pytest.mark.slow
def test_every_goal_of_a_box_can_be_reached():
    """A rule pushes along x from behind the box, then along y from its side."""
    envs = PushVectorEnv(12, actions="increment", max_episode_steps=None)
    observation, _ = envs.reset(seed=100)
    reached = np.zeros(12, bool)
    for _ in range(250):
        tool, box, goal = (
            observation[:, part].astype(float) for part in (slice(-16, -14), slice(-9, -7), slice(-2, None))
        )
        (x, y), off = (goal - box).T, tool - box
        side = np.sign(y)
        behind = (np.abs(off[:, 1]) < 0.008) & (off[:, 0] < -0.03)
        aside = -side * off[:, 1] > 0.05
        aligned = aside & (np.abs(off[:, 0]) < 0.008)
        along_x = box + np.where(behind, -0.02, -0.06)[:, None] * [1, 0]
        around = np.where(
            (off[:, 0] < -0.055)[:, None],
            box - np.stack([np.full(12, 0.07), 0.085 * side], axis=1),
            np.stack([box[:, 0] - 0.075, tool[:, 1]], axis=1),
        )
        from_side = box - np.stack([np.zeros(12), np.where(aligned, 0.035, 0.08) * side], axis=1)
        along_y = np.where(aside[:, None], from_side, around)
        target = np.where((x > 0.012)[:, None], along_x, np.where((np.abs(y) > 0.008)[:, None], along_y, tool))
        move = np.clip((target - envs._setpoint[:, :2]) / 0.02, -0.4, 0.4)
        observation, *_, info = envs.step(np.concatenate([move, np.zeros((12, 1))], axis=1))
        reached |= info["success"]
        if reached.all():
            break
    assert reached.all()
    envs.close()


# -- adapters ----------------------------------------------------------------------------------------------------------


class StandInVecEnv:
    """What the adapter uses of Stable-Baselines3's VecEnv, for machines without it."""

    def __init__(self, num_envs, observation_space, action_space):
        self.num_envs, self.observation_space, self.action_space = num_envs, observation_space, action_space
        self._reset_seeds()

    def _reset_seeds(self):
        self._seeds = [None] * self.num_envs

    def seed(self, seed):
        self._seeds = [seed + env for env in range(self.num_envs)]

    def step(self, actions):
        self.step_async(actions)
        return self.step_wait()

    def _get_indices(self, indices):
        return range(self.num_envs) if indices is None else [indices] if isinstance(indices, int) else indices


@pytest.fixture
def adapter(monkeypatch):
    """The module of the adapter, over the real package where it is installed."""
    try:
        import stable_baselines3  # noqa: F401
    except ImportError:
        stand_in = ModuleType("stable_baselines3.common.vec_env")
        stand_in.VecEnv = StandInVecEnv
        for name in ("stable_baselines3", "stable_baselines3.common"):
            monkeypatch.setitem(sys.modules, name, ModuleType(name))
        monkeypatch.setitem(sys.modules, stand_in.__name__, stand_in)
    yield importlib.import_module("batchpid.sim.gym.stable_baselines3")
    del sys.modules["batchpid.sim.gym.stable_baselines3"]


def test_stable_baselines3_gets_the_last_observation_of_an_episode(adapter, swings):
    vec = adapter.TaskVecEnv(swings)
    vec.seed(3)
    first = vec.reset()
    assert (first == swings.reset(seed=3)[0]).all()
    assert vec.reset_infos[0].keys() == {"success", "speed", "diverged", "is_success"}
    for _ in range(20):
        observation, reward, ends, infos = vec.step(np.array([[3.0], [-3.0], [0.0]]))
        assert reward.dtype == np.float32
        assert [info["is_success"] for info in infos] == [info["success"] for info in infos]
        for env, (end, info) in enumerate(zip(ends, infos, strict=True)):
            assert ("terminal_observation" in info) == end
            if end:
                last = info["terminal_observation"][0]
                assert info["TimeLimit.truncated"] == (last >= -0.2)
                assert abs(observation[env, 0]) <= 0.1 < abs(last) or env == 2
                assert info["is_success"] == (last > 0.2)
            else:
                assert not info["TimeLimit.truncated"]
    assert ends[2]
    assert vec.get_attr("num_envs", [0, 1]) == [3, 3]
    assert vec.env_is_wrapped(RobotEnv) == [False] * 3
    assert list(vec.get_images()) == [None] * 3


def test_stable_baselines3_needs_the_resets_within_a_step(adapter, hinge):
    with Closing(Swing(1, hinge, workers=0)) as envs, pytest.raises(InvalidArgumentError, match="SameStep"):
        adapter.TaskVecEnv(envs)
    with pytest.raises(InvalidArgumentError, match="envs: is not a task"):
        adapter.TaskVecEnv(3)


class Closing:
    def __init__(self, envs):
        self.envs = envs

    def __enter__(self):
        return self.envs

    def __exit__(self, *_):
        self.envs.close()


def test_stable_baselines3_trains(swings):
    library = pytest.importorskip("stable_baselines3")
    from batchpid.sim.gym.stable_baselines3 import TaskVecEnv

    model = library.PPO("MlpPolicy", TaskVecEnv(swings), n_steps=16, batch_size=48, n_epochs=1, device="cpu")
    assert model.learn(48).num_timesteps == 48


def test_torchrl_wraps_tasks_that_do_not_reset_themselves(hinge):
    """Its GymWrapper resets ended envs by ``options["reset_mask"]``, and keeps the last observation of an episode."""
    library = pytest.importorskip("torchrl.envs")
    from torchrl.envs.utils import check_env_specs

    task = Swing(2, hinge, workers=0, autoreset_mode=AutoresetMode.DISABLED, max_episode_steps=4)
    envs = library.GymWrapper(task)
    check_env_specs(envs)
    envs.set_seed(3)
    run = envs.rollout(6, break_when_any_done=False)
    assert run.batch_size == (2, 6)
    assert run["next", "truncated"][..., 0].int().tolist() == [[0, 0, 0, 1, 0, 0]] * 2
    assert (run["next", "observation"][:, 2] == run["observation"][:, 3]).all()
    assert (run["next", "observation"][:, 3] != run["observation"][:, 4]).all()  # the last one, and the next first one
    envs.close()
