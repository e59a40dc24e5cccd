"""Results in contact, at many places at once, are bit-identical for any workers, company and past, in each engine."""

from __future__ import annotations

import functools
import os
import signal
import warnings
from dataclasses import replace

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

from batchpid.sim import Randomization, RecoveryWarning, Robot, Runner, Uniform
from batchpid.sim.tuning import usual_variation

# In MuJoCo, which does not limit the speed of joints, light fingers fail under these efforts.
pytestmark = pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
N, TICKS = 16, 10
OPEN_LOOP = {"kp": 0.0, "ki": 0.0, "kd": 0.0}


def random_efforts(robot, ticks=TICKS, num_envs=N):
    """Efforts under which fingers hit each other and the hand, at several places at once."""
    return np.random.default_rng(0).normal(size=(ticks, num_envs, robot.dof)) * robot.effort_limit


def thrash(name="jaco2", *, num_envs=N, before=lambda runner: None, **options):
    """Return a rollout under random efforts, with a call before it."""
    robot = load_bundled(name)
    options = {"params": robot.params(**OPEN_LOOP), "control": "effort", "workers": 0} | options
    with Runner(robot, num_envs, **options) as runner:
        before(runner)
        return runner.rollout(random_efforts(robot, num_envs=num_envs))


@functools.cache
def reference(name="jaco2", physics="accurate", engine="sapien"):
    """Return the rollout in this process."""
    return thrash(name, physics=physics, engine=engine)


@pytest.mark.quick_rows(1)
@pytest.mark.parametrize(
    ("name", "physics"),
    [
        ("jaco2", "accurate"),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in (("jaco2", "fast"), ("panda", "accurate"))),
        pytest.param("panda", "fast", marks=pytest.mark.slow),
    ],
)
def test_workers_are_bit_identical(name, physics):
    assert_identical(thrash(name, physics=physics, workers=2), reference(name, physics))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["sapien", "mujoco"], indirect=True)
@pytest.mark.usefixtures("engine")
def test_robots_on_a_floating_base_are_bit_identical_for_any_workers():
    robot = Robot.load("panda", fixed_base=False)
    options = {"control": "effort", "params": robot.params(**OPEN_LOOP)}
    runs = []
    for workers in (0, 2):
        with Runner(robot, N, workers=workers, **options) as runner:
            runs.append(runner.rollout(random_efforts(robot, 6)))
    assert_identical(*runs)


@pytest.mark.quick_rows(1)
def test_an_env_alone_is_bit_identical_to_the_same_env_among_others(jaco2, engine):
    with Runner(jaco2, 1, workers=0, control="effort", params=jaco2.params(**OPEN_LOOP)) as runner:
        alone = runner.rollout(random_efforts(jaco2)[:, :1])
    np.testing.assert_array_equal(alone.qpos, reference(engine=engine).qpos[:, :1])
    assert np.abs(alone.qpos - jaco2.start).max() > 0.5


@pytest.mark.quick_rows(1)
def test_neighbours_of_an_env_that_fails_are_bit_identical(jaco2, engine):
    effort = random_efforts(jaco2)
    effort[7, 5, 3] = np.nan
    options = {"control": "effort", "params": jaco2.params(**OPEN_LOOP), "workers": 0}
    with Runner(jaco2, N, on_invalid_input="contain", **options) as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rollout = runner.rollout(effort)
    assert not rollout.ok[7:, 5].any()
    assert_identical(rollout, reference(engine=engine), np.arange(N) != 5)


def closed_hand(robot):
    """Return a pose in which the fingers touch each other."""
    pose = robot.start.copy()
    pose[7:] = robot.upper[7:]
    return pose


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("physics", ["accurate", pytest.param("fast", marks=pytest.mark.slow)])
@pytest.mark.parametrize("closed", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_an_episode_does_not_depend_on_the_episodes_before_it(closed, physics, jaco2):
    """A reset discards the order of earlier contacts, too."""
    start, ticks = (closed_hand(jaco2), 6) if closed else (jaco2.start, TICKS)
    options = {"control": "effort", "params": jaco2.params(**OPEN_LOOP), "workers": 0, "physics": physics}
    with Runner(jaco2, N, **options) as runner:
        episodes = []
        for _ in range(2):
            runner.reset(start)
            episodes.append(runner.rollout(random_efforts(jaco2, ticks)))
    assert_identical(*episodes, skip=["time"])


@pytest.mark.slow
@pytest.mark.parametrize("control", ["drive", "effort"])
def test_a_robot_that_is_placed_again_keeps_drives_payload_and_friction(jaco2, control):
    """Gains and limits of the engine's drives, armature, masses: an episode after a reset is as in a new runner."""
    randomization, actuators = usual_variation(jaco2)
    options = {"randomization": replace(randomization, seed=2), "actuators": actuators}
    if control == "drive":
        options = {"randomization": Randomization(seed=2, payload=Uniform(0, 1), armature=Uniform(0, 0.1))}
    commands = (
        random_efforts(jaco2, num_envs=6) if control == "effort" else np.tile(closed_hand(jaco2) - 0.3, (TICKS, 6, 1))
    )
    with Runner(jaco2, 6, workers=0, control=control, **options) as runner:
        runner.rollout(commands)
        snapshot = runner.snapshot()
        runner.rollout(commands)
        runner.reset(jaco2.start)
        again = runner.rollout(commands)
        runner.restore(snapshot)
        runner.reset(jaco2.start)
        assert_identical(runner.rollout(commands), again, skip=["time"])
    assert np.ptp(again.qpos, axis=1).max() > 1e-4  # the robots differ


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_a_snapshot_in_contact_is_a_barrier(jaco2, workers):
    ticks = 5
    effort = random_efforts(jaco2, 2 * ticks)
    options = {"control": "effort", "params": jaco2.params(**OPEN_LOOP)}
    with Runner(jaco2, N, workers=0, **options) as runner:
        runner.rollout(effort[:ticks])
        snapshot = runner.snapshot()
        expected = runner.rollout(effort[ticks:])
    with Runner(jaco2, N, workers=workers, **options) as runner:
        runner.restore(snapshot)
        assert_identical(runner.rollout(effort[ticks:]), expected)


@pytest.mark.slow
def test_a_worker_killed_in_contact_is_replaced_bit_identically():
    def wait(runner):
        runner.rollout(np.zeros((1, N, runner.robot.dof)))

    def kill(runner):
        wait(runner)
        os.kill(runner.pids[1], signal.SIGKILL)

    expected = thrash(checkpoint_steps=150, before=wait)
    with pytest.warns(RecoveryWarning):
        found = thrash(workers=2, checkpoint_steps=150, before=kill)
    assert_identical(found, expected)
