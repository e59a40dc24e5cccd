"""What a robot looks like: the shapes of its URDF as coloured triangles, without a renderer.

A link is drawn by its ``<visual>`` elements; where it has none, or one of their mesh files is missing, by its collision
shapes. Mesh files are read by ``trimesh``; boxes, cylinders and spheres are made here.
"""

from __future__ import annotations

import math
import zlib
from typing import Any, NamedTuple

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from batchpid.errors import MissingDependencyError
from sim.robot.description import RobotDescription
from sim.robot.kinematics import numbers
from sim.robot.rotations import from_rpy, rotate
from sim.robot.urdf import find_mesh
from sim.robot.xml import parse_xml

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]
Rgba = tuple[float, float, float, float]

DEVIATION = 2e-3
"""How far flat triangles may stay from the round that they stand for, where nothing else is said [m]."""
FEWEST, MOST = 6, 48
"""Segments of a circle."""
_PALETTE = ((0.62, 0.65, 0.70, 1.0), (0.42, 0.46, 0.53, 1.0), (0.80, 0.81, 0.83, 1.0))


class Surface(NamedTuple):
    """Triangles of one colour that move with a link: ``vertices`` (v, 3) [m] in its frame, ``faces`` (f, 3)."""

    link: str
    rgba: Rgba
    vertices: Vertices
    faces: Faces


def surfaces(robot: RobotDescription, deviation: float = DEVIATION) -> list[Surface]:
    """Return the surfaces of ``robot``, one for each link and colour, as round as ``deviation`` [m] asks.

    Vertices are not shared across sharp edges, so that averaged normals shade right.

    Raises
    ------
    MissingDependencyError
        A shape is a mesh file, and there is no ``trimesh``.
    """
    original, sanitised = parse_xml(robot.path), etree.fromstring(robot.urdf.encode())
    colours = {
        material.get("name"): _rgba(material.find("color"))
        for material in original.iter("material")
        if material.find("color") is not None
    }
    collisions = {link.get("name"): link.findall("collision") for link in sanitised.findall("link")}
    result = []
    for link in original.findall("link"):
        name = link.get("name")
        shapes = _shapes(link.findall("visual"), robot, deviation)
        if not shapes:
            shapes = _shapes(collisions.get(name, []), robot, deviation) or []
        result += _merge(name, [(_colour(element, colours, name), *mesh) for element, mesh in shapes])
    return result


def _shapes(
    elements: list[etree._Element], robot: RobotDescription, deviation: float
) -> list[tuple[etree._Element, tuple[Vertices, Faces]]] | None:
    """Return each element's triangles in the link's frame, or None if one of its files is missing."""
    result = []
    for element in elements:
        mesh = _triangles(element.find("geometry"), robot, deviation)
        if mesh is None:
            return None
        vertices, faces = mesh
        origin = element.find("origin")
        turned = rotate(from_rpy(numbers(origin, "rpy", "0 0 0")), vertices)
        result.append((element, (turned + numbers(origin, "xyz", "0 0 0"), faces)))
    return result


def _merge(link: str, parts: list[tuple[Rgba, Vertices, Faces]]) -> list[Surface]:
    """Join the parts of one colour."""
    merged = []
    for rgba in dict.fromkeys(part[0] for part in parts):
        same = [part for part in parts if part[0] == rgba]
        shift = np.cumsum([0, *(len(vertices) for _, vertices, _ in same)])
        merged.append(
            Surface(
                link,
                rgba,
                np.concatenate([vertices for _, vertices, _ in same]),
                np.concatenate([faces + first for (_, _, faces), first in zip(same, shift, strict=False)]),
            )
        )
    return merged


def _triangles(
    geometry: etree._Element | None, robot: RobotDescription, deviation: float
) -> tuple[Vertices, Faces] | None:
    for shape in () if geometry is None else geometry:
        if shape.tag == "box":
            return box(numbers(shape, "size", "0 0 0"))
        if shape.tag == "cylinder":
            return cylinder(float(shape.get("radius", 0)), float(shape.get("length", 0)), deviation)
        if shape.tag == "sphere":
            return sphere(float(shape.get("radius", 0)), deviation)
        if shape.tag == "mesh":
            return _file(shape, robot)
    return np.zeros((0, 3)), np.zeros((0, 3), np.int64)


