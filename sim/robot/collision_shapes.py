"""Collision shapes of a robot's links, read from its URDF: plain values for engines, distances and
masses.

A mesh counts as its convex hull, in both engines.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from lxml import etree

from batchpid.arrays.array_types import Float64, MjModel
from batchpid.arrays.digest import digest
from batchpid.arrays.read_only import read_only
from batchpid.errors import RobotError
from batchpid.sim.robot.link_repair import DENSITY
from batchpid.sim.robot.merging import Separate, place_links
from batchpid.sim.robot.meshes import note_meshes, read_mesh
from batchpid.sim.robot.xml import number, numbers
from batchpid.task_space.rotations import from_rpy, multiply, rotate
from batchpid.task_space.spatial_inertia import SpatialInertia

ALONG_Z = np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])
"""Rotation (w, x, y, z) from a shape along x to a shape along z, as the capsules and cylinders of a
URDF are.
"""
ALONG_X = np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])
"""Rotation from a shape along z, as MuJoCo's capsules and cylinders are, to a shape along x."""


class LinkShape(NamedTuple):
    """Convex shape of a link."""

    kind: Literal["sphere", "box", "capsule", "cylinder", "hull"]
    """Capsules and cylinders lie along x."""
    size: tuple[float, ...]
    """Radius; half lengths of a box's sides; or radius and half length, without the ends of a
    capsule [m].
    """
    vertices: Float64 | None
    """Vertices of a convex hull (n, 3) [m]."""
    position: Float64
    """Place of the shape in the link (3,) [m]."""
    wxyz: Float64
    """Orientation of the shape in the link (4,)."""
    owner: str
    """Link of the URDF that the shape belongs to."""

    @property
    def half_extents(self) -> tuple[Float64, Float64]:
        """Center (3,) and half size (3,) [m] of the box around the shape, in the frame of the
        shape.
        """
        if self.vertices is not None:
            low, high = self.vertices.min(0), self.vertices.max(0)
            return (high + low) / 2, (high - low) / 2
        if self.kind == "box":
            return np.zeros(3), np.array(self.size)
        radius, length = self.size[0], self.size[1] if len(self.size) > 1 else 0.0
        return np.zeros(3), np.array(
            [length + (0.0 if self.kind == "cylinder" else radius), radius, radius]
        )


@lru_cache(maxsize=16)
def own_shapes(urdf: str) -> dict[str, list[LinkShape]]:
    """Return the shapes of every link of a sanitised URDF, by name; an empty list without shapes.

    Raises RobotError for a mesh that cannot be read.
    """
    links = etree.fromstring(urdf.encode(), etree.XMLParser(huge_tree=True)).findall("link")
    named = [(link.get("name", ""), link) for link in links]
    return {
        name: [_read(element, name) for element in link.findall("collision")]
        for name, link in named
    }


@lru_cache(maxsize=16)
def link_shapes(urdf: str, separate: Separate = ()) -> dict[str, list[LinkShape]]:
    """Return the shapes of every simulated link of a sanitised URDF, by name; an empty list without
    shapes.
    """
    placements = place_links(urdf, separate)
    shapes: dict[str, list[LinkShape]] = {at.link: [] for at in placements.values()}
    for name, of_link in own_shapes(urdf).items():
        at = placements[name]
        for shape in of_link:
            place = at.position + rotate(at.wxyz, shape.position)
            shapes[at.link].append(
                shape._replace(position=place, wxyz=multiply(at.wxyz, shape.wxyz))
            )
    return shapes


