"""PPO in JAX on the task in ``walk.py``: one policy walks forward at a commanded speed with the
bundled quadruped.

    python examples/train_walk.py --picture train_walk.png

The algorithm is in ``ppo.py``. The policy sets the joints' setpoints 50 times a second; a PID of
each joint follows them at 500 Hz, in MuJoCo. docs/training.md explains the choices.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import ppo
import tyro
from matplotlib.figure import Figure
from walk import WalkVectorEnv

from batchpid.sim import Observation, Rollout, plots, write_recording

SCORES = ("speed", "distance")  # of the learning curve
MARGIN = 0.2  # share of the commanded speed by which a robot that walks may be off


@dataclass(frozen=True)
class Config(ppo.Config):
    """Train a policy, evaluate it, and draw the learning curve."""

    num_envs: int = 128  # Robots in parallel.
    steps: int = 24  # Steps of every robot before an update.
    updates: int = 70  # Updates of the agent.
    epochs: int = 5  # Passes over the data of an update.
    discount: float = 0.97  # Of the reward, per step.
    log_std: float = -2.0  # Logarithm of the standard deviation of actions, at the start.
    episode: int = 250  # Steps of an episode in training, 50 a second.
    speed: float = 0.5  # Commanded forward velocity [m/s].
    evaluated: int = 32  # Robots of the evaluation.
    time: float = 10.0  # Length of the evaluation [s].
    timestep: float = 1 / 500  # Time step of law and physics [s].
    picture: Path | None = None  # Learning curve to draw: .png or .svg.
    record: Path | None = None  # Recording of the evaluation: .h5.
    out: Path | None = None  # Policy to write: .npz.


def make_envs(config, num_envs, episode):
    """Return robots that are to walk forward."""
    task = {"commands": [[config.speed, 0.0, 0.0]] * 2, "max_episode_steps": episode}
    options = {
        "workers": config.workers,
        "engine": "mujoco",
        "physics": "fast",
        "timestep": config.timestep,
    }
    return WalkVectorEnv(num_envs, **task, **options)


def evaluate(act, config):
    """Return mean forward speed and mean speed along x [m/s], and whether it fell (envs,), without
    exploration.
    """
    envs = make_envs(config, config.evaluated, None)
    raw, _ = envs.reset(seed=config.seed + 1_000_000)  # other starts than in the training
    steps, runner = round(config.time / envs.unwrapped.step_seconds), envs.unwrapped.runner
    forward, fell = np.zeros(config.evaluated), np.zeros(config.evaluated, bool)
    start, setpoints, observed = runner.info, [], []
    for _ in range(steps):
        raw, _, terminated, _, info = envs.step(act(raw))
        forward, fell = forward + info["speed"] / steps, fell | terminated
        setpoints.append(envs.setpoint)
        observed.append(envs.observed.map(lambda rows: rows[None]))
    if config.record is not None:
        time = envs.step_seconds * np.arange(1.0, steps + 1)
        seen = Observation.join(observed)
        run = Rollout(time, np.array(setpoints), seen, envs.step_seconds, start)
        write_recording(run, config.record, overwrite=True)
    envs.close()
    return forward, info["distance"] / config.time, fell


def draw(curve, config):
    """Return a figure of the speed over the env steps."""
    figure, (steps, _, speed, distance) = Figure(figsize=(6.5, 3.2), layout="constrained"), curve.T
    axes = figure.subplots()
    axes.set_title(f"PPO on a quadruped that walks, seed {config.seed}", fontsize=11)
    axes.axhline(config.speed, color="black", lw=0.8, ls="--", label="command")
    axes.plot(steps, speed, color="#15803d", label="forward, at the end of episodes")
    axes.plot(
        steps, distance / (config.episode / 50), color="#c2570c", label="along x, mean of episodes"
    )
    axes.set(xlabel="env steps", ylabel="speed [m/s]")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def main(config: Config):
    """Train, evaluate, and draw the learning curve."""
    envs = make_envs(config, config.num_envs, config.episode)
    act, curve = ppo.train(envs, config, SCORES)
    if config.out is not None:
        act.save(config.out)
    envs.close()
    forward, along, fell = evaluate(act, config)
    walks = ~fell & (np.abs(forward - config.speed) <= MARGIN * config.speed)
    told = f"{walks.mean():.1%} of {len(walks)} robots walk for {config.time:g} s"
    print(f"without exploration {told}, {fell.mean():.1%} fall")
    for name, speed in (("forward", forward), ("along x", along)):
        print(
            f"speed {name}: {speed.mean():.3f} m/s on average, {speed.min():.3f} to"
            f" {speed.max():.3f}"
        )
    if config.picture is not None:
        print("picture:", plots.save(draw(curve, config), config.picture))


if __name__ == "__main__":
    main(tyro.cli(Config))
