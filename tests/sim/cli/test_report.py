"""The report at the end of a run: its speed, a table of the joints, and what went wrong."""

from __future__ import annotations

import numpy as np

from batchpid.sim import Observation, Rollout
from batchpid.sim.cli import report
from batchpid.sim.tuning import step_response_metrics

TICKS, ENVS = 200, 5


def first_order_lag(panda, setpoint, time_constant=0.05):
    """Return a rollout in which every joint of every env moves to ``setpoint`` as a first-order lag."""
    time = 0.01 * np.arange(1, TICKS + 1)
    start = np.broadcast_to(panda.start, (ENVS, panda.dof))
    target = np.broadcast_to(setpoint, (TICKS, ENVS, panda.dof))
    qpos = target + (start - target) * np.exp(-time / time_constant)[:, None, None]
    shape = qpos.shape
    rollout = Rollout(
        time=time,
        setpoint=np.array(target),
        observation=Observation(
            qpos=qpos.astype(np.float32),
            qvel=np.zeros(shape, np.float32),
            effort=np.ones(shape, np.float32),
            saturated=np.zeros(shape, bool),
            ok=np.ones(shape[:2], bool),
            guarded=np.zeros(shape, bool),
        ),
        tick=0.01,
        info=panda.run_info(),
    )
    return rollout, np.array(start)


def rows(panda, metrics, findings=()):
    """Return the table's lines by joint name."""
    lines = report.joint_table(panda, metrics, findings).splitlines()
    return {name: next(line for line in lines if line.startswith(name)) for name in panda.joint_names}


def test_a_run_that_settles(panda):
    rollout, start = first_order_lag(panda, panda.settings.target)
    metrics = step_response_metrics(panda, rollout, start)
    # exp(-t / 0.05) falls below 2 % after 0.196 s.
    np.testing.assert_allclose(metrics.settling_time, 0.05 * np.log(50), atol=2e-3)
    table = rows(panda, metrics)
    assert all("0.20 s / 0.20 s" in row and "5 of 5" in row for row in table.values())
    said = list(report.outcome_lines(panda, rollout, metrics, rollout.findings()))
    assert said == [
        "Every joint of every env settled within 2 s to 2 % of its move.",
        "Setpoints out of limits: none.",
    ]


def test_one_joint_that_rings_and_one_that_overshoots(panda):
    rollout, start = first_order_lag(panda, panda.settings.target)
    rollout.qpos[:, 2, 0] = 1 + 0.3 * np.sin(40 * rollout.time)
    rollout.qpos[50:, :, 5] += 0.5 * np.exp(-np.arange(150) / 10)[:, None]
    metrics = step_response_metrics(panda, rollout, start)
    table = rows(panda, metrics, rollout.findings())
    assert "oscillates" in table["panda_joint1"]
    assert "0%" in table["panda_joint1"]  # the overshoot of the envs that settled
    assert "4 of 5" in table["panda_joint1"]
    assert "50% / 50%" in table["panda_joint6"]
    said = " ".join(report.outcome_lines(panda, rollout, metrics, rollout.findings()))
    assert "NOT SETTLED" in said
    assert "panda_joint1 (1)" in said
    assert "panda_joint6" not in said


def test_envs_that_diverged_are_named(panda):
    rollout, start = first_order_lag(panda, panda.settings.target)
    rollout.qpos[100:, 3] = np.nan
    rollout.ok[100:, 3] = False
    metrics = step_response_metrics(panda, rollout, start)
    table = rows(panda, metrics)
    assert all("diverged" in row and "4 of 5" in row for row in table.values())
    said = list(report.outcome_lines(panda, rollout, metrics, rollout.findings()))
    assert said[0].startswith("DIVERGED: 1 of 5 envs are no longer finite, the first after 1.01 s: env 3.")
    assert not any("settled" in line for line in said)


def test_envs_held_at_a_finite_pose_after_diverging_count_as_diverged(panda):
    rollout, start = first_order_lag(panda, panda.settings.target)
    rollout.ok[100:] = False
    metrics = step_response_metrics(panda, rollout, start)
    assert np.isinf(metrics.settling_time).all()
    assert "DIVERGED: 5 of 5" in next(report.outcome_lines(panda, rollout, metrics, rollout.findings()))


def test_setpoints_out_of_limits_say_the_worst_once(panda):
    setpoint = np.tile(panda.settings.target, (ENVS, 1))
    setpoint[:, 3] = [1.0, 0.0, -1.0, 0.5, -3.5]
    assert list(report.limit_lines(panda, setpoint)) == [
        "OUT OF LIMITS: setpoint 1 rad of panda_joint4, whose limits are [-3.0718, -0.0698]: that error remains."
    ]


def test_the_speed_is_env_steps_and_real_time_factors():
    assert report.speed_line(64, 2.0, 1 / 2000, 4.0) == (
        "64,000 env-steps/s: 2 s of 64 robots in 4.00 s; real-time factor 0.5 per robot, 32 in total"
    )
