"""Collision shapes of a robot's links as plain values, for other engines and for files."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from sapien import physx

from batchpid.arrays.array_types import Float64
from batchpid.sim.engine.sapien.building import parse, shape_owners
from batchpid.sim.engine.scene_spec import SceneSpec

_KINDS: dict[type, Literal["sphere", "box", "capsule", "cylinder"]] = {
    physx.PhysxCollisionShapeSphere: "sphere",
    physx.PhysxCollisionShapeBox: "box",
    physx.PhysxCollisionShapeCapsule: "capsule",
    physx.PhysxCollisionShapeCylinder: "cylinder",
}


class LinkShape(NamedTuple):
    """Convex shape of a simulated link."""

    kind: Literal["sphere", "box", "capsule", "cylinder", "hull"]
    """Capsules and cylinders lie along x."""
    size: tuple[float, ...]
    """Radius, half lengths of the sides, or radius and half length (without the ends of a capsule) [m]."""
    vertices: Float64 | None
    """Vertices of a convex hull (n, 3) [m]."""
    position: Float64
    """Place of the shape in the link (3,) [m]."""
    wxyz: Float64
    """Orientation there (4,)."""
    owner: str
    """Link of the URDF that the shape belongs to."""


def link_shapes(spec: SceneSpec) -> dict[str, list[LinkShape]]:
    """Return the shapes that SAPIEN builds for each simulated link, as :func:`.building.build_scene` has them.

    Raises RobotError if SAPIEN's loader refuses the description.
    """
    owners = shape_owners(spec)
    shapes: dict[str, list[LinkShape]] = {}
    for link in parse(spec).link_builders:
        built = link.build_physx_component().collision_shapes if link.collision_records else []
        shapes[link.name] = [_plain(shape, owner) for shape, owner in zip(built, owners[link.name], strict=True)]
    return shapes


def _plain(shape: Any, owner: str) -> LinkShape:
    at = shape.local_pose
    place = np.asarray(at.p, float), np.asarray(at.q, float), owner
    if (kind := _KINDS.get(type(shape))) is None:
        return LinkShape("hull", (), np.asarray(shape.vertices, float) * np.asarray(shape.scale, float), *place)
    if kind == "box":
        return LinkShape(kind, tuple(np.asarray(shape.half_size, float).tolist()), None, *place)
    size = (shape.radius,) if kind == "sphere" else (shape.radius, shape.half_length)
    return LinkShape(kind, size, None, *place)
