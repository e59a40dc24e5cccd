"""Random variations of the robots, env by env: payloads that the robot can carry, and joint friction."""

from __future__ import annotations

import numpy as np

from batchpid.validate import integer, number
from sim.engine.variation import Variation
from sim.robot.kinematics import Kinematics
from sim.robot.robot import Robot

GRAVITY = 9.81
PAYLOAD_SHARE = 0.5
"""Share that a payload may take of the effort that the robot's own weight leaves."""


def draw_variation(
    robot: Robot,
    num_envs: int,
    seed: int = 0,
    *,
    payload: float = 2.0,
    friction: float = 0.1,
    resolution: float = 2 * np.pi / 2**18,
    late: bool = True,
) -> Variation:
    """Return a variation for ``num_envs`` envs, with payload and friction drawn uniformly.

    Payloads are drawn from 0 to ``payload`` [kg], or to :func:`payload_capacity` if that is less; joint friction from 0
    to ``friction`` [N m or N]. ``resolution`` and ``late`` are those of :class:`Variation`. Raises
    InvalidArgumentError for a number out of range.
    """
    num_envs, seed = integer("num_envs", num_envs, 1, 1_000_000), integer("seed", seed, 0, 2**63 - 1)
    payload, friction = number("payload", payload, 0, np.inf, "kg"), number("friction", friction, 0, np.inf, "N m or N")
    rng, kinematics = np.random.default_rng(seed), Kinematics(robot)
    return Variation(
        payload=rng.uniform(0, min(payload, payload_capacity(robot)), num_envs),
        friction=rng.uniform(0, friction, num_envs),
        link=kinematics.links[kinematics.tool],
        resolution=number("resolution", resolution, 0, np.inf, "rad or m"),
        late=late,
    )


def payload_capacity(robot: Robot) -> float:
    """Return the payload [kg] that the robot holds in 95 % of seeded poses with half of the effort it has left."""
    kinematics, qpos = Kinematics(robot), robot.sample(200, seed=0)
    own = np.abs(robot.holding_efforts(qpos))
    per_kg = kinematics.efforts_of_force(kinematics.poses(qpos), kinematics.tool, [0.0, 0.0, GRAVITY])
    per_kg = np.abs(per_kg if robot.coupling is None else robot.coupling.efforts(per_kg))
    with np.errstate(divide="ignore", invalid="ignore"):
        carried = np.where(per_kg > 1e-9, PAYLOAD_SHARE * (robot.design_effort_limit - own) / per_kg, np.inf)
    return float(max(np.quantile(carried.min(1), 0.05, method="lower"), 0.0))
