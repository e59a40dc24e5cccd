"""The law in XLA: close to NumPy's, bit-identical for any grouping, and with the same faults, states and snapshots."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from identical import assert_identical
from robots import RUBBING, load_bundled

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Runner, Snapshot
from batchpid.sim.engine import native

jax = pytest.importorskip("jax")
jnp = jax.numpy
N = 5
needs_extension = pytest.mark.skipif(bool(native.obstacle()), reason="there are no native calls")


def commands(robot, ticks, envs=N, spread=0.3):
    rng = np.random.default_rng(3)
    low, high = np.maximum(robot.lower, robot.start - spread), np.minimum(robot.upper, robot.start + spread)
    return rng.uniform(low, high, (envs, ticks, robot.dof)).swapaxes(0, 1)  # those of an env do not depend on others


def rollout(robot, backend="jax", ticks=20, envs=N, **options):
    with Runner(robot, envs, backend=backend, **({"workers": 0, "substeps": 10} | options)) as runner:
        if backend == "jax" and not native.obstacle():
            assert runner.backend == f"law in XLA ({runner.options.dtype}), in one program with native sim steps"
        return runner.rollout(commands(robot, ticks, envs))


CASES = {
    "efforts": ("panda", {"params": "panda"}),
    "tuned": ("panda", {}),
    "rubbing": (RUBBING, {}),
    "MuJoCo": ("panda", {"engine": "mujoco"}),
}


@pytest.mark.quick_rows(2)
@pytest.mark.parametrize("case", CASES)
def test_motion_is_that_of_the_law_in_numpy(case):
    name, options = CASES[case]
    robot = load_bundled(name)
    if "engine" in options:
        pytest.importorskip("mujoco.batch")
    options = options | ({"params": robot.params()} if "params" in options else {})
    ours, theirs = (rollout(robot, backend, **options) for backend in ("jax", "numpy"))
    np.testing.assert_allclose(ours.qpos, theirs.qpos, rtol=0, atol=1e-5)
    np.testing.assert_allclose(ours.effort, theirs.effort, rtol=0, atol=0.05)
    np.testing.assert_array_equal(ours.saturated, theirs.saturated)
    assert np.ptp(theirs.qpos, axis=0).max() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_two_seconds_of_motion(name, physics, dtype):
    robot = load_bundled(name)
    options = {"ticks": 200, "substeps": 20, "physics": physics}
    ours, theirs = rollout(robot, dtype=dtype, **options), rollout(robot, "numpy", **options)
    atol = 1e-5 if dtype == "float64" else 1e-3
    np.testing.assert_allclose(ours.qpos[-1], theirs.qpos[-1], rtol=0, atol=atol)


@pytest.mark.quick_rows(1)
@needs_extension
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("options", [{}, {"speed_limit": 60.0, "on_fault": "reset"}, {"compensate": "none"}], ids=str)
@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_contacts_and_faults_are_those_of_the_loop_in_numpy(panda, engine, options):
    """Sums of efforts are exact, so that the results are: in contact, and with faults."""
    pytest.importorskip("mujoco.batch" if engine == "mujoco" else "sapien")
    rng = np.random.default_rng(3)
    efforts = rng.normal(size=(20, N, panda.dof)) * np.minimum(panda.effort_limit, 50)
    options = {"engine": engine, **options}
    results = []
    for backend in ("jax", "numpy"):
        with Runner(panda, N, control="effort", backend=backend, workers=0, substeps=10, **options) as runner:
            rows = runner.rollout(efforts)
            results.append((rows, list(runner.faults)))
    assert_identical(results[0][0], results[1][0])
    assert results[0][1] == results[1][1]
    assert bool(results[0][1]) == ("speed_limit" in options)


@pytest.mark.slow
def test_any_groups_are_bit_identical(panda):
    expected = rollout(panda, envs=20, ticks=6)
    assert_identical(rollout(panda, envs=2, ticks=6, workers=1), expected.for_envs(slice(0, 2)))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::batchpid.sim.RecoveryWarning")
@pytest.mark.parametrize("control", ["pid", "mlp"])
@pytest.mark.parametrize("name", ["panda", RUBBING])
def test_any_workers_are_bit_identical_and_a_lost_one_is_replaced(name, control):
    robot = load_bundled(name)
    options = {"control": MLP(robot)} if control == "mlp" else {}
    with Runner(robot, 20, backend="jax", workers=3, substeps=10, **options) as runner:
        first = runner.rollout(commands(robot, 50, 20))
        os.kill(runner.pids[0], signal.SIGKILL)
        second = runner.rollout(commands(robot, 50, 20))
        assert runner.recoveries == 1
    for options["workers"] in (0, 2):
        with Runner(robot, 20, backend="jax", substeps=10, **options) as runner:
            assert_identical(runner.rollout(commands(robot, 50, 20)), first)
            assert_identical(runner.rollout(commands(robot, 50, 20)), second)


def test_params_that_change_in_flight(panda):
    results = []
    for backend in ("jax", "numpy"):
        with Runner(panda, N, backend=backend, workers=0, substeps=10) as runner:
            runner.rollout(commands(panda, 5))
            runner.params = panda.params()
            results.append(runner.rollout(commands(panda, 10)[5:]))
    np.testing.assert_allclose(results[0].qpos, results[1].qpos, rtol=0, atol=1e-5)


class Counter:
    """Efforts from a state of several parts: the number of steps, and a filtered velocity."""

    fails_at = -1

    def init(self, robot, num_envs):
        return {"steps": np.zeros(num_envs, int), "filter": (np.zeros((num_envs, robot.dof)), None)}

    def __call__(self, state, setpoint, qpos, qvel, passive):
        steps, filtered = state["steps"] + 1, 0.9 * state["filter"][0] + 0.1 * qvel
        wave = jnp.sin(0.01 * steps)[:, None]
        effort = passive + 5 * wave * setpoint - 0.5 * filtered
        fails = (steps == self.fails_at)[:, None] & (setpoint > 1)
        return {"steps": steps, "filter": (filtered, None)}, jnp.where(fails, jnp.nan, effort)


class MLP:
    """Efforts of a neural network of three layers, added to the passive force."""

    def __init__(self, robot, width=64):
        sizes, rng = (2 * robot.dof, width, width, robot.dof), np.random.default_rng(0)
        self.weights = [(rng.normal(size=(n, m)) / np.sqrt(n), np.zeros(m)) for n, m in itertools.pairwise(sizes)]

    def init(self, robot, num_envs):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        x = jnp.concatenate([setpoint - qpos, qvel], -1)
        for w, b in self.weights[:-1]:
            x = jnp.tanh(x @ w + b)
        w, b = self.weights[-1]
        return state, passive + x @ w + b


class Failing(Counter):
    fails_at = 15


@pytest.fixture(scope="module")
def counter(panda):
    with Runner(panda, N, control=Counter(), backend="jax", workers=0, substeps=10) as runner:
        yield runner


def test_a_controller_runs_in_the_program(counter, panda):
    counter.reset()
    ours = counter.rollout(commands(panda, 10))
    theirs = rollout(panda, "numpy", 10, control=Counter())
    np.testing.assert_allclose(ours.qpos, theirs.qpos, rtol=0, atol=1e-5)


def test_resets_by_mask_and_snapshots_keep_its_state(counter, panda, tmp_path):
    counter.reset()
    counter.step(np.ones(panda.dof))
    counter.reset(mask=np.arange(N) < 2)
    snapshot = counter.snapshot()
    np.testing.assert_array_equal(snapshot.states.controller["steps"], [0, 0, 10, 10, 10])
    snapshot.save(tmp_path / "state.npz")
    expected = counter.rollout(np.ones((3, panda.dof)))
    counter.reset()
    counter.restore(Snapshot.load(tmp_path / "state.npz"))
    assert_identical(counter.rollout(np.ones((3, panda.dof))), expected, skip={"time"})
    other = Runner(panda, N, control=Counter(), workers=0)
    with other, pytest.raises(InvalidArgumentError, match="backend 'jax', not 'numpy'"):
        other.restore(snapshot)


@pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
@pytest.mark.parametrize("on_fault", ["hold", "reset"])
def test_an_env_whose_effort_is_nan_fails_alone(counter, panda, on_fault):
    setpoint = np.ones((N, panda.dof))
    counter.reset()
    sound = counter.step(setpoint, substeps=20)
    setpoint[3] = 1.5
    with Runner(panda, N, control=Failing(), backend="jax", workers=0, substeps=20, on_fault=on_fault) as runner:
        obs = runner.step(setpoint)
        assert [(fault.env, fault.step, fault.cause) for fault in runner.faults] == [(3, 15, "effort")]
        assert np.isfinite(runner.step(setpoint).qpos).all()
    np.testing.assert_array_equal(obs.ok, np.arange(N) != 3)
    assert_identical(obs, sound, np.arange(N) != 3)


class NumPyOnly(Counter):
    def __call__(self, state, setpoint, qpos, qvel, passive):
        return state, np.asarray(passive)


class WrongEffort(Counter):
    def __call__(self, state, *_):
        return state, jnp.zeros(4)


class WrongState(Counter):
    def __call__(self, state, setpoint, qpos, qvel, passive):
        return {"steps": state["steps"]}, passive


@pytest.mark.parametrize(
    ("controller", "problem"),
    [
        (NumPyOnly(), "control: cannot be traced by JAX.*use backend='numpy'"),
        (WrongEffort(), r"control: returned an effort of shape \(4,\), not \(16, 9\)"),
        (WrongState(), "control: returned a state without 'filter/0'"),
    ],
    ids=lambda one: type(one).__name__,
)
def test_a_controller_that_cannot_be_traced_is_an_error(panda, controller, problem):
    runner = Runner(panda, N, control=controller, backend="jax", workers=0)
    with runner, pytest.raises(InvalidArgumentError, match=problem):
        runner.step(np.zeros(panda.dof))


@pytest.mark.slow
@pytest.mark.parametrize("control", ["pid", Counter()], ids=["pid", "controller"])
def test_without_native_calls_the_law_is_called_each_sim_step(monkeypatch, panda, control):
    monkeypatch.setenv(native.SWITCH, "0")
    with Runner(panda, 2, control=control, backend="jax", workers=0, substeps=10) as runner:
        assert runner.backend == (
            "law in XLA (float64), a call each sim step (native code is switched off by BATCHPID_NATIVE=0), "
            "Python calls into SAPIEN"
        )
        ours = runner.rollout(commands(panda, 3, 2))
    theirs = rollout(panda, "numpy", 3, 2, control=control)
    np.testing.assert_allclose(ours.qpos, theirs.qpos, rtol=0, atol=1e-5)


def test_options(panda):
    with pytest.raises(InvalidArgumentError, match="dtype: is that of backend 'jax'"):
        Runner(panda, 2, dtype="float32", workers=0)
    with pytest.raises(InvalidArgumentError, match="backend"):
        Runner(panda, 2, backend="torch", workers=0)
    with Runner(panda, 2, control="drive", backend="jax", workers=0) as runner:
        assert runner.backend.startswith("law in SAPIEN")
        runner.step(panda.start)
    actuators = bp.make_actuators(panda.dof, strength=0.9)
    with Runner(panda, 2, backend="jax", workers=0, substeps=2, actuators=actuators) as runner:
        assert "a call each sim step (actuators" in runner.backend
        runner.step(panda.start)
        runner.actuators = None
        assert (not native.obstacle()) == ("in one program" in runner.backend)


def test_jax_is_not_imported_unless_it_is_asked_for():
    program = (
        "import sys; from sim import Robot, Runner; robot = Robot.load('panda')\n"
        "with Runner(robot, 1, workers=0) as runner: runner.step(robot.start)\n"
        "sys.exit('jax' in sys.modules)"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", program], check=True)


@pytest.mark.slow
@needs_extension
@pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
@pytest.mark.parametrize("seed", range(6))
def test_random_efforts_resets_snapshots_and_faults_are_those_of_the_loop_in_numpy(seed):
    rng = np.random.default_rng(seed)
    robot, envs = load_bundled(["panda", "jaco2"][seed % 2]), int(rng.integers(1, 20))
    options = {
        "control": "effort",
        "substeps": int(rng.integers(1, 12)),
        "on_fault": rng.choice(["hold", "reset"]),
        "speed_limit": rng.choice([20.0, 1000.0]),
        "on_invalid_input": "contain",
    }
    runners = [Runner(robot, envs, backend=backend, workers=0, **options) for backend in ("jax", "numpy")]
    snapshots = [runner.snapshot() for runner in runners]
    for _ in range(25):
        action, mask = rng.choice(["reset", "snapshot", "restore", *["step"] * 5]), rng.random(envs) < 0.4
        qpos = np.clip(robot.start + rng.uniform(-1, 1, (envs, robot.dof)), robot.lower, robot.upper)
        efforts = rng.normal(size=(envs, robot.dof)) * np.minimum(robot.effort_limit, 60)
        if rng.random() < 0.1:
            efforts[rng.integers(envs), rng.integers(robot.dof)] = np.nan
        seen = []
        for index, runner in enumerate(runners):
            if action == "reset":
                runner.reset(qpos, mask=mask)
            elif action == "snapshot":
                snapshots[index] = runner.snapshot()
            elif action == "restore":
                runner.restore(snapshots[index])
            else:
                runner.step(efforts)
            seen.append(runner.observe())
        assert_identical(*seen)
    assert list(runners[0].faults) == list(runners[1].faults)
    for runner in runners:
        runner.close()


def test_the_law_of_a_guarded_runner_is_in_xla(panda, monkeypatch):
    monkeypatch.setattr("batchpid.sim.loop.native_ticks.NativeTicks.run", None)  # the native law
    with Runner(panda, 2, backend="jax", guard=True, workers=0, substeps=2) as runner:
        assert runner.step(panda.start).ok.all()
