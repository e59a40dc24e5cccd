"""Gains per unit of inertia on real robots."""

import numpy as np
import pytest
from robots import load_bundled

from batchpid.metrics import step_metrics
from batchpid.sim import Runner

OMEGA = 9.0


def acceleration_params(robot, units, **options):
    return robot.params(
        kp=3 * OMEGA**2,
        ki=OMEGA**3,
        kd=3 * OMEGA,
        setpoint_weight=0.1,
        derivative_filter_time=1e-3,
        gain_units=units,
        **options,
    )


@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_one_set_of_gains_settles_every_arm_joint_of_every_robot(name):
    robot = load_bundled(name)
    with Runner(
        robot, 1, params=acceleration_params(robot, "mass_matrix"), workers=0, substeps=10
    ) as runner:
        runner.reset(robot.settings.start)
        rollout = runner.rollout(np.broadcast_to(robot.settings.target, (400, robot.dof)))
    m = step_metrics(rollout.tick, robot.settings.target, rollout.qpos, start=robot.settings.start)
    arm = slice(0, 7)
    assert (m.settling_time[0, arm] < 1.0).all()
    assert (np.nan_to_num(m.overshoot[0, arm]) < 0.01).all()
    assert (m.steady_state_error[0, arm] < 1e-3).all()


@pytest.mark.parametrize("substeps", [5, 20])
def test_a_fast_arm_stays_on_its_line_where_its_axes_are_nearly_in_line(substeps, jaco2):
    """Near upright jaco2's mass matrix changes fast: matrices that are ahead on average put it 18
    mrad off.
    """
    robot = jaco2
    start = robot.settings.start + np.array(
        [0.28, -0.29, 0.22, 0.29, 0.27, -0.21, 0.28, 0.23, 0.19, 0, 0, 0.18, 0.25]
    )
    move = robot.settings.target - start
    with Runner(robot, 1, params=robot.designed(), workers=0, substeps=substeps) as runner:
        runner.reset(start)
        rollout = runner.rollout(
            np.broadcast_to(robot.settings.target, (1200 // substeps, robot.dof))
        )
    gone = rollout.qpos[:, 0] - start
    along = gone @ move / (move @ move)
    assert along[-1] > 0.8
    assert np.abs(gone - along[:, None] * move)[:, :7].max() < 2e-3
