"""Results in contact, at many places at once, are bit-identical for any packing of the envs, in each engine."""

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

from batchpid.sim import RecoveryWarning, Robot, Runner
from batchpid.sim.engine.sapien.contact_prediction import ContactPredictor
from batchpid.sim.tuning.randomization_presets import usual_variation

# In MuJoCo, which does not limit the speed of joints, light fingers fail under these efforts.
pytestmark = pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
N, TICKS = 16, 10  # with fewer envs, results did not depend on the packing even without contact prediction
OPEN_LOOP = {"kp": 0.0, "ki": 0.0, "kd": 0.0}


def random_efforts(robot, ticks=TICKS, num_envs=N):
    """Efforts under which fingers hit each other and the hand, at several places at once."""
    return np.random.default_rng(0).normal(size=(ticks, num_envs, robot.dof)) * robot.effort_limit


def thrash(name="jaco2", *, num_envs=N, before=lambda runner: None, after=lambda runner: None, **options):
    """Return a rollout under random efforts, with calls before and after it."""
    robot = load_bundled(name)
    options = {"params": robot.params(**OPEN_LOOP), "control": "effort", "workers": 0} | options
    with Runner(robot, num_envs, **options) as runner:
        before(runner)
        rollout = runner.rollout(random_efforts(robot, num_envs=num_envs))
        after(runner)
    return rollout


@functools.cache
def reference(name="jaco2", physics="accurate", engine="sapien"):
    """Return the rollout with every env alone in a system from the start."""
    return thrash(name, physics=physics, engine=engine, **({"pack_size": 1} if engine == "sapien" else {}))


PACKED, SHARED = {"pack_size": 8}, {"pack_size": 4, "workers": 2}


