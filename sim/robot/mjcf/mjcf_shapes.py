"""Collision shapes of a compiled MJCF file, and the pairs of links that its masks and exclusions
keep apart.

A mesh collides as its convex hull, in MuJoCo and in PhysX. Hulls of meshes and ellipsoids are
written to ``batchpid/meshes`` in the user's cache folder, named by their content.
"""

from __future__ import annotations

import os
from collections import defaultdict
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import MjModel
from batchpid.arrays.digest import digest
from batchpid.errors import RobotError
from batchpid.io.files import write_atomically
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.mjcf.mjcf_compiler import ALONE, Names, label
from batchpid.sim.robot.self_collision import DisabledPair
from batchpid.task_space.rotations import to_rpy

_KIND = mujoco.mjtGeom
PLANE = _KIND.mjGEOM_PLANE
_PARALLELS, _MERIDIANS = 12, 16
"""Rings, poles included, and vertices of a ring, of an ellipsoid's hull."""


def can_collide(model: MjModel, geom: int) -> bool:
    """Return whether a geom collides with anything, by its masks or in a ``<pair>``."""
    return bool(model.geom_contype[geom] | model.geom_conaffinity[geom]) or geom in _paired(model)


def _paired(model: MjModel) -> set[int]:
    return {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}


def excluded_pairs(model: MjModel, solid: dict[int, str]) -> tuple[DisabledPair, ...]:
    """Return the pairs of links with shapes that never collide: excluded, or by the masks of all
    their geoms.

    ``solid`` maps bodies with shapes to their links. Bodies that are welded together do not count.
    """
    excluded = {
        frozenset((int(each) >> 16, int(each) & 0xFFFF)) for each in model.exclude_signature
    }
    geoms: dict[int, list[int]] = defaultdict(list)
    for geom in range(model.ngeom):
        if can_collide(model, geom):
            geoms[int(model.geom_bodyid[geom])].append(geom)
    paired = {
        frozenset(model.geom_bodyid[[one, other]].tolist())
        for one, other in zip(model.pair_geom1, model.pair_geom2, strict=True)
    }

    def collide(first: int, second: int) -> bool:
        pair = frozenset((first, second))
        if pair in paired or pair in excluded:
            return pair in paired
        types, affinities = (
            [field[geoms[body]] for body in (first, second)]
            for field in (model.geom_contype, model.geom_conaffinity)
        )
        return bool(
            np.any(types[0][:, None] & affinities[1]) or np.any(types[1][:, None] & affinities[0])
        )

    return tuple(
        DisabledPair(solid[first], solid[second], "User")
        for first, second in combinations(solid, 2)
        if model.body_weldid[first] != model.body_weldid[second] and not collide(first, second)
    )


class ShapeWriter:
    """Writer of a body's geoms as the ``<collision>`` elements of its link."""

    def __init__(self, model: MjModel, names: Names, findings: list[Finding]) -> None:
        self._model = model
        self._names = names
        self._findings = findings
        self._files: dict[int, Path] = {}  # by number of the mesh

    def write(self, body: int, link: etree._Element, anchor: NDArray[np.float64]) -> bool:
        """Write the shapes of a body, whose link has its origin at ``anchor``; return whether there
        are any.

        Raises RobotError if the hull of a mesh cannot be written.
        """
        model, written = self._model, False
        first = int(model.body_geomadr[body])
        for geom in range(first, first + int(model.body_geomnum[body])):
            if not can_collide(model, geom):
                continue
            geometry = self._geometry(geom, body)
            if geometry is None:
                continue
            collision = etree.SubElement(link, "collision")
            place, turn = model.geom_pos[geom] - anchor, model.geom_quat[geom]
            etree.SubElement(collision, "origin", xyz=text_of(place), rpy=text_of(to_rpy(turn)))
            etree.SubElement(collision, "geometry").append(geometry)
            written = True
        return written

    def leave_out(self, body: int) -> None:
        """Report the shapes of a body that is not part of the robot."""
        first = int(self._model.body_geomadr[body])
        solid = [
            geom
            for geom in range(first, first + int(self._model.body_geomnum[body]))
            if can_collide(self._model, geom)
        ]
        others = [geom for geom in solid if int(self._model.geom_type[geom]) != PLANE]
        for geom in sorted({*solid} - {*others}):
            self._plane(geom)
        if others:
            listed = ", ".join(label(self._model.geom(geom)) for geom in others)
            text = f"{ALONE} shapes of the world beside a robot on a free joint: {listed}"
            self._found("warning", None, text, "in SAPIEN add them with build= of Runner")

    def _plane(self, geom: int) -> None:
        """Report a plane of the world, in place of which scenes have a ground."""
        text = f"{ALONE} the plane {label(self._model.geom(geom))} of the file"
        height, (_, x, y, _) = float(self._model.geom_pos[geom, 2]), self._model.geom_quat[geom]
        if height == 0 and x == y == 0:
            self._found("note", None, text, "SAPIEN has a ground at height 0")
        else:
            remedy = (
                "SAPIEN has a ground at height 0 instead: add the plane with build= of Runner, or"
                " pass ground=False"
            )
            where = (
                f"{text}, at height {height:g} m" if x == y == 0 else f"{text}, which is not level"
            )
            self._found("warning", None, where, remedy)

    def _geometry(self, geom: int, body: int) -> etree._Element | None:
        """Return the shape of a geom; None, with a finding, if a URDF has no such shape."""
        kind, size = int(self._model.geom_type[geom]), self._model.geom_size[geom]
        if kind == _KIND.mjGEOM_SPHERE:
            return etree.Element("sphere", radius=text_of(size[:1]))
        if kind == _KIND.mjGEOM_BOX:
            return etree.Element("box", size=text_of(2 * size))
        if kind in (_KIND.mjGEOM_CAPSULE, _KIND.mjGEOM_CYLINDER):
            tag = "capsule" if kind == _KIND.mjGEOM_CAPSULE else "cylinder"
            return etree.Element(tag, radius=text_of(size[:1]), length=text_of(2 * size[1:2]))
        if kind in (_KIND.mjGEOM_MESH, _KIND.mjGEOM_SDF):
            mesh = int(self._model.geom_dataid[geom])
            if mesh not in self._files:
                self._files[mesh] = _write_mesh(*_hull(self._model, mesh))
            return etree.Element("mesh", filename=str(self._files[mesh]))
        if kind == _KIND.mjGEOM_ELLIPSOID:
            text = "an ellipsoid collides in SAPIEN as a polyhedron inscribed in it"
            self._found(
                "note", body, text, "expect its surface up to 3 % of the radii farther inside"
            )
            return etree.Element("mesh", filename=str(_write_mesh(*_ellipsoid(size))))
        if body == 0 and kind == PLANE:
            self._plane(geom)
        else:
            name = (
                f"{'a plane' if kind == PLANE else 'a height field'}"
                f" ({label(self._model.geom(geom))})"
            )
            self._found(
                "warning",
                body,
                f"{name} is a shape in MuJoCo alone",
                "in SAPIEN add it with build=",
            )
        return None

    def _found(self, severity: str, body: int | None, text: str, remedy: str) -> None:
        link = None if body is None else self._names.bodies[body]
        self._findings.append(Finding(severity, "collision", text, remedy, link=link))


