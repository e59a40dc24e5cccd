"""The robots in the browser: every surface is drawn once and placed many times.

One node of the page holds one surface of all robots, so a frame is two small arrays for each surface, whatever the
number of robots.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.robot.kinematics import Kinematics, Poses
from sim.robot.robot import Robot
from sim.robot.shapes import surfaces
from sim.view.data import Frame
from sim.view.layout import FIELD_OF_VIEW, stage

Float64 = NDArray[np.float64]

_GHOST = (70, 130, 255)
_DIVERGED = np.array([200, 40, 40], np.uint8)
_TINTS = (np.array([255, 255, 255]), np.array([255, 150, 40]), np.array([90, 200, 160]))
"""The colour towards which each group's robots lean, so that pid and drive are told apart."""
_LEAN = 0.5
_FLOOR = ((203, 211, 222), (189, 198, 211))
_TILE = 0.5
"""Edge of a tile of the floor [m]."""
_PIXELS = 16
"""Of the floor's picture, to a tile: its seams are blurred over one."""


class RobotScene:
    """``groups`` x ``per_group`` robots on a floor of ``server``."""

    def __init__(self, server: Any, robot: Robot, groups: tuple[str, ...], per_group: int) -> None:
        self._server, self._kinematics = server, Kinematics(robot)
        self._stage = stage(self._kinematics, robot, len(groups), per_group)
        self.places = self._stage.places
        self._groups = groups
        count = len(self.places)
        self._nodes, self._ghosts, self._links, self._colours = [], [], [], []
        still = np.zeros((count, 3), np.float32), np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
        for index, surface in enumerate(surfaces(robot, _deviation(count))):
            colours = _tinted(surface.rgba, len(groups), per_group)
            shape = (surface.vertices.astype(np.float32), surface.faces.astype(np.uint32))
            self._links.append(self._kinematics.index(surface.link))
            self._colours.append(colours)
            self._nodes.append(
                server.scene.add_batched_meshes_simple(
                    f"/robots/{index}",
                    *shape,
                    batched_wxyzs=still[1],
                    batched_positions=still[0],
                    batched_colors=colours,
                    opacity=None if surface.rgba[3] >= 1 else surface.rgba[3],
                    lod="off",
                )
            )
            self._ghosts.append(
                server.scene.add_batched_meshes_simple(
                    f"/setpoint/{index}",
                    *shape,
                    batched_wxyzs=still[1][:1],
                    batched_positions=still[0][:1],
                    batched_colors=_GHOST,
                    opacity=0.22,
                    lod="off",
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )
        self._ring = self._mark(self._stage.reach)
        self._ghost_of: tuple[Any, ...] | None = None
        self._ok = np.ones(count, bool)
        self._furnish(groups)

    def show(self, frame: Frame, selected: int, ghost: bool) -> None:
        """Place every robot, the ring under the selected one, and (``ghost``) its setpoint."""
        poses = self._kinematics.poses(frame.qpos)
        with self._server.atomic():
            self._place(self._nodes, poses, self.places)
            if (frame.ok != self._ok).any():
                self._ok = frame.ok.copy()
                for node, colours in zip(self._nodes, self._colours, strict=True):
                    node.batched_colors = np.where(self._ok[:, None], colours, _DIVERGED)
            wanted = (selected, ghost, frame.setpoint[selected].tobytes())
            if wanted != self._ghost_of:
                self._ghost_of = wanted
                self._ring.position = (*self.places[selected][:2], 0.004)
                for node in self._ghosts:
                    node.visible = ghost
                if ghost:
                    goal = self._kinematics.poses(frame.setpoint[selected][None])
                    self._place(self._ghosts, goal, self.places[selected][None])

    def on_click(self, select: Any) -> None:
        """Call ``select(robot)`` when a robot is clicked."""
        for node in self._nodes:
            node.on_click(lambda event: select(int(event.instance_index)))

    # -- inside ----------------------------------------------------------------------------------------------------

    def _place(self, nodes: list[Any], poses: Poses, places: Float64) -> None:
        position = (poses.position + places[:, None]).astype(np.float32)
        wxyz = poses.wxyz.astype(np.float32)
        for node, link in zip(nodes, self._links, strict=True):
            node.batched_positions = np.ascontiguousarray(position[:, link])
            node.batched_wxyzs = np.ascontiguousarray(wxyz[:, link])

    def _mark(self, reach: float) -> Any:
        """Return a flat ring, to lie under the selected robot."""
        segments, inner, outer = 48, 0.30 * reach, 0.335 * reach
        angle = 2 * math.pi * np.arange(segments) / segments
        circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        here = np.arange(segments)
        following = (here + 1) % segments
        faces = np.concatenate(
            [
                np.stack([here, here + segments, following + segments], 1),
                np.stack([here, following + segments, following], 1),
            ]
        )
        return self._server.scene.add_mesh_simple(
            "/selected",
            np.concatenate([inner * circle, outer * circle]),
            faces,
            color=_GHOST,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )

    def _furnish(self, groups: tuple[str, ...]) -> None:
        """Lay the floor, light it, name the groups, and stand the camera where all is seen."""
        reach = self._stage.reach
        scene = self._server.scene
        scene.set_up_direction("+z")
        # The environment map costs more than all robots where a browser draws in software.
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        scene.add_light_ambient("/lights/ambient", color=(235, 240, 255), intensity=1.3)
        # A picture takes no light, so it costs a third of what tiles of triangles do.
        picture, size, middle = _tiles(self.places, reach)
        scene.add_image(
            "/floor",
            picture,
            *size,
            format="png",
            position=(*middle, 0.0),
            cast_shadow=False,
            receive_shadow=False,
        )
        if len(groups) > 1:
            for group, places in zip(groups, np.split(self.places, len(groups)), strict=True):
                above = (places[:, 0].mean(), places[:, 1].mean(), 1.9 * reach)
                scene.add_label(f"/groups/{group}", group, position=above)
        camera = self._server.initial_camera
        camera.position, camera.look_at = tuple(self._stage.eye), tuple(self._stage.at)
        camera.fov = FIELD_OF_VIEW


def _deviation(robots: int) -> float:
    """Return how far from round to draw [m]: a browser without a GPU has to turn every vertex by itself."""
    return 5e-4 if robots <= 4 else 1.5e-3 if robots < 16 else 3e-3 if robots < 48 else 6e-3


def _tiles(places: Float64, reach: float) -> tuple[NDArray[np.uint8], Float64, Float64]:
    """Return a floor of tiles under all robots: its picture, its size (2,) and its middle (2,) [m]."""
    low = np.floor((places.min(0)[:2] - 2.0 * reach) / _TILE)
    high = np.ceil((places.max(0)[:2] + 2.0 * reach) / _TILE)
    columns, rows = (high - low).astype(int)
    light = np.indices((rows, columns)).sum(0) % 2 == 0
    picture = np.where(light[..., None], *(np.array(colour, np.uint8) for colour in _FLOOR))
    sharp = picture.repeat(_PIXELS, axis=0).repeat(_PIXELS, axis=1)
    return sharp, _TILE * (high - low), _TILE * (high + low) / 2


def _tinted(rgba: tuple[float, ...], groups: int, per_group: int) -> NDArray[np.uint8]:
    own = 255 * np.array(rgba[:3])
    rows = [own if group == 0 else own + _LEAN * (_TINTS[group % 3] - own) for group in range(groups)]
    return np.repeat(np.array(rows), per_group, axis=0).round().astype(np.uint8)
