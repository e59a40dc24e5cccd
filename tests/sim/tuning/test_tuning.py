"""Moves, evaluations, tuning, and the tuned gains that ship."""

from __future__ import annotations

import json

import numpy as np
import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from sim import Robot
from sim.tuning.evaluation import arm_joints, evaluate_gains
from sim.tuning.moves import Moves, fastest, random_moves, search_moves, smooth_effort, tutorial_move
from sim.tuning.randomization import Variation, capacity, draw_variation
from sim.tuning.search import tune

pytest.importorskip("cmaes")


def test_random_moves_are_seeded_within_limits_and_free_of_contact(panda):
    moves, again, other = random_moves(panda, 8, 3), random_moves(panda, 8, 3), random_moves(panda, 8, 4)
    np.testing.assert_array_equal(moves.start, again.start)
    np.testing.assert_array_equal(moves.target, again.target)
    assert (moves.start != other.start).any()
    for poses in (moves.start, moves.target):
        assert ((poses >= panda.lower) & (poses <= panda.upper)).all()
    for start, target in zip(moves.start, moves.target, strict=True):
        line = start + np.linspace(0, 1.05, 50)[:, None] * (target - start)
        assert not panda.dynamics().touches(line).any()
    assert sum("alone" in name for name in moves.names) == 2
    np.testing.assert_array_equal(random_moves(panda, 3, 3).start, moves.start[:3])


def test_moves_to_search_on_are_the_tutorials_one_of_each_kind_and_the_hardest_of_more(panda):
    moves, drawn = search_moves(panda, 4), random_moves(panda, 32, 4)
    assert moves.names[:2] == ("tutorial", "near the tutorial's")
    np.testing.assert_array_equal(moves.start[2:6], drawn.start[:4])
    assert fastest(panda, moves)[-1] == fastest(panda, drawn.take(range(4, 32))).max()
    assert fastest(panda, moves)[1] > fastest(panda, moves)[0]


def test_probe_sees_contact(panda):
    folded = panda.start.copy()
    folded[[1, 3]] = 1.7, -2.9
    assert panda.dynamics().touches(np.array([folded, panda.start])).tolist() == [True, False]


def test_fastest_is_the_double_integrators_bang_bang_for_a_lone_joint(panda):
    """T = 2 sqrt(A I / limit) where gravity and coupling play no part: the last joint of the arm, alone."""
    start = panda.start
    target = start.copy()
    target[6] += 1.0
    inertia = panda.mass_matrix(start)[0, 6, 6]
    gravity = panda.dynamics().inverse_dynamics(start[None], 0 * start[None], 0 * start[None])[0]
    limit = 12.0 - abs(gravity[6])
    expected = 2 * np.sqrt(inertia / limit)
    # the others must hold against it, with room to spare
    assert fastest(panda, Moves(start[None], target[None], ("",)))[0] == pytest.approx(expected, rel=0.05)


def test_smooth_effort_is_gravity_at_both_ends(panda):
    move = tutorial_move(panda)
    efforts = smooth_effort(panda, move.start[0], move.target[0], 1.0)
    for row, pose in ((0, move.start), (-1, move.target)):
        np.testing.assert_allclose(
            efforts[row], panda.dynamics().inverse_dynamics(pose, 0 * pose, 0 * pose)[0], atol=1e-9
        )


def test_arm_joints_leave_out_fingers(panda):
    assert arm_joints(panda).sum() == 7
    assert arm_joints(Robot.load("jaco2")).sum() == 7


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_shipped_gains_meet_the_demands_on_moves_that_the_search_did_not_see(name):
    robot = Robot.load(name)
    moves = tutorial_move(robot) + random_moves(robot, 8, seed=11)
    evaluation = evaluate_gains(robot, moves=moves, workers=0, params=robot.tuned())
    assert evaluation.rollout.ok.all()
    assert not evaluation.shortfalls(arm_joints(robot))


def test_shortfalls_of_the_tutorials_gains_are_told(panda):
    evaluation = evaluate_gains(panda, panda.params(), tutorial_move(panda), workers=0)
    told = evaluation.shortfalls(arm_joints(panda))
    assert told
    assert "settling time of move 'tutorial'" in "".join(told)


SMALL = {"generations": 2, "population": 4, "seconds": 0.2}


