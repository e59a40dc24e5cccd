"""Gymnasium environments: :class:`RobotVectorEnv`, the base class of tasks of N robots, and the
task Reach.

``import batchpid.sim.gym`` registers ``batchpid/Reach-v0`` for
``gymnasium.make_vec("batchpid/Reach-v0", num_envs=64)``;
``make_vec("batchpid.sim.gym:batchpid/Reach-v0", ...)`` does both. Arrays are NumPy's, new at every
step: ``jax.dlpack.from_dlpack`` and ``torch.from_dlpack`` take them without a copy.
"""

from typing import TYPE_CHECKING, Any

from batchpid.errors import MissingDependencyError

try:
    import gymnasium
except ImportError:
    raise MissingDependencyError("gymnasium", "batchpid.sim.gym", "gym") from None

from batchpid.sim.gym.reach import ReachEnv, ReachVectorEnv
from batchpid.sim.gym.robot_env import RobotEnv
from batchpid.sim.gym.robot_vector_env import RobotVectorEnv

if TYPE_CHECKING:
    from batchpid.sim.gym.stable_baselines import SB3VecEnv as SB3VecEnv

__all__ = ["ReachEnv", "ReachVectorEnv", "RobotEnv", "RobotVectorEnv"]


def __getattr__(name: str) -> Any:
    # Stable-Baselines3 imports PyTorch, which takes seconds.
    if name == "SB3VecEnv":
        from batchpid.sim.gym.stable_baselines import SB3VecEnv as SB3VecEnv

        return SB3VecEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


gymnasium.register(
    "batchpid/Reach-v0",
    ReachEnv,
    max_episode_steps=250,
    vector_entry_point=ReachVectorEnv,
)
