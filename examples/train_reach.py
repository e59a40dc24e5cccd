"""PPO in JAX on batchpid/Reach-v0: one policy moves a robot to random joint poses by changes of its setpoints.

    python examples/train_reach.py --picture train_reach.png

Proximal policy optimization (J. Schulman et al., arXiv:1707.06347) with the usual details: generalized advantage
estimation, normalized observations, orthogonal weights, a clipped gradient, and a learning rate that falls to 0. The
robots step in worker processes, policy and updates run in this one. docs/training.md explains the choices.
"""

import warnings
from collections import deque, namedtuple
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from matplotlib.figure import Figure

from batchpid.sim import MissedContactWarning, Robot, plots

FINE = 0.2  # scale on which the agent sees small errors [rad or m]


@dataclass(frozen=True)
class Config:
    """Train a policy, evaluate it, and draw the learning curve."""

    robot: str = "panda"  # Bundled robot, or path of a URDF.
    seed: int = 0  # Of starts, goals, initial weights and exploration.
    num_envs: int = 64  # Robots in parallel.
    workers: int | None = None  # Worker processes; default one per core.
    episode: int = 150  # Steps of an episode, 50 a second.
    steps: int = 32  # Steps of every robot before an update.
    updates: int = 300  # Updates of the agent.
    epochs: int = 6  # Passes over the data of an update.
    minibatches: int = 16  # Minibatches of a pass.
    learning_rate: float = 1e-3  # At the start; it falls linearly to 0.
    discount: float = 0.9  # Of the reward, per step.
    gae_lambda: float = 0.95  # Weight of longer returns in the advantage.
    clip: float = 0.2  # Change of a probability ratio beyond which the gradient is zero.
    shaping: float = 10.0  # Weight of the potential that shapes the reward.
    picture: Path | None = None  # Learning curve to draw: .png or .svg.


class Normalizer(NamedTuple):
    """Running mean and variance of observations."""

    mean: Any
    variance: Any
    count: int

    def updated(self, rows):
        """Return the statistics with more ``rows`` (T. F. Chan, G. H. Golub and R. J. LeVeque, 1983)."""
        count, shift = self.count + len(rows), rows.mean(0) - self.mean
        squares = self.variance * self.count + rows.var(0) * len(rows) + shift**2 * self.count * len(rows) / count
        return Normalizer(self.mean + shift * len(rows) / count, squares / count, count)

    def __call__(self, rows):
        """Return ``rows`` with zero mean and unit variance, clipped to 10."""
        return np.clip((rows - self.mean) / np.sqrt(self.variance + 1e-8), -10, 10).astype(np.float32)


# Transitions (steps, envs, ...). ``valid`` is False where an env begins an episode: the action has no effect there.
Batch = namedtuple("Batch", "observation action log_prob value reward terminated done valid")


def init_mlp(key, sizes, scale):
    """Return the layers (weights, biases) of a perceptron; ``scale`` applies to the weights of the last layer."""
    scales = [2**0.5] * (len(sizes) - 2) + [scale]
    layers = zip(jax.random.split(key, len(scales)), pairwise(sizes), scales, strict=True)
    return [(jax.nn.initializers.orthogonal(scale)(key, shape), jnp.zeros(shape[1])) for key, shape, scale in layers]


def mlp(layers, x):
    """Return the output of a perceptron with tanh units."""
    for weights, biases in layers[:-1]:
        x = jnp.tanh(x @ weights + biases)
    weights, biases = layers[-1]
    return x @ weights + biases


def init_agent(key, observations, actions):
    """Return the parameters of a normal policy and of its value function."""
    actor, critic = jax.random.split(key)
    return {
        "actor": init_mlp(actor, (observations, 64, 64, actions), 0.01),
        "log_std": jnp.full(actions, -0.5),
        "critic": init_mlp(critic, (observations, 64, 64, 1), 1.0),
    }


def log_prob(agent, observation, action):
    """Return the log density of ``action`` under the policy."""
    mean, std = mlp(agent["actor"], observation), jnp.exp(agent["log_std"])
    return jax.scipy.stats.norm.logpdf(action, mean, std).sum(-1)


@jax.jit
def act(agent, observation, key):
    """Return an action of the policy, its log density, and the value of the observation."""
    mean = mlp(agent["actor"], observation)
    action = mean + jnp.exp(agent["log_std"]) * jax.random.normal(key, mean.shape)
    return action, log_prob(agent, observation, action), mlp(agent["critic"], observation)[..., 0]


def advantages(batch, last_value, config):
    """Return the generalized advantage estimates (steps, envs): arXiv:1506.02438, equation 16."""
    next_value = jnp.concatenate([batch.value[1:], last_value[None]])
    delta = batch.reward + config.discount * next_value * ~batch.terminated - batch.value

    def backwards(advantage, step):
        delta, done = step
        advantage = delta + config.discount * config.gae_lambda * ~done * advantage
        return advantage, advantage

    return jax.lax.scan(backwards, jnp.zeros_like(last_value), (delta, batch.done), reverse=True)[1]


def loss(agent, batch, advantage, config):
    """Return PPO's loss: the clipped objective of the policy, and half the squared error of the value."""
    weight = batch.valid / batch.valid.sum()
    centered = advantage - (weight * advantage).sum()
    scaled = centered / (jnp.sqrt((weight * centered**2).sum()) + 1e-8)
    ratio = jnp.exp(log_prob(agent, batch.observation, batch.action) - batch.log_prob)
    objective = jnp.minimum(ratio * scaled, jnp.clip(ratio, 1 - config.clip, 1 + config.clip) * scaled)
    error = mlp(agent["critic"], batch.observation)[..., 0] - (batch.value + advantage)
    return (weight * (0.5 * error**2 - objective)).sum()


