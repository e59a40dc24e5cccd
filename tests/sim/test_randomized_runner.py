"""Runner with a randomization: draws at resets, bit-identity, snapshots, recovery and recordings."""

import os
import random
import signal
import warnings

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import (
    Choice,
    LogUniform,
    Normal,
    Randomization,
    Recorder,
    RecoveryWarning,
    Runner,
    Snapshot,
    Uniform,
    read_recording,
    write_recording,
)

N, TICKS = 6, 4
KILLS = int(os.environ.get("BATCHPID_SOAK_KILLS", "100"))
EVERYTHING = Randomization(
    seed=3,
    payload=Uniform(0, 0.5),
    link_mass=Uniform(0.7, 1.3, operation="scale"),
    center_of_mass=Uniform(-0.01, 0.01),
    friction=Uniform(0, 0.3),
    damping=Uniform(0, 0.2),
    armature=LogUniform(1e-3, 0.05),
    qpos=Uniform(-0.1, 0.1),
    qvel=Normal(0, 0.1),
    params={"kp": LogUniform(0.5, 2, operation="scale"), "kd": Choice([1.0, 1.1], operation="scale", shared=True)},
    actuators={
        "command_delay": Uniform(0, 0.003, shared=True),
        "sensor_delay": Choice([0.0, 0.001]),
        "coulomb": Uniform(0, 0.1),
        "static": Uniform(0, 0.4),
        "position_resolution": Uniform(0, 1e-5),
    },
)
PANDA = load_bundled("panda")


def make(robot=PANDA, num_envs=N, **options):
    return Runner(robot, num_envs, **{"workers": 0, "randomization": EVERYTHING, "substeps": 10, **options})


def setpoints(robot=PANDA, num_envs=N, ticks=TICKS):
    noise = np.random.default_rng(1).uniform(-0.3, 0.3, (ticks, N, robot.dof))[:, :num_envs]
    return np.clip(robot.settings.target + noise, robot.lower, robot.upper)


def episodes(runner, num_envs=N):
    """Return two rollouts, with a reset of every other env in between."""
    command = setpoints(runner.robot, num_envs)
    first = runner.rollout(command)
    runner.reset(mask=np.arange(num_envs) % 2 == 0)
    return first, runner.rollout(command)


@pytest.mark.quick_rows(1)
@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("name", ["panda", pytest.param("jaco2", marks=pytest.mark.slow)])
def test_an_env_is_the_same_in_any_company_and_for_any_workers(name):
    robot, runs = load_bundled(name), []
    cases = ((N, {}), (N, {"workers": 2}), (2, {}))
    for num_envs, options in cases if name == "panda" else cases[:2]:
        with make(robot, num_envs, **options) as runner:
            runs.append(episodes(runner, num_envs))
    for run in runs[1:]:
        for ours, expected in zip(run, runs[0], strict=True):
            assert_identical(ours, expected.for_envs(slice(ours.num_envs)))
    moved = runs[0][0].qpos
    assert np.abs(moved[:, 0] - moved[:, 1]).max() > 0.01


def test_limits_by_position_are_drawn_for_each_joint_of_each_env():
    points = np.linspace(PANDA.lower, PANDA.upper, 3).T
    actuators = bp.make_actuators(PANDA.dof, position_limit=(points, np.tile([5.0, 8.0, 4.0], (PANDA.dof, 1))))
    scale = Randomization(seed=1, actuators={"limit_efforts": Uniform(0.1, 1, operation="scale")})
    runs = []
    for options in ({}, {"workers": 2}):
        with make(actuators=actuators, randomization=scale, **options) as runner:
            draws = runner.draws["actuators.limit_efforts"]
            runs.append(episodes(runner))
    for run in runs[1:]:
        for ours, expected in zip(run, runs[0], strict=True):
            assert_identical(ours, expected)
    assert draws.shape == (N, PANDA.dof)
    drawn = actuators._replace(limit_efforts=actuators.limit_efforts * draws[..., None])
    with make(actuators=drawn, randomization=None) as runner:
        assert_identical(runner.rollout(setpoints()), runs[0][0])


