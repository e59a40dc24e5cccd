"""Visible surfaces of a robot: the shapes of its URDF as coloured triangles, for page and films.

A link is drawn by its ``<visual>`` elements; where it has none, or one of their mesh files cannot
be read, by its collision shapes. Unreadable files are reported. A robot of which nothing can be
drawn is drawn by rods between its joints. The triangles are made, or read from mesh files, by
``trimesh``.
"""

from __future__ import annotations

import math
import zlib
from typing import Any, NamedTuple

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from batchpid.io.files import imported
from batchpid.sim.findings import Finding
from batchpid.sim.geometry.mesh_files import find_mesh, read_mesh
from batchpid.sim.geometry.shapes import Shape, convex_hull
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.urdf import SHAPES, is_mjcf, read_origin, read_shape
from batchpid.sim.robot.xml import parse_xml, read_numbers
from batchpid.task_space.frames import matrix_of, rotate

Rgba = tuple[float, ...]
_REMEDY = (
    "repair the file, put it next to the URDF, pass package_dirs=[...] to Robot.load"
    ", or set ROS_PACKAGE_PATH"
)

DEVIATION = 2e-3  # default distance allowed between a chord and its arc [m]
FEWEST, MOST = 6, 48  # bounds of the number of segments of a circle
_ROD = 0.08  # thickness of a rod, as a share of the longest one
_PALETTE = ((0.62, 0.65, 0.70, 1.0), (0.42, 0.46, 0.53, 1.0), (0.80, 0.81, 0.83, 1.0))
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


def surfaces(
    robot: Robot, deviation: float = DEVIATION, findings: list[Finding] | None = None
) -> list[Surface]:
    """Return the surfaces of ``robot``, one for each link and colour; ``deviation`` [m] as in
    :func:`segments_of`.

    A mesh that cannot be read is appended to ``findings``.

    Vertices are not shared across sharp edges, so that averaged normals shade correctly.

    Raises
    ------
    RobotError
        A visual element is malformed.
    """
    concatenate = imported("trimesh.util").concatenate

    visuals = _read_visuals(robot)
    result = []
    for body in robot.links:
        name = body.name
        solid = [(shape, None) for shape in robot.tables.shapes_of(name)]
        parts: dict[Rgba, list[Any]] = {}
        unreadable: list[OSError] = []
        # Collision shapes are drawn where the visuals cannot be.
        for elements in (visuals.get(name, []), solid):
            try:
                meshes = [_mesh(shape, robot, deviation) for shape, _ in elements]
            except OSError as error:
                unreadable.append(error)
                continue
            if meshes and all(mesh is not None for mesh in meshes):
                for (_, rgba), mesh in zip(elements, meshes, strict=True):
                    parts.setdefault(rgba or _default_colour(name), []).append(mesh)
                break
        if findings is not None:
            for mesh, reason in (error.args for error in unreadable):
                text = f"mesh cannot be read ({reason}): collision shapes are drawn, if any"
                findings.append(
                    Finding("missing-mesh", text, _REMEDY, link=name, detail=repr(mesh))
                )
        for rgba, same in parts.items():
            joined: Any = concatenate(same)
            result.append(
                Surface(name, rgba, np.asarray(joined.vertices), np.asarray(joined.faces))
            )
    return result or _rods(robot)


def _read_visuals(robot: Robot) -> dict[str, list[tuple[Shape | None, Rgba | None]]]:
    """Return shape and colour of the ``<visual>`` elements of each link of a URDF, None for those
    without; MJCF files are drawn by the collision shapes.
    """
    root = parse_xml(robot.path)
    if is_mjcf(root):
        return {}
    colours = {
        material.get("name"): _rgba(material.find("color"), f"{robot.path}: material")
        for material in root.iter("material")
        if material.find("color") is not None
    }
    visuals: dict[str, list[tuple[Shape | None, Rgba | None]]] = {}
    for link in root.findall("link"):
        name = link.get("name", "").strip()
        where = f"{robot.path}: link {name!r}"
        rows = []
        for element in link.findall("visual"):
            geometry = element.find("geometry/*")
            material = element.find("material")
            shape, rgba = None, None
            if geometry is not None and geometry.tag in SHAPES:
                shape = read_shape(geometry, name, read_origin(element, where), where)
            if material is not None:
                rgba = colours.get(material.get("name"))
                if (color := material.find("color")) is not None:
                    rgba = _rgba(color, where)
            rows.append((shape, rgba))
        visuals.setdefault(name, rows)  # the first of links with one name
    return visuals


def _rods(robot: Robot) -> list[Surface]:
    """Return a rod from the frame of each link to each joint on it, from the last links to their
    centers of mass.
    """
    creation = imported("trimesh.creation")

    tree = robot.rigid_tree
    ends = [(parent, tree.position[link]) for link, parent in enumerate(tree.parent) if parent >= 0]
    ends += [
        (link, tree.center[link]) for link in range(len(tree.links)) if link not in tree.parent
    ]
    lengths = [float(np.linalg.norm(end)) for _, end in ends]
    thickness = _ROD * max(lengths)
    rods = []
    for (link, end), length in zip(ends, lengths, strict=True):
        if length > thickness:
            name = tree.links[link]
            rod: Any = creation.cylinder(thickness / 2, segment=[np.zeros(3), end], sections=FEWEST)
            rods.append(
                Surface(
                    name, _default_colour(name), np.asarray(rod.vertices), np.asarray(rod.faces)
                )
            )
    return rods


def segments_of(radius: float, deviation: float) -> int:
    """Return how many chords, within FEWEST and MOST, keep a circle within ``deviation`` [m] of its
    arc.

    A chord over the angle 2a is r (1 - cos a) away from the arc.
    """
    if radius <= deviation:
        return FEWEST
    return min(MOST, max(FEWEST, math.ceil(math.pi / math.acos(1 - deviation / radius))))


def _read_mesh(name: str, robot: Robot) -> Any:
    """Return the result of ``trimesh`` for a mesh file of the robot, in metres. Raises
    OSError with the name and the reason.
    """
    path = find_mesh(name, robot.path, robot.reading.package_dirs)
    if path is None:
        raise OSError(name, "not found")
    try:
        loaded = read_mesh(path)
    except Exception as error:
        raise OSError(name, f"{type(error).__name__}: {error}") from error
    if not len(loaded.faces):
        raise OSError(name, "no triangles")
    return loaded


def _mesh(shape: Shape | None, robot: Robot, deviation: float) -> Any:
    """Return the ``trimesh.Trimesh`` of a shape in its link's frame, or None without one.

    Raises OSError with the name of a mesh that cannot be read, and the reason.
    """
    if shape is None:
        return None
    trimesh = imported("trimesh")
    creation = imported("trimesh.creation")
    if shape.kind == "mesh":
        if shape.vertices is not None:
            surface: Any = convex_hull(shape.vertices)
        else:
            surface = _read_mesh(shape.file, robot)
        mesh: Any = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        mesh.apply_scale(shape.scale)
    elif shape.kind == "box":
        mesh = creation.box([2 * side for side in shape.size])
        mesh.unmerge_vertices()
    else:
        radius = shape.size[0]
        length = 2 * sum(shape.size[1:])
        segments = segments_of(radius, deviation)
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


def _default_colour(link: str) -> Rgba:
    return _PALETTE[
        zlib.crc32(link.encode()) % len(_PALETTE)
    ]  # the same in every run, unlike hash()


def _rgba(color: etree._Element, where: str) -> Rgba:
    return read_numbers(color, "rgba", "0.6 0.6 0.6 1", where)
