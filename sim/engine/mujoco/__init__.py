"""MuJoCo as the second physics engine; only this folder imports it for simulation."""
