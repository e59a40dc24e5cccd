"""The search for gains: its seed, its history, its units."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from option_values import ARM
from robots import load_bundled

from batchpid import make_actuators
from batchpid.errors import InvalidArgumentError
from batchpid.sim import MujocoSolver, Randomization, Robot, Runner, Uniform
from batchpid.sim.tuning import (
    Weights,
    arm_joints,
    evaluate_gains,
    load_randomization,
    random_moves,
    tune,
    tune_tool,
    tutorial_move,
)

pytest.importorskip("cmaes")

SMALL = {"generations": 2, "population": 4, "seconds": 0.1, "engine": "mujoco"}


@pytest.fixture
def few_moves(monkeypatch):
    """Search on two moves, with a final on one other."""
    monkeypatch.setattr("batchpid.sim.tuning.search.search_moves", lambda robot, seed: random_moves(robot, 2, seed))
    monkeypatch.setattr("batchpid.sim.tuning.search.FINAL_MOVES", 1)


def test_gains_and_implicit_laws_are_refused(panda):
    implicit = panda.params(kp=900.0, kd=60.0, ki=None, gain_units="mass_matrix", discretization="implicit")
    for search, name, value, message in (
        (tune, "params", implicit, r"explicit gains; .*bp\.design_gains makes implicit gains"),
        (tune, "discretization", "implicit", r"explicit gains; .*bp\.design_gains"),
        (tune_tool, "params", implicit, r"discretization='implicit' may be added to the options found"),
        (tune_tool, "control", "pid", "is chosen by the search"),
        (tune_tool, "discretization", "implicit", "explicit gains"),
    ):
        with pytest.raises(InvalidArgumentError, match=f"{name}: .*{message}"):
            search(panda, workers=0, **{name: value})
    motors = make_actuators(panda.dof, strength=0.9)
    with pytest.raises(InvalidArgumentError, match="actuators: is given with motors"):
        tune(panda, motors=motors, actuators=motors)


def test_same_seed_gives_bit_identical_gains_for_any_number_of_workers(few_moves):
    found, other = (tune(ARM, workers=workers, seed=5, **SMALL) for workers in (0, 2))
    assert other.history == found.history
    for name in ("kp", "ki", "kd", "setpoint_weight", "derivative_filter_time"):
        assert getattr(other.params, name).tobytes() == getattr(found.params, name).tobytes()
    assert len({cost for row in found.history for cost in row}) > 3
    assert tune(ARM, workers=0, seed=6, **SMALL).history != found.history
    assert found.cost <= found.start_cost


@pytest.mark.slow
def test_robots_touch_things_in_the_final_and_where_the_moves_are_given(panda, few_moves, monkeypatch):
    options = []

    def runner(*args, **kwargs):
        options.append((kwargs.get("collisions", True), kwargs.get("physics")))
        return Runner(*args, **kwargs)

    monkeypatch.setattr("batchpid.sim.tuning.evolution.Runner", runner)
    tune(panda, workers=0, physics="fast", **SMALL)
    assert options == [(False, "free"), (True, "fast")]
    options.clear()
    tune(panda, moves=random_moves(panda, 1, 0), workers=0, physics="fast", **SMALL)
    assert options == [(True, "fast")]


def test_search_that_was_stopped_resumes_as_if_it_had_not_been(tmp_path):
    moves = random_moves(ARM, 1, 0)
    options = {"population": 4, "seconds": 0.1, "moves": moves, "workers": 0, "engine": "mujoco"}
    whole = tune(ARM, generations=3, **options)
    history = tmp_path / "search.json"
    tune(ARM, generations=2, history=history, **options)
    assert len(json.loads(history.read_text())["state"]) == 2
    resumed = tune(ARM, generations=3, history=history, **options)
    assert resumed.history == whole.history
    assert resumed.params.kp.tobytes() == whole.params.kp.tobytes()
    with pytest.raises(InvalidArgumentError, match="another search"):
        tune(ARM, generations=3, history=history, seed=9, **options)
    history.write_text("{}")
    with pytest.raises(InvalidArgumentError, match="not a history"):
        tune(ARM, generations=3, history=history, **options)


def test_a_history_of_other_inputs_is_refused_by_their_names(tmp_path):
    moves, history = random_moves(ARM, 1, 0), tmp_path / "search.json"
    actuators = make_actuators(ARM.dof, strength=np.linspace(0.9, 1.1, ARM.dof))
    options = {"moves": moves, "workers": 0, **SMALL, "generations": 1, "history": history}
    options |= {"actuators": actuators, "physics": MujocoSolver(iterations=3)}
    tune(ARM, **options)

    def refused(names: str, robot: Robot = ARM, **changed) -> None:
        with pytest.raises(InvalidArgumentError, match=rf"another search \({names} differ\)"):
            tune(robot, **{**options, **changed})

    permuted = actuators._replace(strength=actuators.strength[:, ::-1])
    assert repr(permuted) == repr(actuators)
    refused("actuators", actuators=permuted)
    refused("actuators, robot_actuators", dataclasses.replace(ARM, actuators=permuted), actuators=None)
    refused("moves_digest", moves=moves._replace(target=moves.target + 1e-9))
    heavier = ARM.urdf.replace('mass value="', 'mass value="1')
    refused("urdf", dataclasses.replace(ARM, urdf=heavier))
    refused("physics", physics=MujocoSolver(iterations=4))
    refused("timestep", timestep=1 / 1000)
    refused("speed_limit", speed_limit=np.full(ARM.dof, 9.0))
    refused("weights", weights=Weights(itae=2.0))
    refused("weights", weights=Weights(following=3.0))
    refused("seconds", seconds=0.25)
    refused("randomization", randomization=Randomization(payload=Uniform(0, 1)))
    with pytest.raises(InvalidArgumentError, match="whether build is the same"):
        tune(ARM, **options, build=lambda scene, env: None)


def test_the_result_is_the_best_of_the_final_not_of_the_search(monkeypatch):
    drawn = iter([random_moves(ARM, 1, 3)])
    monkeypatch.setattr("batchpid.sim.tuning.search.search_moves", lambda *_: random_moves(ARM, 1, 0))
    monkeypatch.setattr("batchpid.sim.tuning.search.random_moves", lambda *_: next(drawn))
    monkeypatch.setattr("batchpid.sim.tuning.search.FINAL_MOVES", 1)
    found = tune(ARM, workers=0, **SMALL)
    costs = sorted(cost for row in found.history for cost in row)
    assert found.cost in [*costs[:3], found.start_cost]
    assert found.cost <= found.start_cost


def test_cost_is_linear_in_the_weight_of_the_following_error():
    moves = random_moves(ARM, 3, 0)

    def start_cost(weight: float) -> float:
        options = SMALL | {"generations": 1, "weights": Weights(following=weight)}
        return tune(ARM, moves=moves, workers=0, **options).start_cost

    none, some, more = map(start_cost, (0.0, 0.5, 2.0))
    assert some > none + 1e-4
    assert more - none == pytest.approx(4 * (some - none))


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("sapien", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["arm", "panda", "jaco2"])
def test_a_short_search_is_near_the_best_of_many_candidates(name, engine):
    robot = ARM if name == "arm" else load_bundled(name)
    options = SMALL | {"seconds": 0.3, "engine": engine, "moves": random_moves(robot, 2, 0), "workers": 0}
    short = tune(robot, **options)
    wide = tune(robot, **options | {"generations": 1, "population": 48, "seed": 1})
    assert short.cost <= short.start_cost
    assert short.cost <= 1.1 * min(wide.history[0])


def test_search_starts_from_the_designed_gains():
    found = tune(ARM, moves=random_moves(ARM, 1, 0), workers=0, **SMALL)
    for name in ("kp", "ki", "kd"):
        np.testing.assert_array_equal(getattr(found.start_params, name), getattr(ARM.designed(), name))


@pytest.mark.parametrize("units", ["effort", pytest.param("inertia", marks=pytest.mark.slow)])
def test_other_units_and_single_joints_can_be_searched_too(units):
    found = tune(ARM, moves=random_moves(ARM, 1, 0), gain_units=units, per_joint=True, workers=0, **SMALL)
    assert np.isfinite(found.cost)
    ratio = found.params.kp / found.start_params.kp
    assert found.cost == found.start_cost or np.ptp(ratio) > 0


@pytest.mark.slow
def test_randomization_and_actuators_make_another_search(panda):
    moves, drawn = random_moves(panda, 1, 0), Randomization(payload=Uniform(0, 1))
    late = dataclasses.replace(panda, actuators=make_actuators(panda.dof, command_delay=0.003))
    plain, varied, late = (
        tune(robot, moves=moves, workers=0, randomization=randomization, **SMALL)
        for robot, randomization in ((panda, None), (panda, drawn), (late, None))
    )
    assert len({plain.history, varied.history, late.history}) == 3
    assert varied.settings["randomization"] == drawn.to_dict()


@pytest.mark.slow
def test_search_of_robots_that_differ_resumes_as_if_it_had_not_been_stopped(panda, tmp_path):
    late = dataclasses.replace(panda, actuators=make_actuators(panda.dof, command_delay=0.003))
    options = {"population": 4, "seconds": 0.2, "moves": random_moves(panda, 1, 0), "workers": 0}
    whole = tune(late, generations=3, **options)
    tune(late, generations=2, history=tmp_path / "search.json", **options)
    resumed = tune(late, generations=3, history=tmp_path / "search.json", **options)
    assert resumed.history == whole.history
    assert resumed.params.kp.tobytes() == whole.params.kp.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "least"), [("panda", 19), ("jaco2", 17)])
def test_first_candidates_are_in_time_with_late_motors_an_encoder_and_a_payload(name, least):
    robot = load_bundled(name)
    encoder = 2 * np.pi / 2**18
    motors = make_actuators(robot.dof, command_delay=0.005, position_resolution=encoder)
    robot = dataclasses.replace(robot, actuators=motors)
    payload = load_randomization("payload", robot)
    found = tune(robot, generations=1, randomization=payload)
    moves = tutorial_move(robot) + random_moves(robot, 20, 1)
    judged = evaluate_gains(robot, found.params, moves, randomization=dataclasses.replace(payload, seed=1))
    late = judged.demands(arm_joints(robot))["settling time"].max(1) > 1
    assert len(late) - late.sum() >= least


@pytest.mark.slow
def test_gains_of_the_search_follow_unseen_motions_more_closely_than_designed_ones(panda):
    found = tune(panda)
    moves = tutorial_move(panda) + random_moves(panda, 20, 1)
    designed, tuned = (evaluate_gains(panda, each, moves, follow=True) for each in (found.start_params, found.params))
    arm = arm_joints(panda)
    assert tuned.following_error[:, arm].max() < 0.8 * designed.following_error[:, arm].max()
    assert tuned.metrics.settling_time[:, arm].max() <= designed.metrics.settling_time[:, arm].max()


def test_time_limit_ends_the_search_after_a_generation():
    found = tune(ARM, moves=random_moves(ARM, 1, 0), workers=0, time_limit=0.0, **SMALL)
    assert len(found.history) == found.settings["generations"] == 1


@pytest.mark.parametrize("weight", [float("nan"), float("inf"), -1.0])
def test_weights_are_finite_and_not_negative(weight):
    with pytest.raises(InvalidArgumentError, match="overshoot"):
        Weights(overshoot=weight)