@pytest.mark.quick_rows(1)
@pytest.mark.parametrize(
    ("options", "name", "physics"),
    [
        (SHARED, "jaco2", "accurate"),
        *(pytest.param(SHARED, *each, marks=pytest.mark.slow) for each in (("jaco2", "fast"), ("panda", "accurate"))),
        *(pytest.param(PACKED, "jaco2", each, marks=pytest.mark.slow) for each in ("accurate", "fast")),
        *(pytest.param(PACKED, "panda", each, marks=pytest.mark.slow) for each in ("accurate", "fast")),
        pytest.param(SHARED, "panda", "fast", marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_any_packing_and_workers_are_bit_identical(name, physics, options):
    assert_identical(thrash(name, physics=physics, **options), reference(name, physics))


@pytest.mark.slow
def test_without_contact_prediction_results_depend_on_the_packing(monkeypatch):
    """Otherwise the tests of this module could not fail."""
    monkeypatch.setattr(ContactPredictor, "predicts_contact", lambda *_: False)
    shared = thrash(pack_size=8, physics="fast")
    assert (shared.qpos != thrash(pack_size=1, physics="fast").qpos).any((0, 2)).sum() > 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jaco2", "panda"])
def test_robots_that_fall_onto_the_ground_are_bit_identical_for_any_packing(name):
    robot = load_bundled(name)
    poses = robot.sample(N, seed=1)

    def fall(pack_size):
        return thrash(
            name,
            pack_size=pack_size,
            compensate="none",
            params=robot.params(**OPEN_LOOP, effort_limit=1e-6),
            before=lambda runner: runner.reset(poses),
        )

    first = fall(1)
    assert np.abs(first.qpos[-1] - poses).max() > 0.3
    assert_identical(fall(8), first)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["sapien", "mujoco"], indirect=True)
@pytest.mark.usefixtures("engine")
def test_robots_on_a_floating_base_are_bit_identical_for_any_packing():
    robot = Robot.load("panda", fixed_base=False)
    options = {"control": "effort", "params": robot.params(**OPEN_LOOP)}
    runs = []
    for pack_size, workers in ((1, 0), (4, 2)):
        with Runner(robot, N, pack_size=pack_size, workers=workers, **options) as runner:
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
    options = {"control": "effort", "params": jaco2.params(**OPEN_LOOP), "workers": 0, "pack_size": 8}
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


@pytest.mark.slow
def test_robots_that_start_in_contact_are_isolated_and_bit_identical(jaco2, packs):
    def start(runner):
        runner.reset(closed_hand(jaco2))
        assert packs.isolated() == N

    assert_identical(*(thrash(pack_size=size, before=start) for size in (1, 8)))


@pytest.mark.parametrize("closed", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_an_episode_does_not_depend_on_the_episodes_before_it(closed, jaco2, packs):
    """A reset discards the order of earlier contacts, too."""
    start, isolated, ticks = (closed_hand(jaco2), N, 6) if closed else (jaco2.start, 0, TICKS)
    with Runner(jaco2, N, control="effort", params=jaco2.params(**OPEN_LOOP), workers=0) as runner:
        episodes = []
        for _ in range(2):
            runner.reset(start)
            assert packs.isolated() == isolated
            episodes.append(runner.rollout(random_efforts(jaco2, ticks)))
            assert packs.isolated() > 0
    assert_identical(*episodes, skip=["time"])


@pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning")
@pytest.mark.parametrize("name", [pytest.param("jaco2", marks=pytest.mark.slow), "panda"])
def test_robots_in_free_motion_share_systems(name, packs):
    robot = load_bundled(name)
    with Runner(robot, 8, params=robot.params(), workers=0) as runner:
        runner.rollout(np.broadcast_to(robot.settings.target, (50, robot.dof)))
        assert packs.isolated() == 0


@pytest.mark.slow
def test_a_robot_that_is_isolated_keeps_its_drives(jaco2, packs):
    """Targets, gains and limits of the engine's drives are copied to the new system."""
    target, runs = closed_hand(jaco2), []
    for pack_size in (1, 4):
        with Runner(jaco2, 4, control="drive", workers=0, pack_size=pack_size) as runner:
            runs.append(runner.rollout(np.broadcast_to(target, (40, jaco2.dof))))
            assert packs.isolated() == 4
    assert_identical(*runs)
    assert np.abs(runs[0].qpos[-1, :, :6] - target[:6]).max() < 0.02


@pytest.mark.slow
def test_a_robot_that_is_isolated_keeps_its_payload_and_friction(jaco2, packs):
    randomization, actuators = usual_variation(jaco2)
    options = {"randomization": replace(randomization, seed=2), "actuators": actuators}
    isolated = []
    runs = [
        thrash(num_envs=6, pack_size=size, after=lambda runner: isolated.append(packs.isolated()), **options)
        for size in (1, 6)
    ]
    assert isolated[0] == isolated[1] > 0
    assert_identical(*runs)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_snapshot_in_contact_is_the_same_barrier_for_any_packing(jaco2, workers):
    ticks = 5
    effort = random_efforts(jaco2, 2 * ticks)
    options = {"control": "effort", "params": jaco2.params(**OPEN_LOOP)}

    def run(pack_size):
        with Runner(jaco2, N, workers=0, pack_size=pack_size, **options) as runner:
            runner.rollout(effort[:ticks])
            snapshot = runner.snapshot()
            return runner.rollout(effort[ticks:]), snapshot

    (first, snapshot), (second, other) = run(1), run(8)
    assert_identical(second, first)
    np.testing.assert_array_equal(other.states.engine, snapshot.states.engine)
    assert snapshot.states.engine[:, 2 * jaco2.dof + 13].any()  # isolated
    with Runner(jaco2, N, workers=workers, **options) as runner:
        runner.restore(snapshot)
        assert_identical(runner.rollout(effort[ticks:]), first)


@pytest.mark.slow
def test_a_worker_killed_in_contact_is_replaced_bit_identically():
    def wait(runner):
        runner.rollout(np.zeros((1, N, runner.robot.dof)))

    def kill(runner):
        wait(runner)
        os.kill(runner.pids[1], signal.SIGKILL)

    expected = thrash(checkpoint_steps=150, before=wait, pack_size=1)
    with pytest.warns(RecoveryWarning):
        found = thrash(workers=2, checkpoint_steps=150, before=kill)
    assert_identical(found, expected)
