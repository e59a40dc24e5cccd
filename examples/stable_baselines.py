"""PPO of Stable-Baselines3 on a few steps of batchpid/Reach-v0: ``python
examples/stable_baselines.py``.

It needs the extra ``sb3``; install PyTorch for the CPU before.
"""

import gymnasium
from stable_baselines3 import PPO

from batchpid.sim.gym import SB3VecEnv

if __name__ == "__main__":
    options = {"actions": "increment", "autoreset_mode": "Disabled", "workers": 0}
    envs = SB3VecEnv(
        gymnasium.make_vec("batchpid.sim.gym:batchpid/Reach-v0", num_envs=4, **options)
    )
    model = PPO("MlpPolicy", envs, n_steps=16, batch_size=64).learn(128)
    print(f"trained for {model.num_timesteps} steps")
    envs.close()
