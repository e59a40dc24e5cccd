"""Robots on a floor: the scene that the page and films draw, as coloured triangles.

The triangles are made, or read from mesh files, by ``trimesh``.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64, Rows
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import imported
from batchpid.sim.description.tables import Visual
from batchpid.sim.findings import Finding
from batchpid.sim.geometry.mesh_files import read_mesh
from batchpid.sim.geometry.shapes import convex_hull
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_model import link_tree
from batchpid.task_space.frames import matrix_of, placed, rotate

MAX_ROBOTS = 64
"""Largest number of robots in a scene."""
FIELD_OF_VIEW = math.radians(42)
"""Vertical field of view of the camera [rad]."""
TILE = 0.5
"""Edge of a tile of the floor [m]."""
_PITCH = 1.3
"""Distance between neighbours, in reaches: two robots overlap only when both stretch out."""
_CAMERA_DIRECTION = np.array([-0.62, -0.80, 0.52])
Rgba = tuple[float, ...]
_REMEDY = (
    "repair the file, put it next to the URDF, pass package_dirs=[...] to Robot.load"
    ", or set ROS_PACKAGE_PATH"
)

_GREY = (0.62, 0.65, 0.70, 1.0)
_CYLINDER = (
    (0.0, -0.5),
    (1.0, -0.5),
    (1.0, -0.5),
    (1.0, 0.5),
    (1.0, 0.5),
    (0.0, 0.5),
)  # (radius, z), rims twice


class Surface(NamedTuple):
    """Triangles of one colour that move with a link: ``vertices`` (v, 3) [m] in its frame,
    ``faces`` (f, 3).
    """

    link: str
    rgba: Rgba
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


class RobotScene:
    """``count`` robots in a square around the origin, on a floor.

    The floor is at height 0 if physics has a ``ground``, otherwise at the lowest point of the start
    pose. Round shapes have ``segments`` to a circle. Raises InvalidArgumentError if no shape of the
    robot can be drawn.
    """

    def __init__(
        self,
        robot: Robot,
        count: int,
        ground: bool,
        segments: int,
    ) -> None:
        self._tree = link_tree(robot)
        self.ground = ground
        self.surfaces, self.findings = surfaces(robot, segments)
        """Coloured triangles of one robot, and meshes that cannot be read: their links are drawn by
        the collision shapes, or not at all.
        """
        if not self.surfaces:
            problem = f"{robot.name!r} has no shape that can be drawn"
            raise InvalidArgumentError(
                "robot", problem, remedy=f"give its links visuals; {_REMEDY}"
            )
        self._links = [self._tree.index(surface.link) for surface in self.surfaces]
        # The 95th percentile over seeded poses: a single stretched pose should not push all robots
        # apart.
        samples = ts.link_poses(self._tree, robot.sample(200, seed=0))
        distances = np.linalg.norm(samples[..., :2], axis=-1).max(1)
        self.reach = max(0.3, float(np.quantile(distances, 0.95)))
        """Horizontal reach of a robot [m]."""
        row, column = np.divmod(np.arange(count), round(math.sqrt(count)))
        grid = np.stack([column, row, 0 * row], axis=1)
        self.positions: Float64 = _PITCH * self.reach * (grid - grid.max(0) / 2)
        """Positions of the robots (count, 3) [m]."""
        frames = ts.link_poses(self._tree, robot.start)[:, 2].min()
        lowest = min(float(frames), robot.dynamics().contacts.height(robot.start, base_too=True))
        self.floor = 0.0 if ground else lowest
        """Height of the floor [m]."""
        corner = np.abs(self.positions[0, :2]) + 2.0 * self.reach
        self.half_floor: Float64 = TILE * np.ceil(corner / TILE)
        """Half the edges of the floor under all robots (2,) [m], in whole tiles."""
        self.target: Float64 = np.array([0.0, 0.0, self.floor + 0.35 * self.reach])
        """Point that the camera looks at (3,) [m]."""
        size = 2 * math.hypot(*self.positions[0, :2]) + 2.0 * self.reach
        self.eye: Float64 = 1.02 * size * _CAMERA_DIRECTION + [0.0, 0.0, self.floor]
        """Position of the camera (3,) [m]."""
        self._qpos = np.tile(robot.start, (count, 1))
        self._base = np.tile([0.0, 0, 0, 1, 0, 0, 0], (count, 1))

    def place(self, qpos: Rows, base_pose: Rows | None = None) -> Float64:
        """Return the poses of the surfaces (count, surfaces, 7) [m] at the joint positions (count,
        dof) [rad or m].

        ``base_pose`` (count, 7) are the poses of floating bases. A robot with a number that is not
        finite stays where it was.
        """
        finite = np.isfinite(qpos).all(1, keepdims=True)
        if base_pose is not None:
            finite &= np.isfinite(base_pose).all(1, keepdims=True)
            self._base = np.where(finite, base_pose, self._base)
        self._qpos = np.where(finite, qpos, self._qpos)
        links = ts.link_poses(self._tree, self._qpos)[:, self._links]
        poses = placed(self._base[:, None], links)
        poses[..., :3] += self.positions[:, None]
        return poses


def surfaces(robot: Robot, segments: int = 24) -> tuple[list[Surface], list[Finding]]:
    """Return the surfaces of ``robot``, one for each link and colour, with ``segments`` to a circle,
    and findings on shapes that cannot be read.

    A link is drawn by its visuals; where it has none, or one of them cannot be read, by its
    collision shapes. Vertices are not shared across sharp edges, so that averaged normals shade
    correctly.
    """
    drawn: list[Surface] = []
    findings: list[Finding] = []
    for name in robot.tables.links:
        solid = [Visual(shape) for shape in robot.tables.shapes_of(name)]
        for visuals in (robot.tables.visuals.get(name, ()), solid):
            parts: dict[Rgba, list[Any]] = {}
            try:
                for visual in visuals:
                    mesh = _mesh(visual, segments)
                    parts.setdefault(visual.rgba or _GREY, []).append(mesh)
            except OSError as error:
                shape, reason = error.args
                text = f"cannot be drawn ({reason}): collision shapes are drawn, if any"
                findings.append(
                    Finding("missing-mesh", text, _REMEDY, link=name, detail=repr(shape))
                )
                continue
            for rgba, meshes in parts.items():
                joined: Any = imported("trimesh.util").concatenate(meshes)
                surface = Surface(name, rgba, np.asarray(joined.vertices), np.asarray(joined.faces))
                drawn.append(surface)
            if parts:
                break
    return drawn, findings


def _read_mesh(file: str) -> Any:
    """Return the result of ``trimesh`` for a mesh file, in metres. Raises OSError with the name and
    the reason.
    """
    try:
        loaded = read_mesh(file, Path(file).read_bytes())
    except Exception as error:
        raise OSError(file, f"{type(error).__name__}: {error}") from error
    if not len(loaded.faces):
        raise OSError(file, "no triangles")
    return loaded


def _mesh(visual: Visual, segments: int) -> Any:
    """Return the ``trimesh.Trimesh`` of a shape in its link's frame.

    Raises OSError with the name of a shape that cannot be read, and the reason.
    """
    shape = visual.shape
    if shape is None:
        raise OSError("<visual>", visual.problem)
    trimesh = imported("trimesh")
    creation = imported("trimesh.creation")
    if shape.kind == "mesh":
        if shape.vertices is not None:
            surface: Any = convex_hull(shape.vertices)
        else:
            surface = _read_mesh(shape.file)
        mesh: Any = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        mesh.apply_scale(shape.scale)
    elif shape.kind == "box":
        mesh = creation.box([2 * side for side in shape.size])
        mesh.unmerge_vertices()
    else:
        radius = shape.size[0]
        length = 2 * sum(shape.size[1:])
        # Made with radius 1 and scaled: trimesh drops triangles smaller than 1e-8 m^2.
        if shape.kind == "cylinder":
            mesh = creation.revolve(_CYLINDER, sections=segments, process=False)
            mesh.vertices *= (radius, radius, length)
        else:
            count = ((segments + 1) // 2, segments)
            mesh = creation.capsule(length / max(radius, 1e-9), 1.0, count=count)
            mesh.vertices *= radius
    mesh.vertices = rotate(matrix_of(shape.wxyz), np.asarray(mesh.vertices)) + shape.position
    return mesh