@partial(jax.jit, static_argnames=("optimizer", "config"))
def update(agent, optimizer_state, batch, last_value, key, optimizer, config):
    """Return agent and optimizer state after all epochs over ``batch``."""
    table = (batch, advantages(batch, last_value, config))
    batch, advantage = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), table)
    count = len(advantage) // config.minibatches

    def minibatch(carry, rows):
        agent, state = carry
        gradient = jax.grad(loss)(agent, *jax.tree.map(lambda table: table[rows], (batch, advantage)), config)
        change, state = optimizer.update(gradient, state)
        return (optax.apply_updates(agent, change), state), None

    orders = [jax.random.permutation(key, len(advantage)) for key in jax.random.split(key, config.epochs)]
    rows = jnp.concatenate([order[: config.minibatches * count].reshape(-1, count) for order in orders])
    return jax.lax.scan(minibatch, (agent, optimizer_state), rows)[0]


def make_envs(config):
    """Return a vector env with gains that follow the setpoint: critically damped at 30 rad/s in every pose."""
    robot = Robot.load(config.robot)
    params = robot.params(kp=900.0, kd=60.0, ki=0.0, gain_units="mass_matrix", measurement_rate="measured")
    options = {"params": params, "workers": config.workers, "collisions": False, "physics": "free"}
    warnings.simplefilter("ignore", MissedContactWarning)  # any pose within the limits may be a goal
    task = {"robot": robot, "actions": "increment", "max_episode_steps": config.episode}
    return gymnasium.make_vec("batchpid.sim.gym:batchpid/Reach-v0", config.num_envs, **task, **options)


def features(observation):
    """Return the inputs of the agent (envs, 4 joints): velocity, error, its size, and the error on a fine scale."""
    qpos, qvel, goal = np.split(observation, 3, axis=1)
    error = goal - qpos
    return np.concatenate([qvel, error, np.abs(error), np.tanh(error / FINE)], axis=1)


def potential(envs, observation):
    """Return minus the mean over joints of |goal - qpos| / range (envs,)."""
    qpos, _, goal = np.split(observation, 3, axis=1)
    _, _, span = np.split(envs.observation_space.high - envs.observation_space.low, 3, axis=1)
    return -(np.abs(goal - qpos) / span).mean(1)


def train(envs, config):
    """Return agent, normalizer, and the learning curve: rows of env steps, seconds, success and error."""
    key, init_key = jax.random.split(jax.random.key(config.seed))
    raw, _ = envs.reset(seed=config.seed)
    normalizer = Normalizer(features(raw).mean(0), features(raw).var(0), len(raw))
    agent = init_agent(init_key, len(normalizer.mean), envs.single_action_space.shape[0])
    rate = optax.linear_schedule(config.learning_rate, 0.0, config.updates * config.epochs * config.minibatches)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(rate, eps=1e-5))
    optimizer_state, curve, episodes = optimizer.init(agent), [], deque(maxlen=config.num_envs)
    valid, begun = np.ones(config.num_envs, bool), perf_counter()
    for number in range(1, config.updates + 1):
        transitions = []
        for _ in range(config.steps):
            before, normalizer = potential(envs, raw), normalizer.updated(features(raw))
            observation, (key, action_key) = normalizer(features(raw)), jax.random.split(key)
            action, probability, value = map(np.asarray, act(agent, observation, action_key))
            raw, reward, terminated, truncated, info = envs.step(action)
            # Shaping by a potential rewards every step towards the goal and keeps the best policy (A. Y. Ng, 1999).
            reward += config.shaping * (config.discount * potential(envs, raw) - before)
            reward, done = np.float32((1 - config.discount) * reward), terminated | truncated
            transitions.append(Batch(observation, action, probability, value, reward, terminated, done, valid))
            episodes.extend(zip(info["success"][done], info["error"][done], strict=True))
            valid = ~done
        batch = Batch(*map(np.stack, zip(*transitions, strict=True)))
        last_value = mlp(agent["critic"], normalizer(features(raw)))[:, 0]
        key, update_key = jax.random.split(key)
        agent, optimizer_state = update(agent, optimizer_state, batch, last_value, update_key, optimizer, config)
        success, error = np.mean(episodes, axis=0) if episodes else (0.0, np.nan)
        curve.append((number * config.steps * config.num_envs, perf_counter() - begun, success, error))
        if number % 10 == 0:
            print("{:9,} steps {:6.1f} s   success {:6.1%}   error of the worst joint {:.3f}".format(*curve[-1]))
    return agent, normalizer, np.array(curve)


def evaluate(envs, agent, normalizer, config):
    """Return success and error (envs,) at the end of one episode in each env, without exploration."""
    raw, _ = envs.reset(seed=config.seed + 1_000_000)  # other goals than in the training
    for _ in range(config.episode):
        raw, *_, info = envs.step(np.asarray(mlp(agent["actor"], normalizer(features(raw)))))
    return info["success"], info["error"]


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
    envs = make_envs(config)
    agent, normalizer, curve = train(envs, config)
    success, error = evaluate(envs, agent, normalizer, config)
    envs.close()
    print(f"without exploration {success.mean():.1%} of {len(success)} episodes end at the goal,", end=" ")
    print(f"the worst joint within {np.median(error):.4f} rad (median)")
    if config.picture is not None:
        print("picture:", plots.save(draw(curve, config), config.picture))


if __name__ == "__main__":
    main(tyro.cli(Config))
