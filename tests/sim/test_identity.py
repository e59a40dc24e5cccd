"""Results are bit-identical for any number of workers and of envs, in every rerun, in each engine."""

import functools

import numpy as np
import pytest
from identical import assert_identical
from robots import RUBBING, load_bundled

from batchpid.sim import FaultWarning, Runner
from batchpid.sim.options import default_params

TICKS = 10  # of 20 sim steps: 0.1 s


def start_poses(robot, num_envs):
    """Start poses that depend on the env alone."""
    poses = []
    for env in range(num_envs):
        spread = 0.3 * np.random.default_rng(env).uniform(-1, 1, robot.dof)
        poses.append(np.clip(robot.start + spread, robot.lower, robot.upper))
    return np.array(poses)


def run(name="panda", num_envs=20, ticks=TICKS, control="pid", **options):
    """Run to the tutorial's target; return the last observation."""
    robot = load_bundled(name)
    params = robot.params() if control == "pid" else default_params(robot, control)
    with Runner(robot, num_envs, params=params, control=control, **options) as runner:
        runner.reset(start_poses(robot, num_envs))
        for _ in range(ticks):
            obs = runner.step(robot.settings.target)
    assert np.abs(obs.qpos - start_poses(robot, num_envs)).max() > 0.1
    return obs


@functools.cache
def in_this_process(engine, name="panda", control="pid", ticks=TICKS):
    return run(name, ticks=ticks, control=control, workers=0, engine=engine)


@pytest.fixture
def reference(engine):
    """Function that runs 20 envs in this process."""
    return functools.partial(in_this_process, engine)


@pytest.mark.quick_rows(2)
@pytest.mark.parametrize("workers", [0, 3])
def test_any_number_of_workers(workers, reference):
    assert_identical(run(workers=workers), reference())


@pytest.mark.quick_rows(1)
def test_any_number_of_envs(reference):
    many = run(num_envs=24, workers=0)
    assert_identical(run(num_envs=1, workers=0), many, slice(0, 1))
    assert_identical(many, reference(), slice(0, 20))


@pytest.mark.quick_rows(1)
@pytest.mark.parametrize("control", ["drive", "effort"])
def test_other_controls(control):
    expected = in_this_process("sapien", control=control)
    assert_identical(run(workers=2, control=control), expected)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning")
def test_another_robot():
    assert_identical(run("jaco2", workers=2), in_this_process("sapien", "jaco2"))


@pytest.mark.quick_rows(2)
@pytest.mark.parametrize("control", ["pid", "drive"])
def test_a_robot_with_friction_and_damping(control, reference):
    expected = reference(RUBBING, control=control)
    assert_identical(run(RUBBING, workers=1, control=control), expected)
    alone = run(RUBBING, num_envs=1, workers=0, control=control)
    assert_identical(alone, expected, slice(0, 1))


@pytest.mark.quick_rows(1)
@pytest.mark.usefixtures("engine")
def test_an_episode_with_friction_does_not_depend_on_when_it_begins():
    robot = load_bundled(RUBBING)
    setpoints = np.broadcast_to(robot.settings.target, (160, robot.dof))
    episodes = []
    with Runner(robot, 3, params=robot.params(), workers=0, substeps=5, compensate="gravity+coriolis") as runner:
        for ticks in (7, 3, 11):
            episodes.append(runner.rollout(setpoints))
            runner.rollout(setpoints[:ticks])
            runner.reset(mask=[True, True, False])
            runner.rollout(setpoints[:ticks])
            runner.reset()
    for episode in episodes[1:]:
        assert_identical(episode, episodes[0], skip=["time"])


def test_a_rollout_and_its_ticks_one_by_one(panda):
    reference = functools.partial(in_this_process, "sapien")
    with Runner(panda, 20, params=panda.params(), workers=1) as runner:
        runner.reset(start_poses(panda, 20))
        rollout = runner.rollout(np.broadcast_to(panda.settings.target, (TICKS, panda.dof)))
    assert_identical(rollout.observation.for_envs(-1), reference())
    assert rollout.time[-1] == pytest.approx(TICKS * 20 / 2000)


@pytest.mark.quick_rows(2)
@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("workers", [0, 2])
def test_a_rollout_with_checkpoints_faults_rates_and_feedforwards(panda, workers):
    ticks, envs = 57, 8  # all ticks of the rollout fit into one request, but for the checkpoints
    noise = np.random.default_rng(1).uniform(-0.05, 0.05, (3, ticks, envs, panda.dof))
    setpoints = np.clip(panda.settings.target + noise[0], panda.lower, panda.upper)
    setpoints[20, 3, 2] = np.nan
    options = {"params": panda.params(), "workers": workers, "substeps": 3, "checkpoint_steps": 100}
    options |= {"on_invalid_input": "contain", "on_fault": "reset"}
    with Runner(panda, envs, **options) as runner, Runner(panda, envs, **{**options, "workers": 0}) as other:
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
        assert_identical(runner.observe(), steps[-1])
    assert_identical(rollout.observation, type(steps[0]).join([each.map(lambda rows: rows[None]) for each in steps]))


def test_a_masked_reset_does_not_affect_the_other_envs(panda, reference):
    mask = np.arange(20) % 3 == 0
    with Runner(panda, 20, params=panda.params(), workers=0) as runner:
        runner.reset(start_poses(panda, 20))
        for tick in range(TICKS):
            if tick == 6:
                runner.reset(start_poses(panda, 20), mask=mask)
            obs = runner.step(panda.settings.target)
        assert_identical(obs, reference(), ~mask)
        # So many ticks after its reset an env is where it was as many after the first one.
        runner.reset(start_poses(panda, 20))
        for _ in range(TICKS - 6):
            early = runner.step(panda.settings.target)
    assert_identical(obs, early, mask)
