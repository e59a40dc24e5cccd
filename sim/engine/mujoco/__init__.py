"""MuJoCo as the second physics engine ; only this room imports it for simulation."""
