"""PPO of Stable-Baselines3 on a few steps of batchpid/Reach-v0, by an adapter: ``python
examples/stable_baselines.py``.

It needs ``pip install stable-baselines3``.
"""

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv


class TaskVecEnv(VecEnv):
    """A task with ``autoreset_mode="SameStep"`` as a ``VecEnv``: an env is reset within the step
    that ends its episode.

    The observation is then the first of the next episode, and the last one is
    ``infos[env]["terminal_observation"]``.
    """

    def __init__(self, envs):
        self.envs = envs.unwrapped
        self.render_mode = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self):
        seeds = None if self._seeds[0] is None else list(self._seeds)
        observation, info = self.envs.reset(seed=seeds)
        self.reset_infos = [self._of_env(info, env) for env in range(self.num_envs)]
        self._reset_seeds()
        return observation

    def step_async(self, actions):
        self.envs.step_async(actions)

    def step_wait(self):
        observation, reward, terminated, truncated, info = self.envs.step_wait()
        ends = terminated | truncated
        infos = [
            self._of_env(info["final_info"] if end else info, env) for env, end in enumerate(ends)
        ]
        for env, end in enumerate(ends):
            infos[env]["TimeLimit.truncated"] = bool(truncated[env] and not terminated[env])
            if end:
                infos[env]["terminal_observation"] = info["final_obs"][env]
        return observation, reward.astype(np.float32), ends, infos

    def close(self):
        self.envs.close()

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name, value, indices=None):
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name, *args, indices=None, **options):
        result = getattr(self.envs, method_name)(*args, **options)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False for _ in self._get_indices(indices)]

    def _of_env(self, info, env):
        entries = {
            key: rows[env].item()
            for key, rows in info.items()
            if key[0] != "_" and key[:6] != "final_"
        }
        return entries | {"is_success": entries["success"]}


if __name__ == "__main__":
    options = {"actions": "increment", "autoreset_mode": "SameStep", "workers": 0}
    envs = TaskVecEnv(
        gymnasium.make_vec("batchpid.sim.gym:batchpid/Reach-v0", num_envs=4, **options)
    )
    model = PPO("MlpPolicy", envs, n_steps=16, batch_size=64).learn(128)
    print(f"trained for {model.num_timesteps} steps")
    envs.close()
