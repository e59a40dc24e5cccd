"""Proximal policy optimization in JAX, for ``train_reach.py`` and ``train_walk.py``.

The algorithm is that of J. Schulman et al., arXiv:1707.06347, with the usual details: generalized
advantage estimation, normalized observations, orthogonal weights, a clipped gradient, and a
learning rate that falls to 0. The robots step in worker processes, policy and updates run in this
one.
"""

from collections import deque, namedtuple
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax


@dataclass(frozen=True)
class Config:
    """Settings of the algorithm."""

    seed: int = 0  # Of starts, goals, initial weights and exploration.
    num_envs: int = 64  # Robots in parallel.
    workers: int | None = None  # Worker processes; default one per core.
    steps: int = 32  # Steps of every robot before an update.
    updates: int = 300  # Updates of the agent.
    epochs: int = 6  # Passes over the data of an update.
    minibatches: int = 16  # Minibatches of a pass.
    learning_rate: float = 1e-3  # At the start; it falls linearly to 0.
    discount: float = 0.9  # Of the reward, per step.
    gae_lambda: float = 0.95  # Weight of longer returns in the advantage.
    log_std: float = -0.5  # Logarithm of the standard deviation of actions, at the start.
    clip: float = 0.2  # Change of a probability ratio beyond which the gradient is zero.


class Normalizer(NamedTuple):
    """Running mean and variance of observations."""

    mean: Any
    variance: Any
    count: int

    def updated(self, rows):
        """Return the statistics with more ``rows`` (T. F. Chan, G. H. Golub and R. J. LeVeque,
        1983).
        """
        count, shift = self.count + len(rows), rows.mean(0) - self.mean
        squares = (
            self.variance * self.count
            + rows.var(0) * len(rows)
            + shift**2 * self.count * len(rows) / count
        )
        return Normalizer(self.mean + shift * len(rows) / count, squares / count, count)

    def __call__(self, rows):
        """Return ``rows`` with zero mean and unit variance, clipped to 10."""
        return np.clip((rows - self.mean) / np.sqrt(self.variance + 1e-8), -10, 10).astype(
            np.float32
        )


# Transitions (steps, envs, ...). ``valid`` is False where an env begins an episode: the action has
# no effect there.
Batch = namedtuple("Batch", "observation action log_prob value reward terminated done valid")


def init_mlp(key, sizes, scale):
    """Return the layers (weights, biases) of a perceptron; ``scale`` applies to the weights of the
    last layer.
    """
    scales = [2**0.5] * (len(sizes) - 2) + [scale]
    layers = zip(jax.random.split(key, len(scales)), pairwise(sizes), scales, strict=True)
    return [
        (jax.nn.initializers.orthogonal(scale)(key, shape), jnp.zeros(shape[1]))
        for key, shape, scale in layers
    ]


def mlp(layers, x):
    """Return the output of a perceptron with tanh units."""
    for weights, biases in layers[:-1]:
        x = jnp.tanh(x @ weights + biases)
    weights, biases = layers[-1]
    return x @ weights + biases


def init_agent(key, observations, actions, log_std):
    """Return the parameters of a normal policy and of its value function."""
    actor, critic = jax.random.split(key)
    return {
        "actor": init_mlp(actor, (observations, 64, 64, actions), 0.01),
        "log_std": jnp.full(actions, log_std),
        "critic": init_mlp(critic, (observations, 64, 64, 1), 1.0),
    }


