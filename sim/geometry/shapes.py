"""Collision shapes as plain values for engines, distances and masses, and inertia tensors that a
body can have.

A mesh collides as its convex hull, in both engines; a mass from shapes is that of the mesh itself
where it encloses a volume.

The principal moments a <= b <= c of a body are positive and satisfy the triangle inequality c <= a
+ b. This says that the density-weighted covariance tr(I)/2 - I has no negative eigenvalue: P. M.
Wensing, S. Kim, J.-J. E. Slotine, "Linear matrix inequalities for physically consistent inertial
parameter identification", IEEE Robotics and Automation Letters 3 (2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Document, Float64, MjModel, MjsBody, MjSpec
from batchpid.arrays.elementwise import read_only
from batchpid.arrays.trees import digest
from batchpid.errors import RobotError
from batchpid.sim.geometry.mesh_files import mesh_bytes, read_mesh
from batchpid.task_space.frames import SpatialInertia, matrix_of, rotate

MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
LEAST_MASS = 1e-9
"""Mass [kg] of a row without mass: 0 stands for a mass that the file does not give."""
DENSITY = 1000.0  # [kg/m^3] of water, with which SAPIEN computes the mass of shapes
# Least principal moment over the largest of a tensor that had to be replaced; PhysX divides by it.
SLENDER = 1e-3
# Mass [kg] and principal moment [kg m^2] with a reciprocal that single precision can hold.
SMALLEST = 1e-30
SMALLEST_RATIO = 1e-9  # of principal moments that SAPIEN's eigenvalues and single precision resolve
ShapeKind = Literal["sphere", "box", "capsule", "cylinder", "mesh"]


class Shape(NamedTuple):
    """Convex collision shape."""

    body: str
    """Body that has the shape."""
    owner: str
    """Link of the file that has the shape; another than ``body`` after a merge."""
    kind: ShapeKind
    size: tuple[float, ...]
    """Radius; half lengths of a box's sides; radius and half length, without the ends of a capsule
    [m]; () for a mesh. Capsules and cylinders lie along the z axis of the shape.
    """
    position: Float64
    """Place of the shape in the frame of the body (3,) [m]."""
    wxyz: Float64
    """Orientation of the shape in the frame of the body (4,)."""
    file: str = ""
    """Absolute path of a mesh, which counts as its convex hull; "" for other shapes."""
    scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    """Factors of the vertices of the file; an odd number of negative ones mirrors the mesh."""
    vertices: Float64 | None = None
    """Vertices (n, 3) [m] of a mesh without a file, in the frame of the shape."""
    content: str = ""
    """Digest of the bytes of ``file``, which say what it is: paths and time stamps do not."""


class Triangles(NamedTuple):
    """Triangles: ``vertices`` (v, 3) [m], and ``faces`` (f, 3), numbers of vertices."""

    vertices: Float64
    faces: NDArray[np.int64]

    @property
    def volume(self) -> float:
        """Volume within a closed surface [m^3]."""
        return float(np.linalg.det(self.vertices[self.faces]).sum() / 6)


def hull(shape: Shape) -> Float64:
    """Return the vertices of the convex hull of a mesh (n, 3) [m], in the frame of the shape.

    Raises RobotError for a file that cannot be read.
    """
    if shape.vertices is not None:
        return shape.vertices
    return read_only(mesh_hull(shape.file, shape.content).vertices * shape.scale)


def extent(shape: Shape) -> float:
    """Return the diagonal [m] of the box around a shape; of a capsule without its ends."""
    if shape.kind == "mesh":
        return float(np.linalg.norm(np.ptp(hull(shape), axis=0)))
    return 2 * float(np.linalg.norm(shape.size))


@lru_cache(maxsize=256)
def mesh_hull(file: str, content: str) -> Triangles:
    """Return the convex hull of a mesh file with this digest, unscaled [m]. Raises RobotError."""
    try:
        return convex_hull(_mesh_surface(file, content).vertices)
    except ValueError as error:
        raise _unreadable(file, error) from error


def _unreadable(file: str, error: Exception) -> RobotError:
    return RobotError(
        f"{file}: cannot be read: {error}; repair the file, or remove that <collision>"
    )


def _mesh_surface(file: str, content: str) -> Any:
    """Return the mesh of a file as of ``trimesh``, without copies of vertices, unscaled [m]."""
    data = mesh_bytes(file, content)
    try:
        mesh = read_mesh(file, data)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    except Exception as error:
        raise _unreadable(file, error) from error
    return mesh


@lru_cache(maxsize=256)
def mesh_solid(file: str, content: str) -> Triangles | None:
    """Return the surface of a mesh file that encloses a volume, unscaled [m]; None for others."""
    mesh = _mesh_surface(file, content)
    return Triangles(mesh.vertices, mesh.faces) if mesh.is_volume else None


def hull_share(shape: Shape) -> float:
    """Return the volume of a mesh's hull over that of the mesh; 1.0 where it encloses none."""
    solid = mesh_solid(shape.file, shape.content) if shape.file else None
    if solid is None:
        return 1.0
    return mesh_hull(shape.file, shape.content).volume / solid.volume


