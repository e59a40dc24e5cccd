"""Robots in the browser. Every surface is one node of the page that is placed once for each robot.

A frame is therefore two small arrays for each surface, for any number of robots.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Document, Float64, Rows
from batchpid.sim.observation import Rollout
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.shapes import Surface, surfaces
from batchpid.sim.view.layout import FIELD_OF_VIEW, TILE, RobotLayout, arrange_robots
from batchpid.task_space.rotations import placed

_SETPOINT_COLOUR = (70, 130, 255)
_DIVERGED_COLOUR = np.array([200, 40, 40], np.uint8)
_TINT, _TINT_SHARE = np.array([255, 150, 40]), 0.5
"""Colour mixed into the colours of the second group's robots, and its share."""
_FLOOR_COLOURS = np.array([[189, 198, 211], [203, 211, 222]], np.uint8)
_TILE_PIXELS = 16
"""Edge of a tile in the floor's picture, in which tiles blend over one pixel."""
_NO_SHADOW = {"cast_shadow": False, "receive_shadow": False}
_SETPOINT_STYLE = {"batched_colors": _SETPOINT_COLOUR, "opacity": 0.22, **_NO_SHADOW}


class RobotScene:
    """``per_group`` robots for each of ``groups``, on the floor of a viser ``server``.

    The floor is tiled if physics has a ``ground``; otherwise it is a grid at the height of the lowest link.
    """

    def __init__(self, server: Any, robot: Robot, groups: tuple[str, ...], per_group: int, ground: bool) -> None:
        self._server, self._tree = server, robot.rigid_tree
        self.layout = arrange_robots(robot, len(groups), per_group, ground)
        count = len(self.layout.positions)
        self.findings: list[Finding] = []
        """Meshes that cannot be read. Their links are drawn by the collision shapes, or not at all."""
        self._robots: list[Any] = []
        self._setpoints: list[Any] = []
        self._links: list[int] = []
        self._colours: list[NDArray[np.uint8]] = []
        # A browser without a GPU transforms every vertex in software: the more robots, the coarser.
        deviation = 5e-4 if count <= 4 else 1.5e-3 if count < 16 else 3e-3 if count < 48 else 6e-3  # [m]
        for index, surface in enumerate(surfaces(robot, deviation, self.findings)):
            colours = _group_colours(surface.rgba, len(groups), per_group)
            opacity = surface.rgba[3] if surface.rgba[3] < 1 else None
            node = self._add_surface(f"/robots/{index}", surface, count, batched_colors=colours, opacity=opacity)
            self._robots.append(node)
            self._setpoints.append(self._add_surface(f"/setpoint/{index}", surface, 1, **_SETPOINT_STYLE))
            self._links.append(self._tree.index(surface.link))
            self._colours.append(colours)
        self._shown_setpoint: tuple[Any, ...] | None = None
        self._ok = np.ones(count, bool)
        self._add_surroundings(groups, ground)

    def update(self, frame: Rollout, selected: int, show_setpoint: bool) -> None:
        """Place every robot, the ring under the selected one, and its setpoint if that is shown and is a pose."""
        positions, ok = self.layout.positions, frame.ok[0]
        with self._server.atomic():
            base = None if frame.base_pose is None else frame.base_pose[0]
            self._place(self._robots, frame.qpos[0], positions, base)
            if (ok != self._ok).any():
                self._ok = ok
                for node, colours in zip(self._robots, self._colours, strict=True):
                    node.batched_colors = np.where(ok[:, None], colours, _DIVERGED_COLOUR)
            setpoint = frame.setpoint[0, selected]
            show_setpoint = show_setpoint and frame.info.sets_positions
            if (shown := (selected, show_setpoint, setpoint.tobytes())) != self._shown_setpoint:
                self._shown_setpoint = shown
                self._ring.position = (*positions[selected][:2], self.layout.floor + 0.004)
                for node in self._setpoints:
                    node.visible = show_setpoint
                if show_setpoint:
                    own = None if base is None else base[[selected]]
                    self._place(self._setpoints, setpoint[None], positions[selected][None], own)

    def on_click(self, select: Callable[[Any], None]) -> None:
        """Call ``select(robot)`` when a robot is clicked, with the number that the page sent."""

        async def clicked(event: Any) -> None:
            select(event.instance_index)

        for node in self._robots:
            node.on_click(clicked)

    def _add_surface(self, path: str, surface: Surface, copies: int, **options: Any) -> Any:
        return self._server.scene.add_batched_meshes_simple(
            path,
            surface.vertices.astype(np.float32),
            surface.faces.astype(np.uint32),
            batched_wxyzs=np.tile(np.array([1, 0, 0, 0], np.float32), (copies, 1)),
            batched_positions=np.zeros((copies, 3), np.float32),
            lod="off",
            **options,
        )

    def _place(self, nodes: list[Any], qpos: Rows, positions: Float64, base: Rows | None) -> None:
        poses = ts.link_poses(self._tree, qpos)
        if base is not None:
            poses = placed(base.astype(np.float64)[:, None], poses)
        position, wxyz = (poses[..., :3] + positions[:, None]).astype(np.float32), poses[..., 3:].astype(np.float32)
        for node, link in zip(nodes, self._links, strict=True):
            node.batched_positions = np.ascontiguousarray(position[:, link])
            node.batched_wxyzs = np.ascontiguousarray(wxyz[:, link])

    def _add_surroundings(self, groups: tuple[str, ...], ground: bool) -> None:
        """Add floor, lights, the ring under the selected robot, labels of the groups, and set the camera."""
        import trimesh  # installed with viser

        scene, layout = self._server.scene, self.layout
        scene.set_up_direction("+z")
        # Where a browser draws in software, the environment map costs more than all robots.
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        scene.add_light_ambient("/lights/ambient", color=(235, 240, 255), intensity=1.3)
        low, high = layout.corners
        place: Document = {"position": (*(low + high) / 2, layout.floor)}
        if ground:  # an image is not lit and costs a third of tiles made of triangles
            scene.add_image("/floor", _tiles(layout), *(high - low), format="png", **place, **_NO_SHADOW)
        else:
            scene.add_grid("/floor", *(high - low), cell_size=TILE, section_size=2 * TILE, shadow_opacity=0.0, **place)
        ring = trimesh.creation.annulus(0.30 * layout.reach, 0.335 * layout.reach, height=1e-3, sections=48)
        self._ring = scene.add_mesh_simple("/selected", ring.vertices, ring.faces, color=_SETPOINT_COLOUR, **_NO_SHADOW)
        if len(groups) > 1:
            for group, positions in zip(groups, np.split(layout.positions, len(groups)), strict=True):
                x, y, _ = positions.mean(0)
                scene.add_label(f"/groups/{group}", group, position=(x, y, layout.floor + 1.9 * layout.reach))
        camera = self._server.initial_camera
        camera.position, camera.look_at = tuple(layout.camera), tuple(layout.target)
        camera.fov = FIELD_OF_VIEW


def _tiles(layout: RobotLayout) -> NDArray[np.uint8]:
    """Return the picture of a tiled floor under all robots."""
    low, high = layout.corners
    columns, rows = np.rint((high - low) / TILE).astype(int)
    tiles = (np.indices((rows, columns)).sum(0) + 1) % 2
    pixels = np.kron(tiles, np.ones((_TILE_PIXELS, _TILE_PIXELS), int))
    return _FLOOR_COLOURS[pixels]


def _group_colours(rgba: tuple[float, ...], groups: int, per_group: int) -> NDArray[np.uint8]:
    """Return the colour of a surface on every robot (robots, 3), tinted in the second group."""
    own = 255 * np.array(rgba[:3])
    rows = [own, own + _TINT_SHARE * (_TINT - own)][:groups]
    return np.repeat(rows, per_group, axis=0).round().astype(np.uint8)
