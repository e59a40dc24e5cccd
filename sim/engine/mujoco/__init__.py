"""MuJoCo as the second physics engine (extra ``mujoco``); only this room imports it for simulation."""
