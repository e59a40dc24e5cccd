"""The promise: the same bytes for any number of workers, any packing, any number of envs, and every rerun."""

import functools

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

from sim import FaultWarning, Runner

TICKS = 100  # of 20 sim steps: 1 s


def start_poses(robot, num_envs):
    """Env k starts from a pose of its own that depends on k alone."""
    poses = []
    for env in range(num_envs):
        spread = 0.3 * np.random.default_rng(env).uniform(-1, 1, robot.dof)
        poses.append(np.clip(robot.start + spread, robot.lower, robot.upper))
    return np.array(poses)


def run(name, num_envs, ticks=TICKS, **options):
    with Runner(load_bundled(name), num_envs, **options) as runner:
        runner.reset(start_poses(runner.robot, num_envs))
        for _ in range(ticks):
            obs = runner.step(runner.robot.settings.target)
    assert np.abs(obs.qpos - start_poses(load_bundled(name), num_envs)).max() > 0.1
    return obs


@functools.cache
def reference(name="panda", control="pid", ticks=TICKS):
    """20 envs in this process, without workers: the oracle."""
    return run(name, 20, ticks, workers=0, control=control)


@pytest.mark.parametrize("workers", [0, 1, 2, 3])
def test_workers(workers):
    assert_identical(run("panda", 20, workers=workers), reference())


@pytest.mark.parametrize("pack_size", [1, 8, 16])
def test_packing(pack_size):
    assert_identical(run("panda", 20, workers=0, pack_size=pack_size), reference())


def test_one_env_and_64():
    many = run("panda", 64, workers=2)
    assert_identical(run("panda", 1, workers=0), many, slice(0, 1))
    assert_identical(many, reference(), slice(0, 20))


@pytest.mark.parametrize("control", ["drive", "effort"])
def test_other_controls(control):
    expected = reference(control=control, ticks=20)
    assert_identical(run("panda", 20, 20, workers=2, pack_size=8, control=control), expected)


def test_jaco2():
    expected = reference("jaco2", ticks=20)
    assert_identical(run("jaco2", 20, 20, workers=2, pack_size=3), expected)


def test_rollout_equals_steps():
    target = load_bundled("panda").settings.target
    with Runner(load_bundled("panda"), 20, workers=2) as runner:
        runner.reset(start_poses(runner.robot, 20))
        rollout = runner.rollout(np.broadcast_to(target, (TICKS, 9)))
    for name in reference()._fields:
        assert getattr(rollout, name)[-1].tobytes() == getattr(reference(), name).tobytes(), name
    assert rollout.time[-1] == pytest.approx(TICKS * 20 / 2000)


@pytest.mark.parametrize("workers", [0, 2])
def test_ticks_sent_at_once_are_the_same_as_one_by_one(workers):
    """With checkpoints amid them, an env that fails, rates and feedforwards."""
    model, ticks, envs = load_bundled("panda"), 57, 8
    noise = np.random.default_rng(1).uniform(-0.05, 0.05, (3, ticks, envs, model.dof))
    setpoints = np.clip(model.settings.target + noise[0], model.lower, model.upper)
    setpoints[20, 3, 2] = np.nan
    options = {"workers": workers, "substeps": 3, "checkpoint_steps": 100, "on_invalid_input": "contain"}
    options |= {"on_fault": "reset"}
    with Runner(model, envs, **options) as runner, Runner(model, envs, **options) as other:
        assert len(runner._pool.ticks) > ticks
        with pytest.warns(FaultWarning):
            rollout = runner.rollout(setpoints, setpoint_rates=noise[1], feedforwards=noise[2])
        with pytest.warns(FaultWarning):
            steps = [
                other.step(setpoint, setpoint_rate=rate, feedforward=extra)
                for setpoint, rate, extra in zip(setpoints, noise[1], noise[2], strict=True)
            ]
        assert runner.time == other.time
        assert list(runner.faults) == list(other.faults)
        assert len(runner.faults) == 1
        for name, now in runner.observe()._asdict().items():
            assert now.tobytes() == getattr(steps[-1], name).tobytes()
    for name in steps[0]._fields:
        assert getattr(rollout, name).tobytes() == np.stack([getattr(step, name) for step in steps]).tobytes()


def test_masked_reset_leaves_the_others_alone():
    target = load_bundled("panda").settings.target
    mask = np.arange(20) % 3 == 0
    with Runner(load_bundled("panda"), 20, workers=2) as runner:
        runner.reset(start_poses(runner.robot, 20))
        for tick in range(TICKS):
            if tick == 30:
                runner.reset(start_poses(runner.robot, 20), mask=mask)
            obs = runner.step(target)
        assert_identical(obs, reference(), ~mask)
        # A reset env is as good as new: 70 ticks after it, it stands where it stood 70 ticks after the first.
        runner.reset(start_poses(runner.robot, 20))
        for _ in range(70):
            early = runner.step(target)
    assert early.qpos[mask].tobytes() == obs.qpos[mask].tobytes()
