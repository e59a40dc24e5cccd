"""Pictures of robots without a render device: triangles drawn by Matplotlib, the farthest from the camera first."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64, Rows
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.shapes import surfaces
from batchpid.sim.view.layout import FIELD_OF_VIEW, TILE, arrange_robots
from batchpid.task_space.rotations import placed, rotate

LIGHT = np.array([0.5, 0.2, 0.85]) / np.linalg.norm([0.5, 0.2, 0.85])
"""Direction to the light."""
_FLOOR, _GRID, _BACKGROUND = "#bdc6d3", "#d5dae2", "#f4f6f9"
_SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
"""Corners of a tile, in edges."""
_NEAREST = 0.05
"""Distance from the camera below which nothing is drawn [m]."""


class Triangles:
    """Triangles of a robot's surfaces, placed at any pose; ``deviation`` [m] is as in :func:`surfaces`."""

    def __init__(self, robot: Robot, deviation: float = 8e-3) -> None:
        self._surfaces, self._tree = surfaces(robot, deviation), robot.rigid_tree
        self._links = [self._tree.index(surface.link) for surface in self._surfaces]
        counts = [len(surface.faces) for surface in self._surfaces]
        self.colours: Float64 = np.repeat([surface.rgba[:3] for surface in self._surfaces], counts, axis=0)
        """Colours of the triangles of one robot (triangles, 3)."""

    def corners(self, qpos: Rows, positions: Float64, base_pose: Rows | None = None) -> Float64:
        """Return the corners (envs, triangles, 3, 3) [m] of robots at ``qpos`` (envs, dof), moved by ``positions``
        (envs, 3), with the poses (envs, 7) of floating bases.
        """
        poses = ts.link_poses(self._tree, qpos)[:, self._links]
        if base_pose is not None:
            poses = placed(base_pose.astype(np.float64)[:, None], poses)
        poses[..., :3] += positions[:, None]
        parts = [
            (rotate(pose[:, None, 3:], surface.vertices) + pose[:, None, :3])[:, surface.faces]
            for surface, pose in zip(self._surfaces, poses.swapaxes(0, 1), strict=True)
        ]
        return np.concatenate(parts, axis=1)


def paint(axes: Any, corners: Float64, colours: Float64, places: Float64, distance: Float64) -> None:
    """Draw triangles at ``places`` (triangles, 3, 2) of ``axes``, shaded, in the order of their ``distance``.

    ``corners`` (triangles, 3, 3) [m] give the shading, ``colours`` (triangles, 3) the colours in RGB, and ``distance``
    (triangles,) [m] the distance of the centers from the camera.
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    bright = 0.55 + 0.45 * np.clip(normals @ LIGHT, 0, 1)
    order = np.argsort(-distance)
    shaded = np.clip(colours * bright[:, None], 0, 1)[order]
    axes.add_collection(PolyCollection(list(places[order]), facecolors=shaded, edgecolors=shaded, linewidths=0.3))


class _Camera(NamedTuple):
    """Camera at ``eye`` (3,) [m]; the rows of ``axes`` (3, 3) are its directions to the right, up and forward."""

    eye: Float64
    axes: Float64

    def project(self, points: Float64) -> tuple[Float64, Float64]:
        """Return places (..., 2) in a picture whose upper edge is at 1, and depths (...) [m]."""
        seen = (points - self.eye) @ self.axes.T
        depth = seen[..., 2]
        scale = math.tan(FIELD_OF_VIEW / 2) * np.maximum(depth, _NEAREST)
        return seen[..., :2] / scale[..., None], depth


class PaintedScene:
    """Picture of ``count`` robots on a floor in given poses, as RenderScene has it without shadows and textures."""

    def __init__(self, robot: Robot, count: int, ground: bool) -> None:
        layout = arrange_robots(robot, 1, count, ground)
        self._triangles, self._positions, self._ground = Triangles(robot), layout.positions, ground
        forward = layout.target - layout.film_eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self._camera = _Camera(layout.film_eye, np.stack([right, np.cross(right, forward), forward]))
        low, high = layout.corners
        x, y = np.meshgrid(*(np.arange(low[axis], high[axis], TILE) for axis in (0, 1)))
        corners = [np.stack([x + a, y + b, 0 * x + layout.floor], -1) for a, b in TILE * np.array(_SQUARE)]
        self._tiles: Float64 = np.stack(corners, axis=2).reshape(-1, 4, 3)
        self._qpos = np.tile(robot.start, (count, 1))
        self._base_pose: Rows | None = None

    def place(self, qpos: Rows, base_pose: Rows | None = None) -> None:
        """Set the joint positions (envs, dof) [rad or m], and poses of floating bases (envs, 7).

        A robot with a number that is not finite keeps its pose.
        """
        self._qpos = np.where(np.isfinite(qpos).all(1, keepdims=True), qpos, self._qpos)
        if base_pose is not None:
            old = np.array([0, 0, 0, 1, 0, 0, 0.0]) if self._base_pose is None else self._base_pose
            self._base_pose = np.where(np.isfinite(base_pose).all(1, keepdims=True), base_pose, old)

    def add_camera(self, width: int, height: int) -> Callable[[], NDArray[np.uint8]]:
        """Return a function that returns the present picture (height, width, 3) in RGB."""

        def picture() -> NDArray[np.uint8]:
            figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor=_BACKGROUND)
            axes = figure.add_axes((0, 0, 1, 1))
            axes.set(xlim=(-width / height, width / height), ylim=(-1, 1))
            axes.axis("off")
            self._draw_floor(axes)
            corners = self._triangles.corners(self._qpos, self._positions, self._base_pose).reshape(-1, 3, 3)
            places, depth = self._camera.project(corners)
            seen = (depth > _NEAREST).all(1)
            colours = np.tile(self._triangles.colours, (len(self._qpos), 1))
            paint(axes, corners[seen], colours[seen], places[seen], depth[seen].mean(1))
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            return np.asarray(canvas.buffer_rgba())[..., :3].copy()

        return picture

    def _draw_floor(self, axes: Any) -> None:
        """Draw tiles if physics has a ground, otherwise a grid of lines."""
        places, depth = self._camera.project(self._tiles)
        face = _FLOOR if self._ground else "none"
        seen = places[(depth > _NEAREST).all(1)]
        axes.add_collection(PolyCollection(list(seen), facecolors=face, edgecolors=_GRID, linewidths=0.8))