class Policy(NamedTuple):
    """Policy without exploration; ``features`` maps observations to inputs of the network."""

    layers: Any
    normalizer: Normalizer
    features: Callable[[Any], Any]

    def __call__(self, observation):
        """Return the actions (envs, actions)."""
        return np.asarray(mlp(self.layers, self.normalizer(self.features(observation))))

    def save(self, path):
        """Write the policy to a file, .npz."""
        weights = {
            f"layer{k}_{j}": x for k, pair in enumerate(self.layers) for j, x in enumerate(pair)
        }
        np.savez(path, **weights, **self.normalizer._asdict())

    @classmethod
    def load(cls, path, features=lambda observation: observation):
        """Return the policy in a file that :meth:`save` wrote."""
        with np.load(path) as file:
            count = sum(name.startswith("layer") for name in file) // 2
            layers = [(file[f"layer{k}_0"], file[f"layer{k}_1"]) for k in range(count)]
            return cls(layers, Normalizer(*(file[name] for name in Normalizer._fields)), features)


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
    """Return PPO's loss: the clipped objective of the policy, and half the squared error of the
    value.
    """
    weight = batch.valid / batch.valid.sum()
    centered = advantage - (weight * advantage).sum()
    scaled = centered / (jnp.sqrt((weight * centered**2).sum()) + 1e-8)
    ratio = jnp.exp(log_prob(agent, batch.observation, batch.action) - batch.log_prob)
    objective = jnp.minimum(
        ratio * scaled, jnp.clip(ratio, 1 - config.clip, 1 + config.clip) * scaled
    )
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
        gradient = jax.grad(loss)(
            agent, *jax.tree.map(lambda table: table[rows], (batch, advantage)), config
        )
        change, state = optimizer.update(gradient, state)
        return (optax.apply_updates(agent, change), state), None

    orders = [
        jax.random.permutation(key, len(advantage)) for key in jax.random.split(key, config.epochs)
    ]
    rows = jnp.concatenate(
        [order[: config.minibatches * count].reshape(-1, count) for order in orders]
    )
    return jax.lax.scan(minibatch, (agent, optimizer_state), rows)[0]


def train(envs, config, scores, features=lambda observation: observation, shaping=None):
    """Return the :class:`Policy`, and the learning curve: rows of env steps, seconds and
    means of scores.

    ``scores`` names entries of the info, whose values at the ends of episodes are shown.
    ``features`` maps observations to inputs of the agent; ``shaping(before, after)`` maps two
    observations to an addition to the reward (envs,).
    """
    key, init_key = jax.random.split(jax.random.key(config.seed))
    raw, _ = envs.reset(seed=config.seed)
    normalizer = Normalizer(features(raw).mean(0), features(raw).var(0), len(raw))
    agent = init_agent(
        init_key, len(normalizer.mean), envs.single_action_space.shape[0], config.log_std
    )
    rate = optax.linear_schedule(
        config.learning_rate, 0.0, config.updates * config.epochs * config.minibatches
    )
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(rate, eps=1e-5))
    optimizer_state, curve, episodes = optimizer.init(agent), [], deque(maxlen=config.num_envs)
    valid, begun = np.ones(config.num_envs, bool), perf_counter()
    for number in range(1, config.updates + 1):
        transitions = []
        for _ in range(config.steps):
            before, normalizer = raw, normalizer.updated(features(raw))
            observation, (key, action_key) = normalizer(features(raw)), jax.random.split(key)
            action, probability, value = map(np.asarray, act(agent, observation, action_key))
            raw, reward, terminated, truncated, info = envs.step(action)
            if shaping is not None:
                reward += shaping(before, raw)
            reward, done = np.float32((1 - config.discount) * reward), terminated | truncated
            transitions.append(
                Batch(observation, action, probability, value, reward, terminated, done, valid)
            )
            episodes.extend(zip(*(info[name][done] for name in scores), strict=True))
            valid = ~done
        batch = Batch(*map(np.stack, zip(*transitions, strict=True)))
        last_value = mlp(agent["critic"], normalizer(features(raw)))[:, 0]
        key, update_key = jax.random.split(key)
        agent, optimizer_state = update(
            agent, optimizer_state, batch, last_value, update_key, optimizer, config
        )
        means = np.mean(episodes, axis=0) if episodes else np.full(len(scores), np.nan)
        curve.append((number * config.steps * config.num_envs, perf_counter() - begun, *means))
        if number % 10 == 0:
            told = "   ".join(
                f"{name} {mean:.3f}" for name, mean in zip(scores, means, strict=True)
            )
            print(f"{curve[-1][0]:9,} steps {curve[-1][1]:6.1f} s   {told}", flush=True)
    return Policy(agent["actor"], normalizer, features), np.array(curve)
