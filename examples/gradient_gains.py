"""Gains by gradient: Adam of optax descends through the closed loop as a pure function.

    python examples/gradient_gains.py

The loss is the mean distance to the goals of some moves, of motors whose commands arrive late. Every
joint has a factor of its own for each gain. ``tune`` searches without gradients, for moves of its
own, which also end in rest; its gains are judged by the same loss.
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
    moves: int = 4,
    seconds: float = 1.0,
    steps: int = 15,
    generations: int = 4,
) -> dict[str, float]:
    """Print and return the losses [rad] of designed, tuned and descended gains."""
    robot = Robot.load(robot_name)
    motors = bp.make_actuators(robot.dof, command_delay=0.001, lag=0.001)
    designed = robot.designed()
    loop = closed_loop(robot, moves, params=designed, actuators=motors)
    shares = np.random.default_rng(0).uniform(-0.2, 0.2, (moves, robot.dof))
    goals = jnp.asarray(robot.start + shares * (robot.target - robot.start))

    def loss(params: bp.PIDParams) -> jax.Array:
        tried = loop.changed(params=params)

        def tick(state, _):
            state, seen = tried.step(state, goals, substeps=10)
            return state, jnp.abs(seen.qpos - goals).mean()

        state = tried.init(jnp.asarray(robot.start))
        return jax.lax.scan(tick, state, length=round(200 * seconds))[1].mean()

    def scaled(scales: jax.Array) -> bp.PIDParams:
        kp, ki, kd = jnp.exp(scales)[:, None]
        return designed._replace(kp=kp * designed.kp, ki=ki * designed.ki, kd=kd * designed.kd)

    slope = jax.jit(jax.value_and_grad(lambda scales: loss(scaled(scales))))
    optimiser = optax.adam(0.1)
    scales = jnp.zeros((3, robot.dof))
    memory = optimiser.init(scales)
    descended = []
    for _ in range(steps):
        value, gradient = slope(scales)
        descended.append(float(value))
        change, memory = optimiser.update(gradient, memory)
        scales = optax.apply_updates(scales, change)
    found = tune(robot, generations=generations, actuators=motors, seconds=seconds)
    losses = {
        "designed": descended[0],
        "tune": float(jax.jit(loss)(found.params)),
        "gradient": min(descended),
    }
    for name, value in losses.items():
        print(f"{name:10} {1e3 * value:6.1f} mrad")
    return losses


if __name__ == "__main__":
    tyro.cli(main)