def test_same_seed_gives_the_same_gains_to_the_last_bit_for_any_number_of_workers(panda):
    moves = random_moves(panda, 2, 0)
    found = [tune(panda, moves=moves, workers=workers, seed=5, **SMALL) for workers in (0, 1, 2)]
    for other in found[1:]:
        assert other.history == found[0].history
        for name in ("kp", "ki", "kd", "setpoint_weight", "derivative_filter_time"):
            assert getattr(other.params, name).tobytes() == getattr(found[0].params, name).tobytes()
    assert len({cost for row in found[0].history for cost in row}) > 3
    assert tune(panda, moves=moves, workers=0, seed=6, **SMALL).history != found[0].history
    assert found[0].cost <= found[0].start_cost


def test_a_search_that_stopped_goes_on_as_if_it_had_not(panda, tmp_path):
    moves = random_moves(panda, 1, 0)
    options = {"population": 4, "seconds": 0.2, "moves": moves, "workers": 0}
    whole = tune(panda, generations=3, **options)
    history = tmp_path / "search.json"
    tune(panda, generations=2, history=history, **options)
    told = json.loads(history.read_text())
    assert len(told["costs"]) == 2
    resumed = tune(panda, generations=3, history=history, **options)
    assert resumed.history == whole.history
    assert resumed.params.kp.tobytes() == whole.params.kp.tobytes()
    with pytest.raises(InvalidArgumentError, match="another search"):
        tune(panda, generations=3, history=history, seed=9, **options)
    history.write_text("{}")
    with pytest.raises(InvalidArgumentError, match="no history"):
        tune(panda, generations=3, history=history, **options)


@pytest.mark.parametrize("units", ["effort", "inertia"])
def test_other_units_and_single_joints_can_be_searched_too(panda, units):
    found = tune(panda, moves=random_moves(panda, 1, 0), gain_units=units, per_joint=True, workers=0, **SMALL)
    assert np.isfinite(found.cost)
    ratio = found.params.kp / found.start_params.kp
    assert found.cost == found.start_cost or np.ptp(ratio) > 0


def test_variation_is_felt_and_shared_by_all_workers(panda):
    moves = random_moves(panda, 3, 2)
    drawn = draw_variation(panda, 3, 1)
    assert (drawn.payload <= min(2.0, capacity(panda))).all()
    assert (drawn.friction <= 0.1).all()
    gains = bp.design_gains(panda, gain_units="mass_matrix")
    plain, *varied = (
        evaluate_gains(panda, gains, moves, seconds=0.3, variation=v, workers=w)
        for v, w in ((None, 0), (drawn, 0), (drawn, 2))
    )
    assert varied[0].rollout.qpos.tobytes() == varied[1].rollout.qpos.tobytes()
    assert np.abs(varied[0].rollout.qpos - plain.rollout.qpos).max() > 1e-3


def test_a_payload_that_the_model_does_not_know_pulls_the_hand_down_and_the_integral_lifts_it(panda):
    pose = panda.start.copy()
    pose[[1, 3]] = 0.8, -1.0
    hold = Moves(pose[None], pose[None], ("hold",))
    loaded = Variation(np.array([2.0]), np.zeros(1), "panda_hand")
    gains = bp.design_gains(panda, gain_units="mass_matrix")
    evaluation = evaluate_gains(panda, gains, hold, seconds=3.0, variation=loaded, workers=0)
    assert evaluation.metrics.peak_deviation[0, 1] > 3e-3
    assert evaluation.metrics.steady_state_error[0, :7].max() < 1e-3


def test_late_efforts_and_coarse_sensors(panda):
    pose = np.array([panda.start])
    hold = Moves(pose, pose + 0.01 * np.array([[1, 1, 1, -1, 1, 1, 1, 0, 0]]), ("small",))
    coarse = Variation(np.zeros(1), np.zeros(1), "panda_hand", resolution=1e-3, late=True)
    gains = bp.design_gains(panda, gain_units="mass_matrix")
    evaluation = evaluate_gains(panda, gains, hold, seconds=0.2, variation=coarse, workers=0)
    steps = evaluation.rollout.qpos / 1e-3
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-2)


def test_tuning_with_variation_is_another_search(panda):
    moves = random_moves(panda, 1, 0)
    plain, varied = (
        tune(panda, moves=moves, variation=v, workers=0, **SMALL) for v in (None, {"payload": 1.0, "friction": 0.01})
    )
    assert plain.history != varied.history
    assert varied.settings["variation"] == {"payload": 1.0, "friction": 0.01}


def test_variation_must_fit_the_envs(panda):
    with pytest.raises(InvalidArgumentError, match="variation"):
        evaluate_gains(panda, panda.params(), random_moves(panda, 2), variation=draw_variation(panda, 3), workers=0)
