"""Sim steps of a tick in one native call: the same motion as in NumPy, independent of the other envs of a group."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

import batchpid as bp
from batchpid.sim import Runner
from batchpid.sim.engine import native
from batchpid.sim.engine.batch_dynamics import NativeMassMatrix
from batchpid.sim.engine.sapien.physics import PHYSICS
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.loop import native_executor
from batchpid.sim.loop.control_step import control_step
from batchpid.sim.loop.native_executor import NativeExecutor

pytestmark = pytest.mark.skipif(not native.status().active, reason="native calls are not available")
N = 3
CASES = {
    "tuned": {},
    "inertia": {"gain_units": "inertia", "kp": 400.0, "ki": 100.0, "kd": 40.0},
    "implicit": {"gain_units": "mass_matrix", "discretization": "implicit", "kp": 4e4, "ki": 1e6, "kd": 400.0},
    "without units": {"gain_units": "effort", "kp": 300.0, "ki": 50.0, "kd": 30.0},
}


def params_of(robot, case):
    return robot.params(**CASES[case]) if CASES[case] else None


def rollout(robot, ticks=40, rates=False, forward=False, **options):
    rng = np.random.default_rng(0)
    middle = np.clip(robot.settings.target, robot.lower + 0.05, robot.upper - 0.05)
    path = np.clip(middle + np.cumsum(0.01 * rng.normal(size=(ticks, N, robot.dof)), 0), robot.lower, robot.upper)
    more = {"setpoint_rates": np.gradient(path, 0.01, axis=0)} if rates else {}
    more |= {"feedforwards": 0.1 * rng.normal(size=path.shape)} if forward else {}
    with Runner(robot, N, workers=0, **options) as runner:
        return runner.rollout(path, **more)


@pytest.mark.parametrize("more", [{}, {"rates": True, "forward": True}, {"guard": True}], ids=str)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_the_motion_is_that_of_numpy(name, case, more, monkeypatch):
    robot = load_bundled(name)
    options = {"params": params_of(robot, case), **more}
    ours = rollout(robot, **options)
    monkeypatch.setenv(native.SWITCH, "0")
    theirs = rollout(robot, **options)
    assert np.ptp(theirs.qpos, axis=0).max() > 0.05
    np.testing.assert_allclose(ours.qpos, theirs.qpos, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(ours.saturated, theirs.saturated)
    np.testing.assert_array_equal(ours.guarded, theirs.guarded)


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_the_mass_matrix_is_that_of_the_model(name):
    robot = load_bundled(name)
    poses = robot.sample(50, seed=0)
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, PHYSICS["fast"])
    np.testing.assert_allclose(NativeMassMatrix(spec)(poses), robot.dynamics().mass_matrix(poses), rtol=1e-6, atol=1e-9)


def test_an_env_that_is_reset_changes_no_other(panda):
    """A reset puts friction and mass matrix of one env out of step with the others', which then stop for it."""
    table = np.tile(panda.settings.target, (3, N, 1)) - 0.01
    found = []
    for mask in (np.zeros(N, bool), np.arange(N) == 1):
        with Runner(panda, N, workers=0, substeps=21) as runner:
            runner.rollout(table)
            if mask.any():
                runner.reset(mask=mask)
            found.append(runner.rollout(table))
    assert_identical(*found, np.arange(N) != 1)
    assert not np.array_equal(found[0].qpos[:, 1], found[1].qpos[:, 1])


def test_the_program_is_a_trace_of_the_control_step(panda, monkeypatch):
    calls = []

    def recorded(layout, *arguments):
        calls.append(layout.control)
        return control_step(layout, *arguments)

    assert native_executor.control_step is control_step
    monkeypatch.setattr(native_executor, "control_step", recorded)
    native_executor._trace.cache_clear()
    with Runner(panda, 2, workers=0, substeps=30) as runner:
        runner.step(panda.settings.target)
    native_executor._trace.cache_clear()
    assert calls == ["pid"], "traced once; friction is not due within 64 sim steps"


def test_python_calls_of_a_sim_step(panda):
    """At most two for each group of envs and sim step; 64 pandas are four groups."""
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event == "call" and "/workers/" not in frame.f_code.co_filename

    with Runner(panda, 64, workers=0, substeps=20) as runner:
        target = np.tile(panda.settings.target, (64, 1))
        for _ in range(4):
            runner.step(target)
        sys.setprofile(count)
        try:
            runner.step(target)
        finally:
            sys.setprofile(None)
    assert calls <= 2 * 4 * 20 + 60, "60 for the runner itself"


def test_what_cannot_be_a_program_takes_one_native_call_a_sim_step(panda):
    actuators = bp.make_actuators(panda.dof, command_delay=0.002, strength=0.95)
    executors = []

    class Seen(NativeExecutor):
        def run(self, *arguments):
            executors.append(self._compiles)
            return super().run(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("batchpid.sim.loop.env_group.NativeExecutor", Seen)
        for options in ({}, {"actuators": actuators}):
            with Runner(panda, 2, workers=0, **options) as runner:
                runner.step(panda.settings.target)
    assert executors == [True, False]
