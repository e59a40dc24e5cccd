"""Stages of the control in a Runner: those of the caller, compiled ones, and changes in flight. That
each feature is the same on every path is in test_conformance.py.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from thermal import Thermal

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Runner
from batchpid.stages import Stage


class Recording:
    """Controller in Python that keeps the velocities and the setpoints that it is given."""

    def __init__(self):
        self.seen = []

    def init(self, robot, num_envs, timestep):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        self.seen.append(qvel)
        return state, np.asarray(passive) + 2.0 * (setpoint - qpos)


def test_a_controller_that_cannot_be_traced_is_an_error(panda, needs_jax):
    runner = Runner(panda, 2, control=Recording(), backend="jax", workers=0)
    with runner, pytest.raises(InvalidArgumentError, match=r"control.*traced"):
        runner.step(np.zeros(panda.dof))


class Integrator:
    """Controller whose init makes its state by JAX."""

    def init(self, robot, num_envs, timestep):
        import jax

        return {"sum": jax.numpy.zeros((num_envs, robot.dof))}

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return {"sum": state["sum"] + (setpoint - qpos)}, passive


@pytest.mark.parametrize("wide", [False, True])
def test_the_state_of_a_controller_has_the_precision_of_the_runner(panda, needs_jax, wide):
    import jax

    jax.config.update("jax_enable_x64", wide)
    try:
        with Runner(panda, 2, backend="jax", control=Integrator(), workers=0) as runner:
            assert runner.snapshot().rows["control/law/sum"].dtype == np.float64
    finally:
        jax.config.update("jax_enable_x64", False)


def test_jax_without_the_cpu_is_refused(panda, needs_jax, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    with pytest.raises(InvalidArgumentError, match="JAX_PLATFORMS is 'cuda'; add cpu"):
        Runner(panda, 2, backend="jax", workers=0)


def test_a_thermal_limit_keeps_motors_at_the_heat_that_they_hold_for_ever(panda):
    with Runner(panda, 2, workers=0, stages=[Thermal(4.0, 0.05)]) as runner:
        rollout = runner.rollout(np.broadcast_to(panda.target, (24, 2, panda.dof)))
        heat = runner.snapshot().rows["control/thermal"]
    assert np.abs(rollout.effort).max() > 4.0
    assert rollout.saturated.any()
    assert 0.99 < heat.max() < 1.01


@dataclass(frozen=True)
class Fan(Stage):
    """A stage with an operation that programs do not have."""

    name = "fan"
    after = "motors"

    def step(self, state, values):
        xp = values.outputs.qf.__array_namespace__()
        return state, values.told(qf=values.outputs.qf + 1e-3 * xp.arctan(values.measured.qvel))


def test_a_stage_that_programs_cannot_have_runs_in_numpy_and_the_runner_says_so(panda):
    with Runner(panda, 2, workers=0, stages=[Fan()]) as runner:
        assert "stage 'fan': programs have no operation 'arctan'" in runner.backend
        assert runner.step(panda.start).ok.all()
    with Runner(panda, 2, workers=0, stages=[Thermal(8.0, 0.05)]) as runner:
        assert "stage" not in runner.backend


@dataclass(frozen=True)
class Wave(Stage):
    """A stage with the functions of the C library."""

    name = "wave"
    after = "motors"

    def init(self, values):
        return values.model.load() * 0.0, values

    def step(self, state, values):
        qvel = values.measured.qvel
        xp = qvel.__array_namespace__()
        return state, values.told(
            qf=values.outputs.qf - xp.tanh(qvel) * xp.exp(-qvel * qvel) - 0.1 * xp.sin(qvel)
        )


def test_exp_tanh_and_sin_run_natively_as_in_numpy(panda, monkeypatch):
    rows = []
    for native in "10":
        monkeypatch.setenv("BATCHPID_NATIVE", native)
        with Runner(panda, 2, workers=0, stages=[Wave()]) as runner:
            assert "stage" not in runner.backend
            rows.append(runner.rollout(np.broadcast_to(panda.target, (10, 2, panda.dof))))
    np.testing.assert_allclose(rows[0].qpos, rows[1].qpos, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows[0].effort, rows[1].effort, rtol=1e-6, atol=1e-6)


HOPPER = """<mujoco><worldbody><body pos="0 0 1"><joint name="rootz" type="slide" axis="0 0 1"/>
<geom size=".1" mass="3"/><body pos="0 0 -.2"><joint name="hip" axis="0 1 0" range="-60 60"/>
<geom type="capsule" fromto="0 0 0 0 0 -.4" size=".04" mass="2"/></body></body></worldbody>
<actuator><motor joint="hip" ctrlrange="-40 40"/></actuator></mujoco>"""


def test_a_joint_that_no_actuator_moves_falls_and_does_not_hang_on_the_compensation(tmp_path):
    path = tmp_path / "hopper.xml"
    path.write_text(HOPPER)
    robot = Robot.load(path)
    (said,) = [one for one in robot.check() if one.joint == "rootz" and "no actuator" in one.text]
    assert "a motor in the file" in said.remedy
    params = robot.params(kp=[0.0, 50.0], ki=None, kd=[0.0, 5.0], effort_limit=None)
    with Runner(robot, 1, engine="mujoco", workers=0, params=params) as runner:
        for _ in range(20):
            seen = runner.step(robot.start)
    assert seen.qpos[0, 0] == pytest.approx(-9.81 * 0.2**2 / 2, abs=2e-3)
