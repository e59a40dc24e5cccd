"""Runner with a randomization: draws at resets, bit-identity, snapshots, recovery and
recordings.
"""

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

from batchpid.errors import InvalidArgumentError
from batchpid.sim import (
    LogUniform,
    Normal,
    Randomization,
    Runner,
    Uniform,
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
        "kd": Uniform(1.0, 1.1, operation="scale", shared=True),
    },
    actuators={
        "command_delay": Uniform(0, 0.003, shared=True),
        "sensor_delay": Uniform(0.0, 0.001),
        "coulomb": Uniform(0, 0.1),
        "static": Uniform(0, 0.4),
        "position_resolution": Uniform(0, 1e-5),
    },
)
PANDA = load_bundled("panda")


NOISE = np.random.default_rng(1).uniform(-0.3, 0.3, (TICKS, N, PANDA.dof))
SETPOINTS = np.clip(PANDA.settings.target + NOISE, PANDA.lower, PANDA.upper)


def make(**options):
    return Runner(PANDA, N, workers=0, randomization=EVERYTHING, substeps=10, **options)


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
        runner.reset(mask=mask, seed=10)
        assert runner.episodes.tolist() == [[10, 0], [11, 0], *([env, 0] for env in range(2, N))]
        runner.reset(seed=[5] * N)
        assert np.ptp(runner.draws["payload"]) == 0
        runner.reset(seed=0)
        for name, rows in runner.draws.items():
            np.testing.assert_array_equal(rows, before[name], name)
        obs = runner.reset(PANDA.start, seed=7)
        expected = np.clip(PANDA.start + runner.draws["qpos"], PANDA.lower, PANDA.upper)
        np.testing.assert_allclose(obs.qpos, expected, atol=1e-6)
        np.testing.assert_allclose(obs.qvel, runner.draws["qvel"], atol=1e-6)


def test_new_params_are_randomized_and_an_env_keeps_its_draws():
    with make() as runner, make() as other:
        runner.rollout(SETPOINTS)
        other.rollout(SETPOINTS)
        runner.params = runner.params
        assert_identical(runner.rollout(SETPOINTS), other.rollout(SETPOINTS))
        assert runner.params.num_envs == 1
        with pytest.raises(InvalidArgumentError, match=r"params\.kd: is off"):
            runner.params = PANDA.params(kd=None)


@pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
def test_a_fault_that_resets_keeps_the_draws():
    broken = SETPOINTS[0].copy()
    broken[2, 0] = np.nan
    with make(on_fault="reset", on_invalid_input="contain") as runner:
        first, draws = runner.rollout(SETPOINTS), runner.draws
        assert not runner.step(broken).ok[2]
        np.testing.assert_array_equal(runner.draws["payload"], draws["payload"])
        runner.reset(mask=np.arange(N) == 2, seed=0)
        assert_identical(
            runner.rollout(SETPOINTS).for_envs([2]), first.for_envs([2]), skip=["time"]
        )
