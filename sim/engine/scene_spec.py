"""Description of the envs of a pack: the robot and its scene, and how each robot differs from the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.robot.parts import Joint, MjcfFile
from batchpid.sim.robot.simulated_links import Body
from batchpid.task_space.spatial_inertia import SpatialInertia, total

Build = Callable[[Any, int], Any]
"""``build(scene, env)`` adds content to the engine's scene of env ``env``; returns objects whose poses are read.

An object is an entity or the name of a link of the robot, merged links included. None: no poses.
"""


@dataclass(frozen=True)
class SceneSpec:
    """Everything that a scene is built from, picklable.

    ``urdf`` is sanitised text (see :mod:`batchpid.sim.robot.urdf`); ``ignored`` are pairs of its links that do not
    collide; ``joints`` are the degrees of freedom, in the order of all arrays. ``physics`` are the solver
    settings of ``engine``, in the engine's type. With ``merge_fixed`` each rigid body is one link
    (:mod:`batchpid.sim.robot.merging`). Without ``collisions`` scenes have no collision shapes and no ground, but the
    same masses and inertias. ``mjcf`` is the file that MuJoCo compiles in place of ``urdf``. ``contacts`` and
    ``wrenches`` are links with sensors. Specs that differ in ``build`` alone are equal.
    """

    urdf: str
    ignored: tuple[tuple[str, str], ...]
    joints: tuple[Joint, ...]
    timestep: float
    physics: Any
    dissipation: str = "urdf"
    ground: bool = True
    fixed_base: bool = True
    merge_fixed: bool = True
    collisions: bool = True
    build: Build | None = field(default=None, compare=False)
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    engine: str = "sapien"
    contacts: tuple[str, ...] | None = None
    wrenches: tuple[str, ...] | None = None
    mjcf: MjcfFile | None = None

    @property
    def is_alone(self) -> bool:
        """True if nothing moves but the joints of the robot."""
        return self.fixed_base and (self.mjcf is None or self.mjcf.is_alone)


class Variation(NamedTuple):
    """Differences of some robots from the model, one row for each; None: no difference."""

    payload: Float64 | None = None
    """Mass added at the center of mass of a link (envs,) [kg]."""
    link_mass: Float64 | None = None
    """Mass of each link relative to its mass in the URDF (envs, links); NaN for 1."""
    center_of_mass: Float64 | None = None
    """Displacement of the center of mass of each link of the URDF in the link's frame (envs, 3 links) [m]: x, y, z of
    the first link, of the second, ..."""
    friction: Float64 | None = None
    """Coulomb friction of the joints (envs, dof) [N m or N]."""
    damping: Float64 | None = None
    """Viscous damping of the joints (envs, dof) [N m s/rad or N s/m]."""
    armature: Float64 | None = None
    """Reflected inertia of the motors (envs, dof) [kg m^2 or kg]."""
    ground_friction: Float64 | None = None
    """Coefficient of sliding friction of the ground and all shapes of the robot (envs,)."""
    gravity: Float64 | None = None
    """(envs, 3) [m/s^2]"""


def varied_inertia(body: Body, variation: Variation, row: int) -> SpatialInertia:
    """Return the inertia of a body with its links as in ``row`` of ``variation``, and with the payload."""
    parts = []
    for part in body.parts:
        (mass, center, tensor), column, share = part.inertia, part.column, 1.0
        if variation.link_mass is not None and column is not None:
            share = float(np.nan_to_num(variation.link_mass[row, column], nan=1.0))
        if variation.center_of_mass is not None and column is not None:
            displacement = variation.center_of_mass[row, 3 * column : 3 * column + 3]
            center = center + part.axes @ np.nan_to_num(displacement)
        parts.append(SpatialInertia(share * mass, center, share * tensor))
    if body.payload is not None and variation.payload is not None:
        parts.append(SpatialInertia(float(variation.payload[row]), body.payload, np.zeros((3, 3))))
    return total(parts)
