"""The report at the end of a run: its speed, a table of the joints, and what went wrong."""

import numpy as np

from batchpid.sim import Observation, Rollout, RunInfo
from batchpid.sim.cli.rollout import RunReport, speed_line

TICKS, ENVS = 200, 5


def first_order_lag(panda, setpoint, time_constant=0.05):
    """Return a rollout in which every joint of every env moves to ``setpoint`` as a first-order
    lag.
    """
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
        info=RunInfo.of(panda),
    )
    return rollout


def report_of(panda, rollout):
    """Return the lines of the report, and those of the table by joint."""
    lines = RunReport(panda, rollout, 5e-4, 1.0, "NumPy").report().splitlines()
    return lines, {
        name: next(line for line in lines if line.startswith(name)) for name in panda.joint_names
    }


def test_a_run_that_settles(panda):
    lines, table = report_of(panda, first_order_lag(panda, panda.settings.target))
    assert all(
        "0.20 s / 0.20 s" in row for row in table.values()
    )  # exp(-t / 0.05) falls below 2 % after 0.196 s
    assert lines[-1] == "Every joint of every env settled within 2 s to 2 % of its move."


def test_one_joint_that_rings_and_one_that_overshoots(panda):
    rollout = first_order_lag(panda, panda.settings.target)
    rollout.qpos[:, 2, 0] = 1 + 0.3 * np.sin(40 * rollout.time)
    rollout.qpos[50:, :, 5] += 0.5 * np.exp(-np.arange(150) / 10)[:, None]
    lines, table = report_of(panda, rollout)
    assert "0.20 s / never" in table["panda_joint1"]
    assert "0%" in table["panda_joint1"]  # the overshoot of the envs that settled
    assert "50% / 50%" in table["panda_joint6"]
    (line,) = [line for line in lines if line.startswith("WHY")]
    assert line.startswith("WHY: joint 'panda_joint1': ")


def test_envs_that_failed_are_named_even_if_they_are_held_at_a_finite_pose(panda):
    rollout = first_order_lag(panda, panda.settings.target)
    rollout.qpos[100:, 3], rollout.ok[100:, 3] = np.nan, False
    rollout.ok[150:, 4] = False
    lines, table = report_of(panda, rollout)
    assert all("never" in row for row in table.values())
    (line,) = [line for line in lines if line.startswith("WHY")]
    assert "(env 3 and 1 more at 1.01 s)" in line
    assert not any("ettled within" in line for line in lines)


def test_the_speed_is_env_steps_and_real_time_factors():
    assert (
        speed_line(64, 2.0, 1 / 2000, 4.0)
        == "64,000 env-steps/s: 2 s of 64 robots in 4.00 s; real-time factor 0.5 per robot, 32 in"
        " total"
    )
