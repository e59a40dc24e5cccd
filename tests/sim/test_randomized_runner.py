"""Runner with a randomization: draws at resets, bit-identity, snapshots, recovery and
recordings.
"""

import warnings

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

from batchpid.errors import InvalidArgumentError
from batchpid.sim import (
    Choice,
    LogUniform,
    Normal,
    Randomization,
    Recorder,
    Runner,
    Uniform,
    read_recording,
)

N, TICKS = 6, 4
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
    params={
        "kp": LogUniform(0.5, 2, operation="scale"),
        "kd": Choice([1.0, 1.1], operation="scale", shared=True),
    },
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
    return Runner(
        robot, num_envs, **{"workers": 0, "randomization": EVERYTHING, "substeps": 10, **options}
    )


def setpoints(robot=PANDA, num_envs=N, ticks=TICKS):
    noise = np.random.default_rng(1).uniform(-0.3, 0.3, (ticks, N, robot.dof))[:, :num_envs]
    return np.clip(robot.settings.target + noise, robot.lower, robot.upper)


def episodes(runner, num_envs=N):
    """Return two rollouts, with a reset of every other env in between."""
    command = setpoints(runner.robot, num_envs)
    first = runner.rollout(command)
    runner.reset(mask=np.arange(num_envs) % 2 == 0)
    return first, runner.rollout(command)


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


def test_a_recording_holds_the_distributions_and_the_draws(tmp_path):
    path = tmp_path / "run.h5"
    with make() as runner:
        runner.reset()
        with Recorder(path, runner):
            runner.rollout(setpoints())
        draws, order = runner.draws, runner.episodes
    info = read_recording(path).info
    assert Randomization.from_dict(info.randomization) == EVERYTHING
    np.testing.assert_array_equal(info.episodes, order)
    assert info.draws.keys() == draws.keys()
    for name, rows in draws.items():
        np.testing.assert_array_equal(info.draws[name], rows, name)
    part = info.for_envs(np.array([1]))
    np.testing.assert_array_equal(part.draws["payload"], draws["payload"][[1]])
    np.testing.assert_array_equal(part.episodes, [[1, 1]])
