"""PPO in JAX on batchpid/Reach-v0: one policy moves a robot to random joint poses by changes of its
setpoints.

    python examples/train_reach.py --picture train_reach.png

The algorithm is in ``ppo.py``. The robots step in worker processes, policy and updates run in this
one. docs/training.md explains the choices.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import ppo
import tyro
from matplotlib.figure import Figure

from batchpid.sim import Robot, plots

SCORES = ("success", "error")  # of the learning curve
SLOWEST = 0.15  # slope at 0 of a chunk's increments over the action
FINE = 0.2  # scale on which the agent sees small errors [rad or m]


@dataclass(frozen=True)
class Config(ppo.Config):
    """Train a policy, evaluate it, and draw the learning curve."""

    robot: str = "panda"  # Bundled robot, or path of a URDF.
    episode: int = 150  # Steps of an episode, 50 a second.
    shaping: float = 10.0  # Weight of the potential that shapes the reward.
    chunk: int | None = None  # Increments of an action, which a plan executes; None: no plan.
    latency: tuple[float, float] = (0.0, 0.0)  # Range of the chunks' latency [s].
    picture: Path | None = None  # Learning curve to draw: .png or .svg.
    out: Path | None = None  # Policy to write: .npz.
    policy: Path | None = None  # Policy to evaluate in place of a training: .npz.


def make_envs(config):
    """Return a vector env with gains that follow the setpoint: critically damped at 30 rad/s in
    every pose.
    """
    robot = Robot.load(config.robot)
    params = robot.params(
        kp=900.0, kd=60.0, ki=0.0, gain_units="mass_matrix", measurement_rate="measured"
    )
    options = {"params": params, "workers": config.workers, "collisions": False}
    task = {
        "robot": robot,
        "actions": "increment",
        "max_episode_steps": config.episode // (config.chunk or 1),
        "chunk": config.chunk,
        "latency": config.latency,
    }
    envs = gymnasium.make_vec(
        "batchpid.sim.gym:batchpid/Reach-v0", config.num_envs, **task, **options
    )
    if config.chunk is None:
        return envs
    # The agent gives one increment, which each row of the chunk repeats.
    single = gymnasium.spaces.Box(-1.0, 1.0, envs.single_action_space.shape[1:])
    return gymnasium.wrappers.vector.TransformAction(
        envs, lambda action: np.repeat(increment(action)[:, None], config.chunk, 1), None, single
    )


def increment(action):
    """Return the increments of a chunk for actions in [-1, 1]. They are finer near 0, where a chunk
    of up to 0.4 rad has to meet a goal within 0.02 rad.
    """
    action = np.clip(action, -1.0, 1.0)
    return action * (SLOWEST + (1.0 - SLOWEST) * np.abs(action))


def split(observation, config):
    """Return joint positions, speeds, goals, and setpoints (envs, joints) each. Without chunks the
    positions stand for the setpoints.
    """
    if config.chunk is None:
        qpos, qvel, goal = np.split(observation, 3, axis=1)
        return qpos, qvel, goal, qpos
    return np.split(observation, 4, axis=1)


def features(observation, config):
    """Return the inputs of the agent: velocity, error, its size, and the error on a fine scale; with
    chunks it is the error of the setpoint, and the way of the robot to the setpoint is an input.
    """
    qpos, qvel, goal, setpoint = split(observation, config)
    error = goal - setpoint
    rows = [qvel, error, np.abs(error), np.tanh(error / FINE)]
    if config.chunk is not None:
        rows.append(setpoint - qpos)
    return np.concatenate(rows, axis=1)


def shaping(envs, config):
    """Return the reward for progress between two observations: the change of a potential, minus
    the mean over joints of |goal - setpoint| / range.
    """
    _, _, span, _ = split(envs.observation_space.high - envs.observation_space.low, config)

    def potential(observation):
        _, _, goal, setpoint = split(observation, config)
        return -(np.abs(goal - setpoint) / span).mean(1)

    return lambda before, after: config.shaping * (potential(after) - potential(before))


def evaluate(envs, act, config):
    """Return success and error (envs,) at the end of one episode in each env, and the mean reward
    of its steps, without exploration.
    """
    raw, _ = envs.reset(seed=config.seed + 1_000_000)  # other goals than in the training
    rewards = []
    for _ in range(envs.unwrapped.max_episode_steps):
        raw, reward, *_, info = envs.step(act(raw))
        rewards.append(reward)
    return info["success"], info["error"], np.mean(rewards)


def draw(curve, config):
    """Return a figure of success and error over the env steps."""
    figure, (steps, _, success, error) = Figure(figsize=(6.5, 4.2), layout="constrained"), curve.T
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.plot(steps, 100 * success, color="#15803d")
    figure.suptitle(f"PPO on batchpid/Reach-v0: {config.robot}, seed {config.seed}", fontsize=11)
    top.set(ylabel="episodes that end\nat the goal [%]", ylim=(-3, 103))
    bottom.semilogy(steps, error, color="#c2570c")
    bottom.set(ylabel="last error of the\nworst joint [rad]", xlabel="env steps")
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def main(config: Config):
    """Train, evaluate, and draw the learning curve."""
    if config.chunk is not None:
        config = replace(config, discount=config.discount**config.chunk)
    envs, inputs = make_envs(config), partial(features, config=config)
    if config.policy is None:
        act, curve = ppo.train(envs, config, SCORES, inputs, shaping(envs, config))
    else:
        act, curve = ppo.Policy.load(config.policy, inputs), None
    success, error, reward = evaluate(envs, act, config)
    envs.close()
    print(
        f"without exploration {success.mean():.1%} of {len(success)} episodes end at the goal,"
        f" the worst joint within {np.median(error):.4f} rad (median); mean reward {reward:.3f}"
    )
    if config.out is not None:
        act.save(config.out)
    if config.picture is not None and curve is not None:
        print("picture:", plots.save(draw(curve, config), config.picture))


if __name__ == "__main__":
    main(tyro.cli(Config))