def _read(element: etree._Element, link: str) -> LinkShape:
    """Return the shape of a ``<collision>``, in the frame of its link."""
    where = f"link {link!r}"
    origin = element.find("origin")
    shape = element.find("geometry/*")
    position = np.array(numbers(origin, "xyz", "0 0 0", where))
    wxyz = from_rpy(numbers(origin, "rpy", "0 0 0", where))
    if shape.tag == "box":
        return LinkShape(
            "box",
            tuple(0.5 * side for side in numbers(shape, "size", "0 0 0", where)),
            None,
            position,
            wxyz,
            link,
        )
    if shape.tag == "sphere":
        return LinkShape(
            "sphere", (number(shape, "radius", "0", where),), None, position, wxyz, link
        )
    if shape.tag in ("capsule", "cylinder"):
        size = number(shape, "radius", "0", where), 0.5 * number(shape, "length", "0", where)
        return LinkShape(shape.tag, size, None, position, multiply(wxyz, ALONG_Z), link)
    scale = np.array(numbers(shape, "scale", "1 1 1", where))
    return LinkShape(
        "hull",
        (),
        read_only(mesh_vertices(shape.get("filename", "")) * scale),
        position,
        wxyz,
        link,
    )


@lru_cache(maxsize=256)
def mesh_vertices(filename: str) -> Float64:
    """Return the vertices (n, 3) of the convex hull of a mesh file, unscaled [m]. Raises
    RobotError.
    """
    import mujoco

    note_meshes([filename])
    try:
        rows = np.ascontiguousarray(read_mesh(filename).vertices, float) + 0.0  # no -0.0
        vertices = np.unique(rows.view("V24")).view(
            float
        )  # by their bytes, which is much faster than along an axis
        spec = mujoco.MjSpec()
        spec.add_mesh(
            name="mesh", uservert=vertices, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        )
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
        model = spec.compile()
    except Exception as error:
        raise RobotError(
            f"{filename}: cannot be read: {error}; repair the file, or remove that <collision>"
        ) from error
    graph = model.mesh_graph[model.mesh_graphadr[0] :]
    count = int(graph[0])
    return read_only(vertices_in_file(model, graph[2 + count : 2 + 2 * count]))


def vertices_in_file(model: MjModel, indices: Any) -> Float64:
    """Return vertices of the only mesh of a model in the frame of its file; MuJoCo's are in
    principal axes.
    """
    import mujoco

    turned, place = np.zeros(9), model.mesh_pos[0]
    mujoco.mju_quat2Mat(turned, model.mesh_quat[0])
    return model.mesh_vert[indices].astype(float) @ turned.reshape(3, 3).T + place


def inertia_of(shapes: Sequence[LinkShape]) -> SpatialInertia:
    """Return the sum of the inertias of shapes of DENSITY, in the frame of their link, by MuJoCo's
    compiler.
    """
    import mujoco

    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    for shape in shapes:
        add_geom(spec, body, shape, density=DENSITY)
    model = spec.compile()
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[1])
    turn = axes.reshape(3, 3)
    return SpatialInertia(
        float(model.body_mass[1]), model.body_ipos[1].copy(), turn * model.body_inertia[1] @ turn.T
    )


def add_geom(spec: Any, body: Any, shape: LinkShape, **options: Any) -> None:
    """Add a shape to a body of a ``mujoco.MjSpec``; equal hulls share a mesh."""
    import mujoco

    wxyz, kind = (
        shape.wxyz,
        getattr(mujoco.mjtGeom, f"mjGEOM_{'MESH' if shape.kind == 'hull' else shape.kind.upper()}"),
    )
    if shape.vertices is None:
        options["size"] = np.pad(shape.size, (0, 3 - len(shape.size)))
    else:
        options["meshname"] = name = f"hull {digest(shape.vertices)}"
        if spec.mesh(name) is None:
            inertia = mujoco.mjtMeshInertia
            kind_of_inertia = (
                inertia.mjMESH_INERTIA_CONVEX
                if "density" in options
                else inertia.mjMESH_INERTIA_SHELL
            )
            spec.add_mesh(name=name, uservert=shape.vertices.ravel(), inertia=kind_of_inertia)
    if shape.kind in ("capsule", "cylinder"):
        wxyz = multiply(wxyz, ALONG_X)
    body.add_geom(type=kind, pos=shape.position, quat=wxyz, **options)
