"""Gains by gradient: Adam of optax descends through the closed loop as a pure function.

    python examples/gradient_gains.py

The robot's commands arrive late, which designed gains do not know. The loss is the mean error on the
way to several poses, plus the growth of the velocity, which makes a motion that rings expensive.
``tune`` searches without gradients, for moves of its own; its gains are judged by the same loss.
"""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

import batchpid as bp
from batchpid.sim import Robot, closed_loop
from batchpid.sim.tuning import tune


def main(
    robot_name: str = "panda",
    delay: float = 0.004,
    moves: int = 8,
    seconds: float = 0.4,
    steps: int = 30,
    generations: int = 4,
) -> dict[str, float]:
    """Print and return the losses of designed, tuned and descended gains."""
    robot = Robot.load(robot_name)
    motors = bp.make_actuators(robot.dof, command_delay=delay, lag=0.002)
    designed = robot.designed("effort")
    loop = closed_loop(robot, moves, params=designed, actuators=motors)
    shares = np.random.default_rng(0).uniform(-0.2, 0.2, (moves, robot.dof))
    goals = jnp.asarray(robot.start + shares * (robot.target - robot.start))
    start = jnp.asarray(robot.start)

    def loss(params: bp.PIDParams) -> jax.Array:
        tried = loop.changed(params=params)

        def tick(state, _):
            state, seen = tried.step(state, goals, substeps=10)
            error = jnp.abs(seen.qpos - goals) + 0.02 * jnp.abs(seen.qvel)
            return state, error.mean()

        return jax.lax.scan(tick, tried.init(start), length=round(200 * seconds))[1].mean()

    def scaled(scales: jax.Array) -> bp.PIDParams:
        """Return the designed gains times a factor for each kind of gain and joint."""
        kp, ki, kd = jnp.exp(scales)[:, None]
        return designed._replace(kp=kp * designed.kp, ki=ki * designed.ki, kd=kd * designed.kd)

    slope = jax.jit(jax.value_and_grad(lambda scales: loss(scaled(scales))))
    optimiser = optax.adam(0.05)
    scales = jnp.zeros((3, robot.dof))
    memory = optimiser.init(scales)
    best = (np.inf, scales)
    for _ in range(steps):
        value, gradient = slope(scales)
        best = min(best, (float(value), scales), key=lambda entry: entry[0])
        change, memory = optimiser.update(gradient, memory)
        scales = optax.apply_updates(scales, change)

    found = tune(
        robot, gain_units="effort", generations=generations, actuators=motors, seconds=seconds
    )
    judged = jax.jit(loss)
    losses = {
        "designed": float(judged(designed)),
        "tune": float(judged(found.params)),
        "gradient": best[0],
    }
    for name, value in losses.items():
        print(f"{name:10} {1e3 * value:6.2f} mrad")
    return losses


if __name__ == "__main__":
    tyro.cli(main)
