"""Task of Gymnasium: N quadrupeds on the ground follow a commanded velocity. ``train_walk.py``
trains a policy for it.

    python examples/walk.py

trots without a policy, at the command.
"""

import numpy as np
from gymnasium import spaces

from batchpid.sim import Robot
from batchpid.sim.gym import RobotVectorEnv
from batchpid.task_space.frames import inverse, matrix_of, rotate

# Gait of the bundled quadruped [rad]: lift of the first and of the second pair of legs in the
# middle of their swing, and stride at 1 m/s at the start of a period. Feet rise by 6 cm.
FIRST = np.array([0, 0, 0, 0, 0.2, 0, 0, 0.2, -0.4, 0, 0, -0.4])
SECOND = np.array([0, 0, 0, 0, 0, 0.2, 0.2, 0, 0, -0.4, -0.4, 0])
STRIDE = np.array([0, 0, 0, 0, 0.385, -0.385, -0.385, 0.385, 0, 0, 0, 0])
PERIOD = 0.4  # time in which every leg makes a step [s]
SCALE = 0.3  # offset of a setpoint from the gait at an action of 1 [rad]
LOWEST = 0.15  # height of the trunk below which the robot has fallen [m]
MAX_SPEED = 100.0  # bound of observed speeds [rad/s or m/s]


class WalkVectorEnv(RobotVectorEnv):
    """N quadrupeds, each with a velocity to follow: forward, to the left [m/s], and about the
    vertical axis [rad/s].

    The joint setpoint is the sum of the start pose, a gait that depends on a clock, and SCALE times
    the action, in [-1, 1] (A. Iscen et al., "Policies modulating trajectory generators", CoRL
    2018). The gait is a trot that lifts two legs at a time, and swings all hips in proportion to
    the command. An episode draws a command between the rows of ``commands`` (2, 3), and begins at a
    random phase.

    - Observation: velocity, angular velocity, and the vertical, (3) each, in the axes of the trunk;
      command (3); joint positions relative to the start pose, joint velocities and last action,
      (dof) each; sine and cosine of the clock.
    - Reward: exp(-error^2 / 0.1) for the horizontal velocity and 0.5 exp(-error^2 / 0.25) for the
      turn, minus v_z^2, 0.02 (roll rate^2 + pitch rate^2), 2 sin^2 of the tilt, 1e-4 effort^2, and
      0.01 (change of the action)^2.
    - Terminated: the robot fell: its trunk is lower than LOWEST, or tilted by 60 degrees; or it
      diverged.
    - Info: "speed" (forward [m/s]), "distance" (from the start along x [m]).
    """

    def __init__(self, num_envs=1, *, commands=((0.0, 0.0, -0.5), (1.0, 0.0, 0.5)), **options):
        robot = Robot.load("quadruped", fixed_base=False)
        self.commands = np.array(commands)
        self._clock, self._command = np.zeros(num_envs), np.zeros((num_envs, 3))
        super().__init__(
            num_envs, robot, params=robot.params(), compensate="none", ground=True, **options
        )

    def spaces(self):
        dof = self.robot.dof
        high = np.repeat([MAX_SPEED, 1.0, MAX_SPEED, 1.0], [6, 3, 3 + 2 * dof, dof + 2]).astype(
            np.float32
        )
        return spaces.Box(-high, high), spaces.Box(-1.0, 1.0, (dof,), np.float32)

    def draw(self, env, random):
        self._command[env] = random.uniform(*self.commands)
        self._clock[env] = random.uniform()
        self.action[env] = 0.0
        start = self.robot.start + random.uniform(-0.1, 0.1, self.robot.dof)
        return np.clip(start, self.robot.lower, self.robot.upper)

    def command(self, action, setpoint):
        self._change = action - self.action
        self._clock = (self._clock + self.step_seconds / PERIOD) % 1.0
        angle = 2 * np.pi * self._clock[:, None]
        gait = np.maximum(np.sin(angle), 0.0) * FIRST + np.maximum(-np.sin(angle), 0.0) * SECOND
        gait += np.cos(angle) * self._command[:, :1] * STRIDE
        return np.clip(self.robot.start + gait + SCALE * action, self.robot.lower, self.robot.upper)

    def observe(self, observed):
        pose, twist = observed.base_pose.astype(float), observed.base_twist.astype(float)
        turn = inverse(pose[:, 3:])  # from the world's axes to the trunk's
        trunk = [
            rotate(matrix_of(turn), vector)
            for vector in (twist[:, :3], twist[:, 3:], np.array([0.0, 0.0, 1.0]))
        ]
        angle = 2 * np.pi * self._clock[:, None]
        joints = [observed.qpos - self.robot.start, observed.qvel, self.action]
        return np.concatenate(
            [*trunk, self._command, *joints, np.sin(angle), np.cos(angle)], axis=1
        )

    def reward(self, observation, success):
        velocity, rate, upright, command = np.split(observation[:, :12].astype(float), 4, axis=1)
        error, turn = (
            ((command[:, :2] - velocity[:, :2]) ** 2).sum(1),
            (command[:, 2] - rate[:, 2]) ** 2,
        )
        costs = (
            velocity[:, 2] ** 2
            + 0.02 * (rate[:, :2] ** 2).sum(1)
            + 2.0 * (upright[:, :2] ** 2).sum(1)
        )
        costs += 1e-4 * (self.observed.effort.astype(float) ** 2).sum(1) + 0.01 * (
            self._change**2
        ).sum(1)
        return np.exp(-error / 0.1) + 0.5 * np.exp(-turn / 0.25) - costs

    def terminated(self, observation, success):
        return (self.observed.base_pose[:, 2] < LOWEST) | (observation[:, 8] < 0.5)

    def info(self, observation):
        return {"speed": observation[:, 0], "distance": self.observed.base_pose[:, 0]}


if __name__ == "__main__":
    envs = WalkVectorEnv(
        4, commands=[[0.5, 0.0, 0.0]] * 2, engine="mujoco", physics="fast", timestep=1 / 500
    )
    envs.reset(seed=0)
    fell = np.zeros(4, bool)
    for _ in range(100):
        *_, terminated, _, info = envs.step(np.zeros((4, 12)))
        fell |= terminated
    print(f"{fell.sum()} of 4 fell; in 2 s they walked {np.round(info['distance'], 2)} m")
    envs.close()
