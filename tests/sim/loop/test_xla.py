"""The law in XLA. That each feature is close to NumPy and bit-identical in workers is in
test_conformance.py.
"""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from featured import robot_with
from identical import assert_identical
from robots import load_bundled

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Randomization, Runner, Uniform

pytest.importorskip("jax")
N = 5


def commands(robot, ticks, envs=N, spread=0.3):
    rng = np.random.default_rng(3)
    low, high = (
        np.maximum(robot.lower, robot.start - spread),
        np.minimum(robot.upper, robot.start + spread),
    )
    return rng.uniform(low, high, (envs, ticks, robot.dof)).swapaxes(
        0, 1
    )  # those of an env do not depend on others


def rollout(robot, backend="jax", ticks=20, envs=N, **options):
    with Runner(
        robot, envs, backend=backend, **({"workers": 0, "substeps": 10} | options)
    ) as runner:
        return runner.rollout(commands(robot, ticks, envs))


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_two_seconds_of_motion(name, physics):
    robot = load_bundled(name)
    options = {"ticks": 200, "substeps": 20, "physics": physics}
    ours, theirs = rollout(robot, **options), rollout(robot, "numpy", **options)
    np.testing.assert_allclose(ours.qpos[-1], theirs.qpos[-1], rtol=0, atol=1e-5)


class NumPyOnly:
    """Controller that JAX cannot trace."""

    def init(self, robot, num_envs):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return state, np.asarray(passive)


def test_a_controller_that_cannot_be_traced_is_an_error(panda):
    runner = Runner(panda, N, control=NumPyOnly(), backend="jax", workers=0)
    with runner, pytest.raises(InvalidArgumentError, match=r"control.*traced"):
        runner.step(np.zeros(panda.dof))


COUPLED = robot_with("mimic")
LACKING = {
    "actuators": {"actuators": bp.make_actuators(9, strength=0.9)},
    "control": {"control": "drive"},
    "guard": {"guard": True},
    "randomization": {"randomization": Randomization(payload=Uniform(0, 1))},
    "robot": {"robot": COUPLED},
}


@pytest.mark.parametrize("name", LACKING)
def test_options_that_the_program_lacks_are_refused_by_name(panda, name):
    with pytest.raises(
        InvalidArgumentError, match=rf"^{name}: .*backend 'jax'.*use backend='numpy'"
    ):
        Runner(**{"robot": panda, "num_envs": 2, "backend": "jax", "workers": 0} | LACKING[name])


def test_actuators_in_flight_and_a_missing_extension_are_refused(panda, monkeypatch):
    with Runner(panda, 2, backend="jax", workers=0) as runner:
        assert runner.backend == "law in XLA, in one program with native sim steps"
        with pytest.raises(InvalidArgumentError, match=r"actuators: .*backend 'jax'"):
            runner.actuators = bp.make_actuators(panda.dof, strength=0.9)
    monkeypatch.setenv("BATCHPID_NATIVE", "0")
    with pytest.raises(InvalidArgumentError, match=r"backend: .*BATCHPID_NATIVE=0"):
        Runner(panda, 2, backend="jax", workers=0)


def test_jax_is_not_imported_unless_it_is_asked_for():
    program = (
        "import sys; from batchpid.sim import Robot, Runner; robot = Robot.load('panda')\n"
        "with Runner(robot, 1, workers=0) as runner: runner.step(robot.start)\n"
        "sys.exit('jax' in sys.modules)"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", program], check=True)


@pytest.mark.slow
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
    runners = [
        Runner(robot, envs, backend=backend, workers=0, **options) for backend in ("jax", "numpy")
    ]
    snapshots = [runner.snapshot() for runner in runners]
    for _ in range(25):
        action, mask = (
            rng.choice(["reset", "snapshot", "restore", *["step"] * 5]),
            rng.random(envs) < 0.4,
        )
        qpos = np.clip(
            robot.start + rng.uniform(-1, 1, (envs, robot.dof)), robot.lower, robot.upper
        )
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
