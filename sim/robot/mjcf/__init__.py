"""MJCF files as robots (extra ``mujoco``), compiled by MuJoCo and written as the equivalent URDF."""
