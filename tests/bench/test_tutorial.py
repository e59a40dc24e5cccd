"""The Runner follows SAPIEN's tutorial as written: one scene, one Python object a joint,
float64.
"""

import numpy as np
from tutorial import TutorialLoop

from batchpid.sim import Robot, Runner
from batchpid.trajectories import minimum_jerk

ARM = slice(0, 7)


class SimplePIDs:
    """SimplePID of the tutorial on arrays, and the passive force."""

    def init(self, robot, num_envs, timestep):
        self.gains = robot.settings
        return tuple(np.zeros((2, num_envs, robot.dof)))

    def __call__(self, state, setpoint, qpos, qvel, passive):
        (integral, last), gains, dt = state, self.gains, 1 / self.gains.rate_hz
        error = setpoint - qpos
        integral = integral + error * dt
        effort = gains.kp * error + gains.ki * integral + gains.kd * (error - last) / dt
        return (integral, error), effort + passive


def test_runner_follows_the_tutorials_loop():
    """Along a smooth move, since the derivative of a first error would drive joints to the speeds
    that PhysX limits.
    """
    robot = Robot.load("panda", dissipation="sapien")
    settings = robot.settings
    setpoints = minimum_jerk(
        settings.start, settings.target, dt=1 / settings.rate_hz, duration=1.0
    ).position
    loop, recorded = TutorialLoop(robot, settings.start), []
    for setpoint in setpoints:
        loop.target = setpoint
        recorded.append(loop.run(1))
    unlimited = robot.params(effort_limit=None)
    options = {"engine": "sapien", "workers": 0, "substeps": 1}
    with Runner(robot, 2, control=SimplePIDs(), params=unlimited, **options) as runner:
        rollout = runner.rollout(setpoints)
    moved = np.abs(rollout.qpos[-1, 0] - settings.start)[ARM]
    assert moved.min() > 0.3, "the arm must have moved for the comparison to mean anything"
    difference = np.abs(rollout.qpos[:, 0] - np.array(recorded))[:, ARM]
    assert difference.max() < 0.01  # PhysX damps each link, and the Runner merges some


def test_internal_drive_follows_the_tutorials_internal_drive():
    robot = Robot.load("panda", dissipation="sapien")
    target = robot.settings.target
    expected = TutorialLoop(robot, target, external_pid=False, internal_drive=True).run(1000)
    with Runner(robot, 1, engine="sapien", control="drive", workers=0, substeps=1000) as runner:
        obs = runner.step(target)
    np.testing.assert_allclose(obs.qpos[0, ARM], expected[ARM], atol=2e-3)
    assert np.abs(obs.qpos[0] - robot.start)[ARM].min() > 0.2
