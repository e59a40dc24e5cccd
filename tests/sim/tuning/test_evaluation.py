"""Metrics of step responses, evaluations of gains, and the tuned gains that ship."""

import numpy as np
import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import LogUniform, Randomization, Runner, Uniform
from batchpid.sim.tuning.evaluation import (
    arm_joints,
    evaluate_gains,
    following_error,
    load_randomization,
    run_moves,
    step_response_metrics,
)
from batchpid.sim.tuning.moves import Moves, random_moves, seeded_moves


def hold(pose, name="hold"):
    return Moves(np.array([pose]), np.array([pose]), (name,))


def test_metrics_do_not_depend_on_how_long_the_runner_has_run(panda):
    setpoints, metrics, ends = np.broadcast_to(panda.settings.target, (30, panda.dof)), [], []
    with Runner(panda, 2, params=panda.tuned(), workers=0, substeps=5) as runner:
        for _ in range(4):
            runner.reset()
            rollout = runner.rollout(setpoints)
            metrics.append(step_response_metrics(panda, rollout, np.tile(panda.start, (2, 1))))
            ends.append(rollout.time[-1])
            runner.rollout(setpoints[:7])
    assert ends[0] < ends[1] < ends[2] < ends[3]
    for later in metrics[1:]:
        for name, first, figure in zip(later._fields, metrics[0], later, strict=True):
            assert figure.tobytes() == first.tobytes(), name


def test_arm_joints_leave_out_fingers(panda, jaco2):
    assert arm_joints(panda).sum() == 7
    assert arm_joints(jaco2).sum() == 7


def following_and_settling(robot, params, moves, **options):
    found = evaluate_gains(robot, params, moves, workers=0, seconds=1.2, **options)
    arm = arm_joints(robot)
    return found.following_error[:, arm].max(1), found.metrics.settling_time[:, arm].max()


def test_setpoint_weights_change_how_steps_are_approached_and_not_how_motions_are_followed(panda):
    moves, tuned = random_moves(panda, 2, seed=4), panda.tuned()
    (low, slow), (high, fast) = (
        following_and_settling(panda, tuned.replace(setpoint_weight=np.full(panda.dof, b)), moves)
        for b in (0.0, 0.9)
    )
    assert low.max() < 1e-3
    np.testing.assert_allclose(high, low, atol=3e-4)
    assert abs(fast / slow - 1) > 0.05


def test_a_step_is_the_same_beside_a_smooth_motion(panda):
    moves = random_moves(panda, 1, seed=4).take([0, 0])
    with Runner(panda, 2, params=panda.tuned(), workers=0, substeps=5) as runner:
        (step, _), (mixed, _) = (
            run_moves(runner, moves, 0.1, durations=each) for each in (None, np.array([0.0, 1.0]))
        )
    np.testing.assert_allclose(mixed.qpos[:, 0], step.qpos[:, 0], rtol=0, atol=1e-6)
    assert following_error(panda, mixed)[0].max() > 5 * following_error(panda, mixed)[1].max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jaco2", "panda"])
def test_shipped_gains_meet_the_demands_on_moves_that_the_search_did_not_see(name, request):
    robot = request.getfixturevalue(name)
    evaluation = evaluate_gains(robot, robot.tuned(), seeded_moves(robot, 8, 11), workers=0)
    assert evaluation.rollout.ok.all()
    arm = arm_joints(robot)
    metrics = evaluation.metrics
    slowest = np.nan_to_num(metrics.settling_time[:, arm], nan=0.0, posinf=np.inf).max(1)
    assert (slowest <= evaluation.settling_limit).all()
    assert np.nanmax(metrics.overshoot[:, arm]) <= 0.05
    assert np.nanmax(metrics.steady_state_error[:, arm]) <= 1e-3
    assert np.nanmax(evaluation.chatter[:, arm]) <= 2


@pytest.mark.slow
def test_payload_outside_the_model_pulls_the_hand_down_and_the_integral_lifts_it(panda):
    pose = panda.start.copy()
    pose[[1, 3]] = 0.8, -1.0
    loaded = Randomization(payload=Uniform(2.0, 2.0), payload_link="panda_hand")
    gains = bp.design_gains(panda, gain_units="mass_matrix", measurement_rate="measured")
    evaluation = evaluate_gains(
        panda, gains, hold(pose), seconds=3.0, randomization=loaded, workers=0
    )
    assert evaluation.metrics.peak_deviation[0, 1] > 3e-3
    assert evaluation.metrics.steady_state_error[0, :7].max() < 1e-3


def test_randomization_is_a_file(panda, tmp_path):
    path = tmp_path / "drawn.yaml"
    path.write_text(
        "seed: 4\npayload: {uniform: [0, 0.3]}\nparams: {kp: {log_uniform: [0.5, 2], operation: scale}}\n"
    )
    loaded = load_randomization(path, panda)
    kp = LogUniform(0.5, 2, operation="scale")
    assert loaded == Randomization(seed=4, payload=Uniform(0, 0.3), params={"kp": kp})
    assert load_randomization(None, panda) is None
    path.write_text("payload: {uniform: [-1, 0]}")
    with pytest.raises(InvalidArgumentError, match=r"payload, entry 'payload': must be .*got -1"):
        load_randomization(path, panda)