def test_a_reset_draws_for_the_envs_of_its_mask():
    with make() as runner:
        before, mask = runner.draws, np.arange(N) < 2
        assert runner.episodes.tolist() == [[env, 0] for env in range(N)]
        runner.reset(mask=mask)
        after = runner.draws
        assert runner.episodes[:, 1].tolist() == [1, 1, 0, 0, 0, 0]
        for name, rows in after.items():
            np.testing.assert_array_equal(rows[~mask], before[name][~mask], name)
        assert (after["payload"][mask] != before["payload"][mask]).all()
        runner.reset(seed=0)
        for name, rows in runner.draws.items():
            np.testing.assert_array_equal(rows, before[name], name)
        obs = runner.reset(PANDA.start, seed=7)
        expected = np.clip(PANDA.start + runner.draws["qpos"], PANDA.lower, PANDA.upper)
        np.testing.assert_allclose(obs.qpos, expected, atol=1e-6)
        np.testing.assert_allclose(obs.qvel, runner.draws["qvel"], atol=1e-6)


@pytest.mark.parametrize("seed", [-1, 0.5, [1, 2], [-1] * N])
def test_seeds_are_whole_numbers_one_for_each_env(seed):
    with make() as runner, pytest.raises(InvalidArgumentError, match="seed"):
        runner.reset(seed=seed)


def test_a_seed_without_randomization_is_refused():
    with make(randomization=None) as runner, pytest.raises(InvalidArgumentError, match="seed: has no effect"):
        runner.reset(seed=0)


def test_new_params_are_randomized_and_an_env_keeps_its_draws():
    runs = []
    for change in (True, False):
        with make() as runner:
            if not change:
                runner.rollout(setpoints())
            else:
                runner.params = runner.params
                runner.rollout(setpoints())
            runs.append(runner.rollout(setpoints()))
            assert runner.params.num_envs == 1
    assert_identical(*runs)
    with make() as runner, pytest.raises(InvalidArgumentError, match=r"params\.kd: is off"):
        runner.params = PANDA.params(kd=None)


@pytest.mark.quick_rows(1)
@pytest.mark.usefixtures("engine")
def test_a_snapshot_holds_the_draws(tmp_path):
    command = setpoints()
    with make(actuators=bp.make_actuators(PANDA.dof, lag=0.002)) as runner:
        episodes(runner)
        snapshot = runner.snapshot()
        draws, expected = runner.draws, runner.rollout(command)
        snapshot.save(tmp_path / "s.npz")
        runner.reset()
        runner.restore(snapshot)
        for name, rows in runner.draws.items():
            np.testing.assert_array_equal(rows, draws[name], name)
        assert_identical(runner.rollout(command), expected)
        runner.reset(mask=np.ones(N, bool))
        last = runner.episodes
    with make(actuators=bp.make_actuators(PANDA.dof, lag=0.002)) as other:
        other.restore(Snapshot.load(tmp_path / "s.npz"))
        assert_identical(other.rollout(command), expected)
        other.reset()
        np.testing.assert_array_equal(other.episodes, last)


def test_a_snapshot_of_another_randomization_is_refused():
    with make() as runner:
        snapshot = runner.snapshot()
    for randomization in (None, Randomization(seed=3, payload=Uniform(0, 1))):
        with make(randomization=randomization) as runner:
            with pytest.raises(InvalidArgumentError, match="is of a runner with randomization"):
                runner.restore(snapshot)
            with pytest.raises(InvalidArgumentError, match="snapshot"):
                make().restore(runner.snapshot())


def test_delays_that_differ_from_group_to_group_are_in_one_snapshot():
    """The histories of a group are as long as its own longest delay needs."""
    delay = np.repeat(np.linspace(0, 0.01, 18)[:, None], PANDA.dof, 1)
    actuators = bp.make_actuators(PANDA.dof, command_delay=delay, sensor_delay=delay[::-1])
    with make(num_envs=18, randomization=None, actuators=actuators, substeps=4) as runner:
        runner.rollout(np.tile(PANDA.settings.target, (3, 1)))
        snapshot = runner.snapshot()
        expected = runner.rollout(np.tile(PANDA.settings.target, (3, 1)))
        runner.restore(snapshot)
        assert_identical(runner.rollout(np.tile(PANDA.settings.target, (3, 1))), expected)


