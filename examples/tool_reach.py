"""Task of Gymnasium: N pandas reach places with the hand, by operational-space control.

    python examples/tool_reach.py

moves each hand to its goal.
"""

import numpy as np
from gymnasium import spaces

from batchpid.sim import OperationalSpace, Robot
from batchpid.sim.gym import RobotVectorEnv


class ToolReachVectorEnv(RobotVectorEnv):
    """N pandas, each with a place to reach. An action in [-1, 1] is the place of the hand in a box,
    the workspace.

    - Observation: qpos, qvel, position of the hand (3), goal (3) [m]. The hand keeps its
      orientation.
    - Reward: minus the distance to the goal [m], plus 1 at the goal, that is within ``tolerance``
      [m].
    - Info: "distance" [m].
    """

    posture = (
        0.0,
        -0.255,
        0.0,
        -2.437,
        0.0,
        2.182,
        0.786,
        0.02,
        0.02,
    )  # the hand down, at (0.45, 0, 0.4) m
    ahead = (0.0, 0.0, 0.0)  # center of the workspace, from the hand in the posture [m]
    workspace = (0.15, 0.15, 0.15)  # from the center to the sides [m]

    def __init__(self, num_envs=1, *, tolerance=0.01, **options):
        self.tolerance = tolerance
        self.goal = np.zeros((num_envs, 3))
        robot = Robot.load("panda")
        control = OperationalSpace(robot, "panda_hand", posture=self.posture, stiffness=400.0)
        self.home = np.array(control.command.neutral)
        self.center = self.home[:3] + self.ahead
        super().__init__(num_envs, robot, control=control, **options)

    def spaces(self):
        return spaces.Box(-100.0, 100.0, (2 * self.robot.dof + 6,)), spaces.Box(
            -1.0, 1.0, (3,), np.float32
        )

    def draw(self, env, random):
        self.goal[env] = self.center + self.workspace * random.uniform(-1.0, 1.0, 3)
        start = self.posture + random.uniform(-0.05, 0.05, self.robot.dof)
        return np.clip(start, self.robot.lower, self.robot.upper)

    def command(self, action, setpoint):
        place = self.center + action * self.workspace
        return np.concatenate([place, np.tile(self.home[3:], (len(place), 1))], axis=1)

    def observe(self, observed):
        return np.concatenate(
            [observed.qpos, observed.qvel, observed.tool_pose[:, :3], self.goal], axis=1
        )

    def success(self, observation):
        return self.distance(observation) <= self.tolerance

    def reward(self, observation, success):
        return 1.0 * success - self.distance(observation)

    def info(self, observation):
        return {"distance": self.distance(observation)}

    def distance(self, observation):
        return np.linalg.norm(observation[:, -6:-3] - self.goal, axis=1)


if __name__ == "__main__":
    envs = ToolReachVectorEnv(4, engine="mujoco", workers=0)
    envs.reset(seed=0)
    action = (envs.goal - envs.center) / envs.workspace
    for _ in range(50):
        *_, info = envs.step(action)
    print(
        f"{info['success'].sum()} of 4 hands are at their goals, within"
        f" {1e3 * info['distance'].max():.1f} mm"
    )
    envs.close()
