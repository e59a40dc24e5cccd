"""Tasks of one's own: the hooks of the base class, and TorchRL."""

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium import spaces  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402
from tiny_urdf import one_joint, write  # noqa: E402

from batchpid.errors import InvalidArgumentError  # noqa: E402
from batchpid.sim import Robot, Runner  # noqa: E402
from batchpid.sim.gym import RobotEnv, RobotVectorEnv  # noqa: E402


class Swing(RobotVectorEnv):
    """A hinge that swings to one side: the action is the effort."""

    returned = None  # another value of a hook, by name

    def __init__(self, num_envs, *arguments, **options):
        super().__init__(num_envs, *arguments, control="effort", **options)

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
    envs = Swing(
        3, hinge, workers=0, rate_hz=100.0, autoreset_mode="Disabled", max_episode_steps=20
    )
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
        np.testing.assert_allclose(reward, observation[:, 0] - [0.09, 0.09, 0.0], atol=1e-6)
        ends |= {(env, "terminated") for env in np.flatnonzero(terminated)}
        ends |= {(env, "truncated") for env in np.flatnonzero(truncated)}
        assert (info["success"] == (observation[:, 0] > 0.2)).all()
        if (terminated | truncated).any():
            observation, _ = swings.reset(options={"reset_mask": terminated | truncated})
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
        ("command", np.zeros(3)),
        ("observe", np.zeros((3, 1))),
        ("observe", np.array([[0.0, 0], [0, np.nan], [0, 0]])),
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
        swings.step(np.zeros((3, 1)))
    swings.returned = None
    swings.reset(seed=0)  # the task goes on
    assert np.isfinite(swings.step(np.zeros((3, 1)))[0]).all()


@pytest.mark.parametrize(
    ("hook", "value", "argument"),
    [
        ("rate", np.zeros(3), "setpoint_rate"),
        ("rate", np.full((3, 1), np.inf), "setpoint_rate"),
    ],
)
def test_the_runner_checks_commands(swings, hook, value, argument):
    swings.reset(seed=0)
    swings.returned = hook, value
    with pytest.raises(InvalidArgumentError, match=f"^{argument}"):
        swings.step(np.zeros((3, 1)))
    swings.returned = None
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
            np.testing.assert_array_equal(
                observation, np.concatenate([seen.qpos, seen.qvel], axis=1)
            )
    assert np.abs(observation[:, 1]).min() > 0
    envs.close()


def test_a_task_needs_its_hooks():
    with pytest.raises(TypeError, match="observe"):
        RobotVectorEnv(1)


def test_torchrl_wraps_tasks_that_do_not_reset_themselves(hinge):
    """Its GymWrapper resets ended envs by ``options["reset_mask"]``, and keeps the last observation
    of an episode.
    """
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
    assert (
        run["next", "observation"][:, 3] != run["observation"][:, 4]
    ).all()  # the last one, and the next first one
    envs.close()
