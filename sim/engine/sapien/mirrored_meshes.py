"""Articulations with mirrored collision meshes, which PhysX cannot hold.

A URDF mirrors a mesh by a negative scale. PhysX requires positive scales of convex meshes, SAPIEN passes on any scale,
and the process ends with a segmentation fault once two such shapes touch. The mirrored vertices make a sound mesh.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sapien.physx import PhysxCollisionShapeConvexMesh, get_default_material
from sapien.wrapper.actor_builder import CollisionShapeRecord, preprocess_mesh_file
from sapien.wrapper.articulation_builder import ArticulationBuilder, LinkBuilder


class MirroringBuilder(ArticulationBuilder):
    """Articulation builder whose links build meshes of negative scale from mirrored vertices."""

    def create_link_builder(self, parent: LinkBuilder | None = None) -> LinkBuilder:
        """Return a builder of a link below ``parent``."""
        builder = _LinkBuilder(len(self.link_builders), parent)
        self.link_builders.append(builder)
        return builder


class _LinkBuilder(LinkBuilder):
    collision_records: list[CollisionShapeRecord]

    def build_physx_component(self, link_parent: Any = None) -> Any:
        records = self.collision_records
        self.collision_records = [record for record in records if min(record.scale) > 0]
        try:
            link = super().build_physx_component(link_parent)
        finally:
            self.collision_records = records
        for record in records:
            if min(record.scale) < 0:
                _attach(link, record, self.collision_groups)
        return link


def _attach(link: Any, record: CollisionShapeRecord, groups: list[int]) -> None:
    try:
        hull = _hull(record.filename)
    except RuntimeError:  # a mesh that SAPIEN cannot read: a shape less than asked for, which build_scene reports
        return
    scale = np.abs(record.scale)
    shape = PhysxCollisionShapeConvexMesh(hull * np.sign(record.scale).astype(np.float32), scale, record.material)
    shape.local_pose = record.pose
    shape.set_collision_groups(groups)
    shape.set_density(record.density)
    shape.set_patch_radius(record.patch_radius)
    shape.set_min_patch_radius(record.min_patch_radius)
    link.attach(shape)


@lru_cache(maxsize=256)
def _hull(filename: str) -> NDArray[np.float32]:
    """Return the vertices (n, 3) of the convex hull of a mesh file, unscaled; SAPIEN, too, reads a file only once."""
    shape = PhysxCollisionShapeConvexMesh(preprocess_mesh_file(filename), (1, 1, 1), get_default_material())
    vertices = np.array(shape.vertices)
    vertices.setflags(write=False)
    return vertices
