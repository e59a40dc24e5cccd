"""Task of Gymnasium: N pandas push a box on the ground to a random place. SAPIEN builds the box, as
user content.

    python examples/push.py

pushes each box straight ahead.
"""

import numpy as np
from gymnasium import spaces
from tool_reach import ToolReachVectorEnv

BOX = 0.03  # half the edge of the box [m]
PLACE = np.array([0.49, 0.0])  # of the box at the start of an episode [m]


def build_box(scene, env):
    """Build a box of 108 g on the ground, as ``build`` of the Runner."""
    import sapien

    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[BOX] * 3, density=500.0)
    builder.set_initial_pose(sapien.Pose([*PLACE, BOX]))
    return builder.build(name="box")


class PushVectorEnv(ToolReachVectorEnv):
    """N pandas, each with a box to push to a goal on the ground. The hand moves in a horizontal
    plane.

    - Observation: qpos, qvel, position of the hand (3), pose of the box (7), goal of the box (2)
      [m].
    - Reward: minus the distance of the box to its goal, minus a tenth of that of the hand to the
      box [m], plus 1 at the goal.
    """

    posture = (
        0.0,
        0.298,
        0.0,
        -2.744,
        0.0,
        3.042,
        0.785,
        0.01,
        0.01,
    )  # fingertips 1.6 cm above the ground
    ahead = (0.1, 0.0, 0.0)
    workspace = (0.15, 0.15, 0.0)

    def __init__(self, num_envs=1, *, tolerance=0.02, **options):
        scene = {"engine": "sapien", "build": build_box, "ground": True}
        super().__init__(num_envs, tolerance=tolerance, **scene, **options)
        self.goal = np.zeros((num_envs, 2))

    def spaces(self):
        return spaces.Box(-100.0, 100.0, (2 * self.robot.dof + 12,)), super().spaces()[1]

    def draw(self, env, random):
        self.goal[env] = PLACE + random.uniform((0.04, -0.06), (0.12, 0.06))
        return np.array(self.posture)

    def observe(self, observed):
        boxes = self.runner.poses()[:, 0]
        return np.concatenate(
            [observed.qpos, observed.qvel, observed.tool_pose[:, :3], boxes, self.goal], axis=1
        )

    def reward(self, observation, success):
        to_box = np.linalg.norm(observation[:, -12:-10] - observation[:, -9:-7], axis=1)
        return super().reward(observation, success) - 0.1 * to_box

    def distance(self, observation):
        return np.linalg.norm(observation[:, -9:-7] - self.goal, axis=1)


if __name__ == "__main__":
    envs = PushVectorEnv(2, workers=0)
    observation, _ = envs.reset(seed=0)
    first = observation[:, -9]
    for ahead in np.linspace(-0.6, 0.3, 40):
        observation, *_ = envs.step([[ahead, 0.0, 0.0]] * 2)
    print(f"the boxes moved ahead by {np.round(observation[:, -9] - first, 3)} m")
    envs.close()
