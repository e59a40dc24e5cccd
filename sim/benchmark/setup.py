"""One comparison: robot, number of envs, and the motion that every case makes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim.engine.building import SceneSpec
from sim.engine.physics import PHYSICS
from sim.robot.robot import Robot

Float64 = NDArray[np.float64]
DISTANCE = 0.3
"""How far the arm starts from its target [rad]."""


@dataclass(frozen=True)
class Setup:
    """One comparison: which robot, how many, on how many processes, for how long."""

    robot: Robot
    num_envs: int = 64
    workers: int = 2
    physics: str = "accurate"
    substeps: int = 20
    ticks: int = 100
    rounds: int = 5

    @property
    def target(self) -> Float64:
        """Where every case moves to (dof,) [rad or m]."""
        assert self.robot.settings is not None
        return self.robot.settings.target

    @property
    def start(self) -> Float64:
        """Where every case starts (dof,): ``DISTANCE`` short of the target on the joints that have the room."""
        away = self.target - DISTANCE
        roomy = (self.robot.upper - self.robot.lower > 1.0) & (away > self.robot.lower)
        return np.where(roomy, away, self.target)

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Joints that have a way to go (dof,)."""
        return self.start != self.target

    def scene(self, gravity: bool) -> SceneSpec:
        """Scene of every case; without gravity a drive needs no compensation to reach the same place."""
        robot = self.robot
        spec = SceneSpec(
            urdf=robot.urdf,
            srdf=robot.srdf,
            joints=robot.joints,
            timestep=1 / 2000,
            physics=PHYSICS[self.physics],
            dissipation="sapien",
        )
        return spec if gravity else replace(spec, gravity=(0.0, 0.0, 0.0))