def convex_hull(points: Float64) -> Triangles:
    """Return the convex hull of points, by MuJoCo.

    Raises ValueError if MuJoCo's compiler refuses the points.
    """
    spec = mujoco.MjSpec()
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(
        name="mesh",
        uservert=points.ravel(),
        inertia=shell,
    )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    model = spec.compile()
    corners, faces = hull_graph(model, 0)
    # MuJoCo turns a mesh to its principal axes.
    vertices = rotate(matrix_of(model.mesh_quat[0]), model.mesh_vert[corners].astype(float))
    row = {number: index for index, number in enumerate(corners.tolist())}
    triangles = np.array([row[number] for number in faces.tolist()], np.int64).reshape(-1, 3)
    return Triangles(read_only(vertices + model.mesh_pos[0]), triangles)


def hull_graph(model: MjModel, mesh: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the numbers of the vertices (n,) of the convex hull of a mesh of a model, and those of
    its triangles (3 f,).
    """
    # Two counts, the addresses and numbers of the vertices, edges, triangles.
    graph = model.mesh_graph[model.mesh_graphadr[mesh] :]
    corners, count = graph[:2].tolist()
    after = 2 + 3 * corners + 3 * count
    return graph[2 + corners : 2 + 2 * corners], graph[after : after + 3 * count]


def inertia_of(shapes: Sequence[Shape]) -> SpatialInertia:
    """Return the sum of the inertias of shapes of DENSITY, in the frame of their body, by MuJoCo's
    compiler.
    """
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    for shape in shapes:
        add_geom(spec, body, shape, density=DENSITY)
    model = spec.compile()
    turn = matrix_of(model.body_iquat[1])
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
    kinds = mujoco.mjtGeom
    if shape.kind == "mesh":
        vertices = hull(shape)
        inertias = mujoco.mjtMeshInertia
        # A flat hull has no volume, which a mass from the density alone needs.
        mesh: Document = {"inertia": inertias.mjMESH_INERTIA_SHELL}
        if "density" in options:
            mesh["inertia"] = inertias.mjMESH_INERTIA_CONVEX
            solid = mesh_solid(shape.file, shape.content) if shape.file else None
            if solid is not None:
                vertices = solid.vertices * shape.scale
                faces = solid.faces[:, :: -1 if np.prod(shape.scale) < 0 else 1]
                mesh = {"inertia": inertias.mjMESH_INERTIA_EXACT, "userface": faces.ravel()}
        options["meshname"] = name = f"mesh {digest(vertices)}"
        if spec.mesh(name) is None:
            spec.add_mesh(
                name=name,
                uservert=vertices.ravel(),
                **mesh,
            )
    else:
        options["size"] = np.pad(shape.size, (0, 3 - len(shape.size)))
    body.add_geom(
        type=getattr(kinds, f"mjGEOM_{shape.kind.upper()}"),
        pos=shape.position,
        quat=shape.wxyz,
        **options,
    )


def from_entries(entries: Sequence[float]) -> Float64:
    """Return the tensor (3, 3) of its entries xx, xy, xz, yy, yz, zz."""
    tensor = np.zeros((3, 3))
    tensor[np.triu_indices(3)] = entries
    return tensor + np.triu(tensor, 1).T


def nearest_physical(tensor: Float64) -> Float64:
    """Return the physically possible inertia tensor (3, 3) nearest to a symmetric one in the
    Frobenius norm.

    The nearest has the same principal axes, so the moments are projected on the cone of the
    triangle inequalities: on its face c = a + b or, if a would be negative there, on its edge (0,
    m, m). Then a is raised to SLENDER times c. The result is zero if no moment is positive.
    """
    (a, b, c), axes = np.linalg.eigh(tensor)
    excess = max(c - a - b, 0.0) / 3
    a = a + excess
    b = b + excess
    c = c - excess
    if a < 0:
        a, b, c = 0.0, (b + c) / 2, (b + c) / 2
    moments = np.maximum([a, b, c], 0.0)
    moments[0] = max(moments[0], SLENDER * moments[2])
    nearest: Float64 = (axes * moments) @ axes.T
    return nearest


def possible_inertia(mass: float, tensor: Float64) -> tuple[Float64, tuple[str, str] | None]:
    """Return an inertia tensor (3, 3) if PhysX can simulate it, else the nearest that a body of
    that mass has, with the problem and its figures.
    """
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] >= max(SMALLEST, SMALLEST_RATIO * moments[2]):
        return tensor, None
    changed = nearest_physical(tensor)
    done = "the nearest possible one is used"
    if changed.max() < SMALLEST:
        changed = ball(mass)
        done = f"the tensor of a ball of its mass at {DENSITY:g} kg/m^3 is used"
    before = " ".join(f"{moment:.3g}" for moment in moments)
    after = " ".join(f"{moment:.3g}" for moment in np.linalg.eigvalsh(changed))
    text = f"no body has such an inertia tensor: {done}"
    return changed, (text, f"moments {before} kg m^2, used {after}")


def triangle_excess(tensor: Float64) -> float:
    """Return (c - a - b) / c of the principal moments of a tensor (3, 3): positive if the tensor is
    impossible.
    """
    a, b, c = np.linalg.eigvalsh(tensor)
    return float((c - a - b) / c)


def ball(mass: float) -> Float64:
    """Return the inertia tensor (3, 3) [kg m^2] of a ball of ``mass`` [kg] at DENSITY: 2/5 m
    r^2.
    """
    radius = (3 * mass / (4 * np.pi * DENSITY)) ** (1 / 3)
    tensor: Float64 = 0.4 * mass * radius**2 * np.eye(3)
    return tensor
