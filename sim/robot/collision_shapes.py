"""Collision shapes as plain values for engines, distances and masses.

A mesh counts as its convex hull, in both engines.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64, MjModel, MjsBody, MjSpec, Rows
from batchpid.arrays.digest import digest
from batchpid.arrays.elementwise import read_only
from batchpid.errors import RobotError
from batchpid.io.files import write_atomically
from batchpid.sim.robot.inertia import DENSITY
from batchpid.sim.robot.meshes import mesh_bytes, read_mesh
from batchpid.sim.robot.tables import Shape
from batchpid.task_space.frames import SpatialInertia


def hull(shape: Shape) -> Float64:
    """Return the vertices of the convex hull of a mesh (n, 3) [m], in the frame of the shape.

    Raises RobotError for a file that cannot be read.
    """
    if shape.vertices is not None:
        return shape.vertices
    return read_only(mesh_vertices(shape.file, shape.content) * shape.scale)


def mesh_file(shape: Shape) -> str:
    """Return the path of a mesh file: the shape's, else that of its hull.

    The hull is written to ``batchpid/meshes`` in the user's cache folder, named by its content.
    Raises RobotError if it cannot be written.
    """
    if shape.vertices is None:
        return shape.file
    vertices, faces = convex_hull(shape.vertices)
    lines = ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in vertices.tolist()]
    lines += ["f {} {} {}".format(*face) for face in (faces + 1).tolist()]
    content = ("\n".join(lines) + "\n").encode()
    # SAPIEN reads meshes from files alone, so a hull becomes one.
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    path = Path(cache, "batchpid", "meshes", f"{digest(content)[:32]}.obj")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Another process may have written the same hull.
        if not path.is_file() or path.read_bytes() != content:
            write_atomically(path, content)
    except OSError as error:
        problem = f"{path}: cannot be written: {error.strerror}"
        raise RobotError(
            f"{problem}; set XDG_CACHE_HOME to a folder for the hulls of meshes"
        ) from error
    return str(path)


def half_extents(shape: Shape) -> tuple[Float64, Float64]:
    """Return center (3,) and half size (3,) [m] of the box around a shape, in its frame."""
    if shape.kind == "mesh":
        vertices = hull(shape)
        low = vertices.min(0)
        high = vertices.max(0)
        return (high + low) / 2, (high - low) / 2
    if shape.kind == "box":
        return np.zeros(3), np.array(shape.size)
    radius = shape.size[0]
    height = {"sphere": radius, "cylinder": shape.size[-1], "capsule": radius + shape.size[-1]}
    return np.zeros(3), np.array([radius, radius, height[shape.kind]])


@lru_cache(maxsize=256)
def mesh_vertices(file: str, content: str) -> Float64:
    """Return the vertices (n, 3) of the convex hull of a mesh file with this digest, unscaled [m].

    Raises RobotError.
    """
    data = mesh_bytes(file, content)
    try:
        rows = np.ascontiguousarray(read_mesh(file, data).vertices, float) + 0.0  # no -0.0
        # Unique by their bytes, which is much faster than along an axis.
        vertices, _ = convex_hull(np.unique(rows.view("V24")).view(float))
    except Exception as error:
        raise RobotError(
            f"{file}: cannot be read: {error}; repair the file, or remove that <collision>"
        ) from error
    return vertices


def convex_hull(points: Float64) -> tuple[Float64, NDArray[np.int64]]:
    """Return the vertices (n, 3) of the convex hull of points, and its triangles (m, 3), by MuJoCo.

    Raises ValueError if MuJoCo's compiler refuses the points.
    """
    import mujoco

    spec = mujoco.MjSpec()
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name="mesh", uservert=points.ravel(), inertia=shell)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    model = spec.compile()
    # The hull's graph has two counts, the addresses and numbers of the vertices, edges, triangles.
    graph = model.mesh_graph[model.mesh_graphadr[0] :]
    corners, triangles = graph[:2].tolist()
    numbers = graph[2 + corners : 2 + 2 * corners]
    faces = graph[2 + 3 * corners + 3 * triangles :][: 3 * triangles]
    row = {number: index for index, number in enumerate(numbers.tolist())}
    return (
        read_only(vertices_in_file(model, numbers)),
        np.array([row[number] for number in faces.tolist()], np.int64).reshape(-1, 3),
    )


def vertices_in_file(model: MjModel, indices: Rows) -> Float64:
    """Return vertices of the only mesh of a model in the frame of its file; MuJoCo's are in
    principal axes.
    """
    import mujoco

    turned = np.zeros(9)
    place = model.mesh_pos[0]
    mujoco.mju_quat2Mat(turned, model.mesh_quat[0])
    points: Float64 = model.mesh_vert[indices].astype(float) @ turned.reshape(3, 3).T + place
    return points


def inertia_of(shapes: Sequence[Shape]) -> SpatialInertia:
    """Return the sum of the inertias of shapes of DENSITY, in the frame of their body, by MuJoCo's
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
    tensor = turn * model.body_inertia[1] @ turn.T
    center = model.body_ipos[1].copy()
    return SpatialInertia(float(model.body_mass[1]), read_only(center), read_only(tensor))


def add_geom(
    spec: MjSpec,
    body: MjsBody,
    shape: Shape,
    **options: object,
) -> None:
    """Add a shape to a body of a ``mujoco.MjSpec``; equal hulls share a mesh."""
    import mujoco

    kinds = mujoco.mjtGeom
    if shape.kind == "mesh":
        vertices = hull(shape)
        options["meshname"] = name = f"hull {digest(vertices)}"
        if spec.mesh(name) is None:
            # Only a mass from the density needs the volume, which a flat hull does not have.
            inertias = mujoco.mjtMeshInertia
            inertia = inertias.mjMESH_INERTIA_SHELL
            if "density" in options:
                inertia = inertias.mjMESH_INERTIA_CONVEX
            spec.add_mesh(name=name, uservert=vertices.ravel(), inertia=inertia)
    else:
        options["size"] = np.pad(shape.size, (0, 3 - len(shape.size)))
    body.add_geom(
        type=getattr(kinds, f"mjGEOM_{shape.kind.upper()}"),
        pos=shape.position,
        quat=shape.wxyz,
        **options,
    )
