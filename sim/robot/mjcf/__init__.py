"""MJCF files as robots, compiled by MuJoCo and written as the equivalent URDF."""
