"""Push: N robots push a box on the ground to a random place. SAPIEN alone can build the box."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Bool, Float32, Float64, Rows, SapienScene
from batchpid.checks.validate import number
from batchpid.sim.gym.robot_env import RobotEnv
from batchpid.sim.gym.tool_vector_env import FAR, ToolVectorEnv
from batchpid.sim.observation import Observation
from batchpid.sim.robot.robot import Robot

BOX = 0.03
"""Half the edge of the box [m]."""
DENSITY = 500.0
"""Density of the box [kg/m^3]: 108 g."""
AHEAD = (0.11, 0.0)
"""Place of the box at the start of an episode, from the tool in the posture along x and y [m]."""
GOAL_LOW, GOAL_HIGH = (0.04, -0.06), (0.12, 0.06)
"""Goals, from the box's first place along x and y [m]."""
NEAR_WEIGHT = 0.1
"""Cost of the tool's distance to the box in the reward [1/m], where the box's distance to its goal costs 1 [1/m]."""


class PushVectorEnv(ToolVectorEnv):
    """N robots, each with a box to push to a goal on the ground. It needs ``engine="sapien"``, the default.

    The tool moves in a horizontal plane, its fingers a little open, so that the box does not turn easily. The box is
    content of the scene (``build`` of the Runner): its pose is read by ``runner.poses()`` at every step, and is part of
    the runner's snapshots and of the replay of lost workers. A reset puts it back; its first place is the same in every
    episode.

    - *Observation*: qpos, qvel (joints), pose of the tool (7), pose of the box (7), goal of the box (2): positions
      [m] and quaternions (w, x, y, z).
    - *Action*: see :class:`batchpid.sim.gym.tool_vector_env.ToolVectorEnv`; along z the workspace has no extent.
    - *Reward*: minus the distance of the box to its goal [m], minus a tenth of the distance of the tool to the box,
      plus 1 at the goal; horizontal distances.
    - *Success*: the distance of the box to its goal is at most ``tolerance``.
    - *Info*: "success", "distance" [m], "diverged".

    Parameters
    ----------
    num_envs, robot
        As for :class:`batchpid.sim.gym.RobotVectorEnv`.
    tolerance
        Largest distance of the box to a reached goal [m].
    workspace
        Distances (3,) [m] from the center of the workspace to its sides. The center is 0.1 m ahead of the tool.
    options
        Of :class:`batchpid.sim.gym.tool_vector_env.ToolVectorEnv`, :class:`batchpid.sim.gym.RobotVectorEnv` and the
        Runner, except ``build``. Posture: the tips of the tool a few centimetres above the ground, with room ahead.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range, ``posture`` is needed, or the engine has no content.
    """

    panda_posture: ClassVar[tuple[float, ...]] = (0.0, 0.298, 0.0, -2.744, 0.0, 3.042, 0.785, 0.01, 0.01)
    """Default ``posture`` of a panda: the hand down at (0.38, 0, 0.13) m, fingertips 1.6 cm above the ground."""
    spread: ClassVar[float] = 0.0
    center_offset: ClassVar[tuple[float, float, float]] = (0.1, 0.0, 0.0)

    def __init__(
        self,
        num_envs: int = 1,
        robot: str | Robot = "panda",
        *,
        tolerance: float = 0.02,
        workspace: ArrayLike = (0.15, 0.15, 0.0),
        **options: Any,
    ) -> None:
        self.tolerance = number("tolerance", tolerance, 0.0, 1e3, "m")
        super().__init__(num_envs, robot, workspace=workspace, **options)
        self._goal = np.zeros((self.num_envs, 2))

    def runner_options(self) -> Mapping[str, Any]:
        """Return the control of the tool, the box and the ground."""
        options = super().runner_options()
        self._place = self._home[:2] + AHEAD
        return {
            **options,
            "build": partial(_build_box, tuple(self._place.tolist())),
            "ground": True,
            "collisions": True,
        }

    def task_bounds(self) -> tuple[Float64, Float64]:
        """Return the bounds of the box's pose and of the goal."""
        far, unit = np.full(3, FAR), np.ones(4)
        place = np.r_[self._place, BOX]
        low, high = self._place + GOAL_LOW, self._place + GOAL_HIGH
        return np.r_[place - far, -unit, low], np.r_[place + far, unit, high]

    def draw(self, env: int, random: np.random.Generator) -> Float64:
        """Draw a goal of the box; the robot starts in the posture."""
        self._goal[env] = self._place + random.uniform(GOAL_LOW, GOAL_HIGH)
        return super().draw(env, random)

    def observe(self, observed: Observation) -> Float64:
        """Return joints, poses of tool and box, and goal."""
        return np.concatenate([super().observe(observed), self.runner.poses()[:, 0], self._goal], axis=1)

    def success(self, observation: Float32) -> Bool:
        """Return whether the box is at its goal."""
        success: Bool = self._distance(observation) <= self.tolerance
        return success

    def reward(self, observation: Float32, success: Bool) -> Float64:
        """Return minus the distance of the box to its goal and a tenth of the tool's to the box, plus 1 at the goal."""
        tool, box = observation[:, -16:-14].astype(np.float64), observation[:, -9:-7]
        reward: Float64 = 1.0 * success - self._distance(observation) - NEAR_WEIGHT * np.hypot(*(box - tool).T)
        return reward

    def info(self, observation: Float32) -> Mapping[str, Rows]:
        """Return the distance of the box to its goal [m]."""
        return {"distance": self._distance(observation)}

    def _distance(self, observation: Float32) -> Float64:
        """Return the horizontal distance of each box to its goal (envs,) [m]."""
        distance: Float64 = np.hypot(*(self._goal - observation[:, -9:-7]).T)
        return distance


def _build_box(place: tuple[float, ...], scene: SapienScene, env: int) -> Any:
    """Build a box on the ground at ``place`` (2,) [m], as ``build`` of the Runner."""
    import sapien

    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[BOX] * 3, density=DENSITY)
    builder.add_box_visual(half_size=[BOX] * 3, material=[0.8, 0.3, 0.1])
    builder.set_initial_pose(sapien.Pose([*place, BOX]))
    return builder.build(name="box")


class PushEnv(RobotEnv):
    """One robot of :class:`PushVectorEnv`."""

    task = PushVectorEnv
