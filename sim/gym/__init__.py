"""Gymnasium environments: tasks of N robots, whose base class :class:`RobotVectorEnv` has hooks for others.

``import batchpid.sim.gym`` registers ``batchpid/Reach-v0``, ``batchpid/ToolReach-v0``, ``batchpid/Push-v0`` and
``batchpid/Walk-v0`` for ``gymnasium.make_vec("batchpid/Reach-v0", num_envs=64)``;
``make_vec("batchpid.sim.gym:batchpid/Reach-v0", ...)`` does both. Arrays are NumPy's, new at every step:
``jax.dlpack.from_dlpack`` and ``torch.from_dlpack`` take them without a copy.
"""

from batchpid.errors import MissingDependencyError

try:
    import gymnasium
except ImportError:
    raise MissingDependencyError("gymnasium", "batchpid.sim.gym", "gym") from None

from batchpid.sim.gym.push import PushEnv, PushVectorEnv
from batchpid.sim.gym.reach import ReachEnv, ReachVectorEnv
from batchpid.sim.gym.robot_env import RobotEnv
from batchpid.sim.gym.robot_vector_env import RobotVectorEnv
from batchpid.sim.gym.tool_vector_env import ToolReachEnv, ToolReachVectorEnv
from batchpid.sim.gym.walk import WalkEnv, WalkVectorEnv

__all__ = [
    "PushEnv",
    "PushVectorEnv",
    "ReachEnv",
    "ReachVectorEnv",
    "RobotEnv",
    "RobotVectorEnv",
    "ToolReachEnv",
    "ToolReachVectorEnv",
    "WalkEnv",
    "WalkVectorEnv",
]

for _task in ("Reach", "ToolReach", "Push", "Walk"):
    gymnasium.register(
        f"batchpid/{_task}-v0",
        f"batchpid.sim.gym:{_task}Env",
        max_episode_steps=250,
        vector_entry_point=f"batchpid.sim.gym:{_task}VectorEnv",
    )
