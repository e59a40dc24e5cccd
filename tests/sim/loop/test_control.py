"""Controls "pid", "drive" and "effort", and changes of params in flight."""

import numpy as np

from batchpid.sim import Runner

POSE = np.array([0.3, 0.4, -0.2, -1.8, 0.5, 1.9, 0.7, 0.02, 0.02])
ARM = slice(0, 7)


def error_after(runner, seconds):
    """Return the largest error of the arm's joints at the end."""
    runner.reset(POSE)
    for _ in range(round(seconds * 100)):
        obs = runner.step(POSE)
    assert obs.ok.all()
    return np.abs(obs.qpos - POSE)[:, ARM].max()


def test_the_integral_of_the_pid_removes_the_error_of_gravity(panda):
    gains = {"kp": 400.0, "kd": 40.0, "effort_limit": None, "derivative_filter_time": 0.002}
    with Runner(
        panda, 1, workers=0, compensate="none", params=panda.params(ki=0.0, **gains)
    ) as runner:
        sag = error_after(runner, 1.5)
    with Runner(
        panda, 1, workers=0, compensate="none", params=panda.params(ki=1600.0, **gains)
    ) as runner:
        left = error_after(runner, 1.5)
    assert sag > 0.03
    assert left < 0.1 * sag


def test_the_limit_holds_for_the_effort_with_compensation_and_feedforward(panda):
    with Runner(
        panda, 1, workers=0, params=panda.params(kp=5e4, ki=0.0, kd=0.0), substeps=1
    ) as runner:
        runner.reset(POSE)
        obs = runner.step(POSE + np.r_[np.full(7, 0.3), 0, 0], feedforward=np.full(9, 5.0))
    np.testing.assert_array_equal(obs.effort[0, ARM], panda.effort_limit[ARM])
    assert obs.saturated[0, ARM].all()


def test_feedforward_is_added_to_the_effort(panda):
    with Runner(panda, 1, workers=0, control="effort", substeps=1) as runner:
        runner.reset(POSE)
        passive = runner.step(np.zeros(9)).effort.astype(float)
        runner.reset(POSE)
        pushed = runner.step(np.zeros(9), feedforward=np.arange(9.0)).effort
    np.testing.assert_allclose(pushed - passive, [np.arange(9.0)], atol=1e-4)


def test_gains_change_in_flight_without_a_bump(panda):
    """An integral that carries the load carries on when ki changes."""
    gains = {"kp": 400.0, "kd": 40.0, "effort_limit": None, "derivative_filter_time": 0.002}
    with Runner(
        panda, 1, workers=1, compensate="none", substeps=20, params=panda.params(ki=800.0, **gains)
    ) as runner:
        runner.reset(POSE)
        for _ in range(400):
            before = runner.step(POSE)
        runner.params = panda.params(ki=80.0, **gains)
        after = runner.step(POSE, substeps=1)
    assert np.abs(before.effort).max() > 5.0
    np.testing.assert_allclose(after.effort[:, ARM], before.effort[:, ARM], atol=0.05)


def test_the_feedforward_of_one_tick_does_not_act_in_the_next(panda):
    """Under control "drive", without compensation, nothing else is written to the joints."""
    params = panda.params(kp=0.0, ki=0.0, kd=0.0)
    with Runner(panda, 1, workers=0, control="drive", compensate="none", params=params) as runner:
        runner.step(panda.start, feedforward=np.full(panda.dof, 2.0))
        assert (runner.step(panda.start).effort == 0).all()
