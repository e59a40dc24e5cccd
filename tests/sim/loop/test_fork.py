"""A snapshot of one env restored in many: each copy goes on as the original, bit by bit."""

import numpy as np
import pytest
from identical import assert_identical
from option_values import ARM, label

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Randomization, Runner, Uniform

MOTORS = bp.make_actuators(ARM.dof, command_delay=2e-3, lag=1e-3, coulomb=0.1, position_noise=1e-3)
SETPOINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (6, ARM.dof))
CASES = [
    {},
    {"actuators": MOTORS},
    {"guard": True, "contacts": ["hand"]},
    {"randomization": Randomization(payload=Uniform(0, 0.5))},
]


def moved(runner, ticks):
    """Return a rollout in which all envs have the same setpoints."""
    setpoints = SETPOINTS[ticks, None]
    return runner.rollout(np.broadcast_to(setpoints, (len(setpoints), runner.num_envs, ARM.dof)))


@pytest.mark.quick_rows(6)
@pytest.mark.parametrize("options", CASES, ids=label)
@pytest.mark.parametrize("workers", [0, 2])
def test_copies_go_on_as_the_original(engine, workers, options):
    with Runner(ARM, 3, workers=0, **options) as runner:
        moved(runner, slice(0, 3))
        snapshot = runner.snapshot()
        expected = moved(runner, slice(3, 6))
    with Runner(ARM, 5, workers=workers, **options) as other:
        moved(other, slice(2, 4))
        other.restore(snapshot.for_envs([1, 1, 2, 1, 0]))
        copies = moved(other, slice(3, 6))
    for copy, original in enumerate([1, 1, 2, 1, 0]):
        assert_identical(copies.for_envs([copy]), expected.for_envs([original]))
    assert np.ptp(copies.qpos[:, 0], axis=0).max() > 1e-4


def test_a_runner_of_another_number_of_envs_or_control_refuses_it():
    with Runner(ARM, 2, workers=0) as runner:
        snapshot = runner.snapshot()
        with pytest.raises(InvalidArgumentError, match="another num_envs"):
            runner.restore(snapshot.for_envs([0, 1, 1]))
    with (
        Runner(ARM, 3, workers=0, control="drive") as other,
        pytest.raises(InvalidArgumentError, match="control"),
    ):
        other.restore(snapshot.for_envs([0, 1, 1]))
    for envs in ([2], [0.0]):
        with pytest.raises(IndexError):
            snapshot.for_envs(envs)
