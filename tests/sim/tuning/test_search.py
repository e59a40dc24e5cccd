"""The search for gains: its seed, its units, its costs."""

import dataclasses

import numpy as np
import pytest
from option_values import ARM
from robots import load_bundled

from batchpid import make_actuators
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Randomization, Uniform
from batchpid.sim.tuning import tune
from batchpid.sim.tuning.evaluation import arm_joints, evaluate_gains
from batchpid.sim.tuning.moves import seeded_moves

pytest.importorskip("cmaes")

SMALL = {"generations": 2, "seconds": 0.1, "engine": "mujoco"}


SIZES = "batchpid.sim.tuning.search."


@pytest.fixture
def few_moves(monkeypatch):
    """Search four candidates at once on two moves, with a final on one other."""
    for name, size in {"POPULATION": 4, "SEARCH_MOVES": 2, "FINAL_MOVES": 1}.items():
        monkeypatch.setattr(SIZES + name, size)


def test_gains_and_implicit_laws_are_refused(panda):
    for options, message in (
        (
            {"params": panda.designed()},
            r"params: .*explicit gains; .*bp\.design_gains makes implicit gains",
        ),
        ({"discretization": "implicit"}, r"discretization: .*explicit gains; .*bp\.design_gains"),
    ):
        with pytest.raises(InvalidArgumentError, match=message):
            tune(panda, workers=0, **options)


def test_same_seed_gives_bit_identical_gains_for_any_number_of_workers(few_moves):
    found, other = (tune(ARM, workers=workers, seed=5, **SMALL) for workers in (0, 2))
    assert other.history == found.history
    for name in ("kp", "ki", "kd", "setpoint_weight", "derivative_filter_time"):
        assert getattr(other.params, name).tobytes() == getattr(found.params, name).tobytes()
    assert len({cost for row in found.history for cost in row}) > 3
    assert tune(ARM, workers=0, seed=6, **SMALL).history != found.history
    assert found.cost <= found.start_cost
    assert found.cost in [
        *sorted(cost for row in found.history for cost in row)[:3],
        found.start_cost,
    ]


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("sapien", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["arm", "panda", "jaco2"])
def test_a_short_search_is_near_the_best_of_many_candidates(name, engine, few_moves, monkeypatch):
    robot = ARM if name == "arm" else load_bundled(name)
    options = SMALL | {"seconds": 0.3, "engine": engine, "workers": 0}
    short = tune(robot, **options)
    monkeypatch.setattr(SIZES + "POPULATION", 48)
    wide = tune(robot, **options | {"generations": 1})
    assert short.cost <= short.start_cost
    assert short.cost <= 1.1 * min(wide.history[0])


def test_search_starts_from_the_designed_gains(few_moves):
    found = tune(ARM, workers=0, **SMALL)
    for name in ("kp", "ki", "kd"):
        np.testing.assert_array_equal(
            getattr(found.start_params, name), getattr(ARM.designed(), name)
        )


def test_gains_in_efforts_can_be_searched_too(few_moves):
    found = tune(ARM, gain_units="effort", workers=0, **SMALL)
    ratio = found.params.kp / found.start_params.kp
    assert found.cost == found.start_cost or (ratio != 1).all()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "least"), [("panda", 19), ("jaco2", 17)])
def test_first_candidates_are_in_time_with_late_motors_an_encoder_and_a_payload(name, least):
    robot = load_bundled(name)
    encoder = 2 * np.pi / 2**18
    motors = make_actuators(robot.dof, command_delay=0.005, position_resolution=encoder)
    robot = dataclasses.replace(robot, actuators=motors)
    payload = Randomization(payload=Uniform(0, 0.5))
    found = tune(robot, generations=1, randomization=payload)
    moves = seeded_moves(robot, 20, 1)
    judged = evaluate_gains(
        robot, found.params, moves, randomization=dataclasses.replace(payload, seed=1)
    )
    settling = judged.metrics.settling_time[:, arm_joints(robot)]
    slowest = np.nan_to_num(settling, nan=0.0, posinf=np.inf).max(1)
    assert (slowest <= judged.settling_limit).sum() >= least


@pytest.mark.slow
def test_gains_of_the_search_settle_sooner_than_designed_ones_and_follow_closely(panda):
    found = tune(panda)
    moves = seeded_moves(panda, 20, 1)
    designed, tuned = (
        evaluate_gains(panda, each, moves) for each in (found.start_params, found.params)
    )
    arm = arm_joints(panda)
    assert tuned.following_error[:, arm].max() < 1e-3
    settling = [each.metrics.settling_time[:, arm].max() for each in (designed, tuned)]
    assert settling[1] < 0.95 * settling[0]
