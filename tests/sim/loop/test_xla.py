"""The law in XLA. That each feature is close to NumPy and bit-identical in workers is in
test_conformance.py.
"""

from __future__ import annotations

import numpy as np
import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Runner

jax = pytest.importorskip("jax")
pytestmark = pytest.mark.usefixtures("needs_programs")
N = 5


class NumPyOnly:
    """Controller that JAX cannot trace."""

    def init(self, robot, num_envs, timestep):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return state, np.asarray(passive)


def test_a_controller_that_cannot_be_traced_is_an_error(panda):
    runner = Runner(panda, N, control=NumPyOnly(), backend="jax", workers=0)
    with runner, pytest.raises(InvalidArgumentError, match=r"control.*traced"):
        runner.step(np.zeros(panda.dof))


class Integrator:
    """Controller whose init makes its state by JAX."""

    def init(self, robot, num_envs, timestep):
        return {"sum": jax.numpy.zeros((num_envs, robot.dof))}

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return {"sum": state["sum"] + (setpoint - qpos)}, passive


@pytest.mark.parametrize("wide", [False, True])
def test_the_state_of_a_controller_has_the_precision_of_the_runner(panda, wide):
    jax.config.update("jax_enable_x64", wide)
    try:
        with Runner(panda, 2, backend="jax", control=Integrator(), workers=0) as runner:
            assert runner.snapshot().rows["control/law/sum"].dtype == np.float64
    finally:
        jax.config.update("jax_enable_x64", False)


def test_actuators_in_flight_and_a_missing_extension_are_refused(panda, monkeypatch):
    with Runner(panda, 2, backend="jax", workers=0) as runner:
        assert runner.backend == "law in XLA, in one program with native sim steps"
        with pytest.raises(InvalidArgumentError, match=r"actuators: .*backend 'jax'"):
            runner.actuators = bp.make_actuators(panda.dof, strength=0.9)
    monkeypatch.setenv("BATCHPID_NATIVE", "0")
    with pytest.raises(InvalidArgumentError, match=r"backend: .*BATCHPID_NATIVE=0"):
        Runner(panda, 2, backend="jax", workers=0)
    monkeypatch.delenv("BATCHPID_NATIVE")
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    with pytest.raises(InvalidArgumentError, match="JAX_PLATFORMS is 'cuda': add cpu"):
        Runner(panda, 2, backend="jax", workers=0)
