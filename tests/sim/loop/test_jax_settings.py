"""Debugging settings of JAX change no motion of a Runner, in the calling process and in workers."""

from __future__ import annotations

import numpy as np
import pytest
from identical import assert_identical
from jax_debugging import SETTINGS, changed
from robots import RUBBING, load_bundled

from batchpid.sim import Runner

jax = pytest.importorskip("jax")
jnp = jax.numpy
pytestmark = [
    pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning"),
    pytest.mark.usefixtures("needs_jax"),
]


class Integrator:
    """Efforts from a state that init makes by JAX; NaN where the setpoint is beyond 0.5."""

    def init(self, robot, num_envs, timestep):
        return {"sum": jnp.zeros((num_envs, robot.dof)), "calls": jnp.zeros(num_envs, jnp.int32)}

    def __call__(self, state, setpoint, qpos, qvel, passive):
        total = state["sum"] + (setpoint - qpos)
        effort = jnp.where(setpoint > 0.5, jnp.nan, 5.0 * (setpoint - qpos) + 0.1 * total + passive)
        return {"sum": total, "calls": state["calls"] + 1}, effort


def motion():
    """Return a rollout with a reset and a restored snapshot; env 1 fails."""
    robot = load_bundled(RUBBING)
    setpoint = np.tile(robot.start, (4, 3, 1))
    setpoint[2:, 1, 0] = 0.7
    options = {"backend": "jax", "workers": 0, "substeps": 3, "control": Integrator()}
    with Runner(robot, 3, **options) as runner:
        runner.step(setpoint[0])
        snapshot = runner.snapshot()
        runner.step(setpoint[1])
        runner.restore(snapshot)
        runner.reset(mask=np.array([True, False, False]))
        rollout = runner.rollout(setpoint)
        assert runner.faults
        return rollout


def test_all_of_them_at_once():
    expected = motion()
    with changed(**SETTINGS):
        assert_identical(motion(), expected)


def test_the_state_of_a_controller_has_the_precision_of_the_runner():
    for wide in (False, True):
        with (
            changed(jax_enable_x64=wide),
            Runner(
                load_bundled(RUBBING), 2, backend="jax", control=Integrator(), workers=0
            ) as runner,
        ):
            assert runner.snapshot().rows["control/law/sum"].dtype == np.float64
