"""Debugging settings of JAX change no motion of a Runner, in the calling process and in workers."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from identical import assert_identical
from jax_debugging import SETTINGS, changed
from robots import RUBBING, load_bundled

import batchpid as bp
from batchpid.sim import Runner

jax = pytest.importorskip("jax")
jnp = jax.numpy
pytestmark = pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")


class Integrator:
    """Efforts from a state that init makes by JAX; NaN where the setpoint is beyond 0.5."""

    def init(self, robot, num_envs, timestep):
        return {"sum": jnp.zeros((num_envs, robot.dof)), "calls": jnp.zeros(num_envs, jnp.int32)}

    def __call__(self, state, setpoint, qpos, qvel, passive):
        total = state["sum"] + (setpoint - qpos)
        effort = jnp.where(setpoint > 0.5, jnp.nan, 5.0 * (setpoint - qpos) + 0.1 * total + passive)
        return {"sum": total, "calls": state["calls"] + 1}, effort


OPTIONS = {
    "pid": {},
    "mass matrix": {"params": {"gain_units": "mass_matrix", "kd": 20.0, "effort_limit": 80.0}},
    "controller": {"control": Integrator()},
}


def motion(case, workers=0):
    """Return a rollout with a reset and a restored snapshot; the env 1 of a controller fails."""
    robot, options = load_bundled(RUBBING), dict(OPTIONS[case])
    if "params" in options:
        options["params"] = bp.make_params(robot.dof, 100.0, **options["params"])
    setpoint = np.tile(robot.start, (4, 3, 1))
    setpoint[2:, 1, 0] = 0.7
    with Runner(robot, 3, backend="jax", workers=workers, substeps=3, **options) as runner:
        runner.step(setpoint[0])
        snapshot = runner.snapshot()
        runner.step(setpoint[1])
        runner.restore(snapshot)
        runner.reset(mask=np.array([True, False, False]))
        rollout = runner.rollout(setpoint)
        assert ("control" in options) == bool(runner.faults)
        return rollout


@cache
def expected(case):
    """Return the motion under the default settings."""
    return motion(case)


@pytest.mark.quick_rows(1)
@pytest.mark.parametrize("case", OPTIONS)
def test_all_of_them_at_once(case):
    wanted = expected(case)
    with changed(**SETTINGS):
        assert_identical(motion(case), wanted)


def test_the_state_of_a_controller_has_the_precision_of_the_runner():
    for wide in (False, True):
        with (
            changed(jax_enable_x64=wide),
            Runner(
                load_bundled(RUBBING), 2, backend="jax", control=Integrator(), workers=0
            ) as runner,
        ):
            assert runner.snapshot().rows["control/law/sum"].dtype == np.float64
