"""Variations drawn at random, env by env: payloads that the robot can carry, and joint friction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import InvalidArgumentError
from sim.engine.variation import Variation
from sim.robot.kinematics import Kinematics
from sim.robot.robot import Robot

Float64 = NDArray[np.float64]
GRAVITY = 9.81
SPARE = 0.5
"""Share of what the effort limits leave beside the robot's own weight that a payload may take."""


def draw_variation(
    robot: Robot,
    envs: int,
    seed: int = 0,
    *,
    payload: float = 2.0,
    friction: float = 0.1,
    resolution: float = 2 * np.pi / 2**18,
    late: bool = True,
) -> Variation:
    """Draw payloads from 0 to ``payload`` [kg], or to what the robot carries, and friction from 0 to ``friction``.

    Raises
    ------
    InvalidArgumentError
        A negative number.
    """
    for name, value in (("payload", payload), ("friction", friction), ("resolution", resolution)):
        if not 0 <= value < np.inf:
            raise InvalidArgumentError(name, "must be finite and >= 0", value=value, remedy="use 0 for none")
    rng = np.random.default_rng(seed)
    kinematics = Kinematics(robot)
    return Variation(
        payload=rng.uniform(0, min(payload, capacity(robot)), envs),
        friction=rng.uniform(0, friction, envs),
        link=kinematics.links[kinematics.tool],
        resolution=resolution,
        late=late,
    )


def capacity(robot: Robot) -> float:
    """Payload [kg] that the robot holds in 95 % of seeded poses with half of the effort its own weight leaves."""
    kinematics, qpos = Kinematics(robot), robot.sample(200, seed=0)
    still = np.zeros_like(qpos)
    own = np.abs(robot.dynamics().inverse_dynamics(qpos, still, still))
    per_kg = np.abs(kinematics.efforts_of_force(kinematics.poses(qpos), kinematics.tool, [0.0, 0.0, GRAVITY]))
    with np.errstate(divide="ignore", invalid="ignore"):
        carried = np.where(per_kg > 1e-9, SPARE * (robot.effort_limit - own) / per_kg, np.inf)
    return float(max(np.quantile(carried.min(1), 0.05, method="lower"), 0.0))