def _file(shape: etree._Element, robot: RobotDescription) -> tuple[Vertices, Faces] | None:
    path = find_mesh(shape.get("filename", ""), robot.path, ())
    if path is None:
        return None
    try:
        import trimesh
    except ImportError:
        raise MissingDependencyError("trimesh", f"drawing the mesh {path.name}", "view") from None
    mesh: Any = trimesh.load(path, force="mesh", process=False)
    return np.asarray(mesh.vertices) * numbers(shape, "scale", "1 1 1"), np.asarray(mesh.faces, np.int64)


def _colour(element: etree._Element, colours: dict[str | None, Rgba], link: str) -> Rgba:
    material = element.find("material")
    if material is not None:
        own = material.find("color")
        if own is not None:
            return _rgba(own)
        if material.get("name") in colours:
            return colours[material.get("name")]
    return _PALETTE[zlib.crc32(link.encode()) % len(_PALETTE)]  # the same at every run


def _rgba(color: etree._Element) -> Rgba:
    red, green, blue, alpha = numbers(color, "rgba", "0.6 0.6 0.6 1")
    return float(red), float(green), float(blue), float(alpha)


def box(size: NDArray[np.float64]) -> tuple[Vertices, Faces]:
    """Return a box of edges ``size`` (3,) [m] about the origin: four vertices to a side, facing out."""
    vertices: list[Vertices] = []
    faces: list[Faces] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            corners = np.zeros((4, 3))
            corners[:, axis] = sign
            corners[:, u], corners[:, v] = (-1, 1, 1, -1), (-1, -1, 1, 1)
            first = 4 * len(vertices)
            order = [[0, 1, 2], [0, 2, 3]] if sign > 0 else [[0, 2, 1], [0, 3, 2]]
            vertices.append(corners)
            faces.append(first + np.array(order))
    return np.concatenate(vertices) * np.asarray(size) / 2, np.concatenate(faces)


def segments_of(radius: float, deviation: float) -> int:
    """Return how many chords a circle [m] needs for none to be farther than ``deviation`` [m] from its arc.

    A chord over the angle 2a stays r (1 - cos a) behind it.
    """
    if radius <= deviation:
        return FEWEST
    return min(MOST, max(FEWEST, math.ceil(math.pi / math.acos(1 - deviation / radius))))


def cylinder(radius: float, length: float, deviation: float = DEVIATION) -> tuple[Vertices, Faces]:
    """Return a cylinder along z about the origin, its caps apart from its side."""
    segments = segments_of(radius, deviation)
    angle = 2 * math.pi * np.arange(segments) / segments
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(segments)], axis=1)
    up = np.array([0.0, 0.0, length / 2])
    here, following = np.arange(segments), (np.arange(segments) + 1) % segments
    low, high, bottom, top = (n * segments for n in range(4))
    fan, first = here[1:-1], np.zeros(segments - 2, np.int64)
    faces = [
        np.stack([low + here, low + following, high + following], axis=1),
        np.stack([low + here, high + following, high + here], axis=1),
        bottom + np.stack([first, fan + 1, fan], axis=1),
        top + np.stack([first, fan, fan + 1], axis=1),
    ]
    vertices = [ring - up, ring + up, ring - up, ring + up]
    return np.concatenate(vertices), np.concatenate(faces)


def sphere(radius: float, deviation: float = DEVIATION) -> tuple[Vertices, Faces]:
    """Return a sphere about the origin, of rings of latitude."""
    segments = segments_of(radius, deviation)
    rings = math.ceil(segments / 2)
    polar = math.pi * np.arange(rings + 1) / rings
    angle = 2 * math.pi * np.arange(segments) / segments
    flat = np.sin(polar)[:, None]
    height = np.repeat(np.cos(polar)[:, None], segments, axis=1)
    vertices = radius * np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=-1).reshape(-1, 3)
    ring, column = np.meshgrid(np.arange(rings), np.arange(segments), indexing="ij")
    following = (column + 1) % segments
    a, b = ring * segments + column, ring * segments + following
    c, d = a + segments, b + segments
    # At a pole one of the two triangles of a quad has no area.
    faces = np.concatenate([np.stack([a, c, d], -1)[:-1].reshape(-1, 3), np.stack([a, d, b], -1)[1:].reshape(-1, 3)])
    return vertices, faces
