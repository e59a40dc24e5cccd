"""Law, motors and closed loop as programs of JAX, on the default device, for 2^12 to 2^20 envs.

In float32, per robot and sim step; compilation is not timed, nor is the way of the arrays to the
device. The smallest size runs by default; ``BATCHPID_JAX_ENVS=20`` goes up to 2^20.
"""

from __future__ import annotations

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import batchpid as bp
from batchpid.sim import Robot, closed_loop

DT, STEPS = 1 / 2000, 20
SIZES = [2**power for power in range(12, int(os.environ.get("BATCHPID_JAX_ENVS", "12")) + 1, 4)]
MOTORS = {"command_delay": 2e-3, "lag": 1e-3, "strength": 0.9}


def law_and_motors(robot, num_envs):
    """Return a program of STEPS sim steps of the law and its motors, and its first state."""
    params = robot.designed("effort").replace(dtype=np.float32)
    motors = bp.make_actuators(robot.dof, **MOTORS, dtype=np.float32)
    qpos = jnp.tile(jnp.asarray(robot.start, jnp.float32), (num_envs, 1))

    def step(state, _):
        law, motor, qpos = state
        qvel = jnp.zeros_like(qpos)
        law, effort = bp.step(params, law, qpos + 0.1, qpos, DT, measurement_rate=qvel)
        motor, effort = bp.motors.advance_effort(k, motor, effort, qvel)
        return (law, motor, qpos + 1e-6 * effort), None

    state = bp.init(params, qpos), bp.motors.init(motors, qpos, DT), qpos
    k = bp.motors.discretise(motors, state[1], DT)
    return lambda state: jax.lax.scan(step, state, length=STEPS)[0], state


def loop(robot, num_envs):
    """Return a program of a tick of STEPS sim steps of the whole loop, and its first state."""
    closed = closed_loop(robot, num_envs)
    target = jnp.asarray(robot.target, jnp.float32)
    state = closed.init(jnp.asarray(robot.start, jnp.float32))
    return lambda state: closed.step(state, target, substeps=STEPS)[0], state


@pytest.mark.benchmark(group="programs of JAX")
@pytest.mark.parametrize("num_envs", SIZES)
@pytest.mark.parametrize("make", [law_and_motors, loop])
def test_program(benchmark, most, make, num_envs):
    robot = Robot.load("panda")
    envs = int(min(num_envs, most.rows))
    function, state = make(robot, envs)
    program = jax.jit(function).lower(state).compile()
    rounds = int(min(9, most.rounds))
    after = benchmark.pedantic(
        lambda: jax.block_until_ready(program(state)), rounds=rounds, warmup_rounds=1
    )
    seconds = benchmark.stats.stats.min
    benchmark.extra_info["us per env step"] = round(1e6 * seconds / envs / STEPS, 3)
    moved = jax.tree.leaves(jax.tree.map(lambda new, old: (new != old).any(), after, state))
    assert any(moved)