def text_of(values: ArrayLike) -> str:
    """Return numbers as text that reads back to the same numbers."""
    return " ".join(map(repr, np.asarray(values, float).tolist()))


def _hull(model: MjModel, mesh: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return vertices (n, 3) [m] and triangles (m, 3) of the convex hull of a mesh, or of the mesh
    if it has none.

    The hull's graph has the layout of ``mesh_graph`` in MuJoCo's mjmodel.h.
    """
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices = model.mesh_vert[first : first + count]
    if (begin := int(model.mesh_graphadr[mesh])) < 0:
        first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        return vertices, model.mesh_face[first : first + count].astype(np.int64)
    corners, triangles = model.mesh_graph[begin : begin + 2].tolist()
    begin += (
        2 + 3 * corners + 3 * triangles
    )  # the triangles come last: after two counts, vertices and edges
    kept, faces = np.unique(model.mesh_graph[begin : begin + 3 * triangles], return_inverse=True)
    return vertices[kept], faces.reshape(-1, 3).astype(np.int64)


def _ellipsoid(radii: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return vertices and triangles of a polyhedron with its vertices on an ellipsoid."""
    polar = np.linspace(0, np.pi, _PARALLELS)[1:-1, None]
    angle = np.arange(_MERIDIANS) * 2 * np.pi / _MERIDIANS
    rings = np.stack(
        np.broadcast_arrays(
            np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar)
        ),
        -1,
    )
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]]) * radii
    index = np.arange(len(rings) * _MERIDIANS).reshape(len(rings), _MERIDIANS)
    after = np.roll(index, -1, axis=1)
    sides = [(index[:-1], index[1:], after[1:]), (index[:-1], after[1:], after[:-1])]
    top, bottom = np.full(_MERIDIANS, index.size), np.full(_MERIDIANS, index.size + 1)
    sides += [(top, index[0], after[0]), (bottom, after[-1], index[-1])]
    return vertices.astype(np.float32), np.concatenate(
        [np.stack(side, -1).reshape(-1, 3) for side in sides]
    )


def _write_mesh(vertices: NDArray[np.float32], faces: NDArray[np.int64]) -> Path:
    """Return the path of an OBJ file of these triangles, written unless it exists."""
    lines = ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in vertices.tolist()]
    lines += ["f {} {} {}".format(*face) for face in (faces + 1).tolist()]
    content = ("\n".join(lines) + "\n").encode()
    folder = Path(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "batchpid", "meshes"
    )
    path = folder / f"{digest(content)[:32]}.obj"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not path.is_file() or path.read_bytes() != content:
            write_atomically(path, content)
    except OSError as error:
        problem = f"{path}: cannot be written: {error.strerror}"
        raise RobotError(
            f"{problem}; set XDG_CACHE_HOME to a folder for the hulls of meshes"
        ) from error
    return path