def test_a_fault_that_resets_keeps_the_draws():
    command = setpoints()
    with make(on_fault="reset", on_invalid_input="contain") as runner, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first, draws = runner.rollout(command), runner.draws
        broken = command[0].copy()
        broken[2, 0] = np.nan
        assert not runner.step(broken).ok[2]
        np.testing.assert_array_equal(runner.draws["payload"], draws["payload"])
        runner.reset(mask=np.arange(N) == 2, seed=0)
        assert_identical(runner.rollout(command).for_envs([2]), first.for_envs([2]), skip=["time"])


def run_with_kills(kills, seed):
    chosen = random.Random(seed)
    command = setpoints(ticks=4)
    with make(workers=2, checkpoint_steps=100) as runner:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RecoveryWarning)
            for done in range(kills):
                os.kill(runner.pids[chosen.randrange(2)], signal.SIGKILL)
                runner.rollout(command[: 1 + done % 3])
                if done % 3 == 0:
                    os.kill(runner.pids[chosen.randrange(2)], signal.SIGKILL)
                    runner.reset(mask=np.arange(N) % (2 + done % 4) == 0)
        assert runner.recoveries >= kills
        return runner.observe(), runner.draws, runner.snapshot()


def run_undisturbed(kills):
    command = setpoints(ticks=4)
    with make(checkpoint_steps=100) as runner:
        for done in range(kills):
            runner.rollout(command[: 1 + done % 3])
            if done % 3 == 0:
                runner.reset(mask=np.arange(N) % (2 + done % 4) == 0)
        return runner.observe(), runner.draws, runner.snapshot()


def assert_kills_change_nothing(kills, seed=0):
    (ours, draws, snapshot), (theirs, expected, other) = run_with_kills(kills, seed), run_undisturbed(kills)
    assert_identical(ours, theirs)
    for name, rows in expected.items():
        np.testing.assert_array_equal(draws[name], rows, name)
    np.testing.assert_array_equal(snapshot.episodes, other.episodes)


@pytest.mark.slow
def test_lost_workers_draw_the_same_again():
    assert_kills_change_nothing(1)


@pytest.mark.slow
def test_many_lost_workers_draw_the_same_again():
    assert_kills_change_nothing(KILLS)


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_a_recording_holds_the_distributions_and_the_draws(suffix, tmp_path):
    path = tmp_path / f"run{suffix}"
    with make() as runner:
        runner.reset()
        if suffix == ".h5":
            with Recorder(path, runner):
                runner.rollout(setpoints())
        else:
            write_recording(runner.rollout(setpoints()), path)
        draws, order = runner.draws, runner.episodes
    info = read_recording(path).info
    assert Randomization.from_dict(info.randomization) == EVERYTHING
    np.testing.assert_array_equal(info.episodes, order)
    assert info.draws.keys() == draws.keys()
    for name, rows in draws.items():
        np.testing.assert_array_equal(info.draws[name], rows, name)
    part = info.for_envs([1])
    np.testing.assert_array_equal(part.draws["payload"], draws["payload"][[1]])
    np.testing.assert_array_equal(part.episodes, [[1, 1]])


def test_a_recording_holds_the_episodes_that_begin_in_it(tmp_path):
    with make() as runner:
        with Recorder(tmp_path / "run.h5", runner):
            runner.rollout(setpoints())
            runner.reset(mask=np.arange(N) == 4)
            runner.rollout(setpoints())
        draws, order = runner.draws, runner.episodes
    info = read_recording(tmp_path / "run.h5").info
    (begun,) = info.redraws
    assert begun == (pytest.approx(0.005 * (TICKS + 1)), 4, 4, 1)
    again = Randomization.from_dict(info.randomization).draw(PANDA, order)
    for name, rows in again.values.items():
        np.testing.assert_array_equal(rows, draws[name], name)
    assert info.for_envs(slice(4, 6)).redraws == ((begun.time, 0, 4, 1),)
    assert info.for_envs([1]).redraws == ()
