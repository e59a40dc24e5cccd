"""Pictures and films of robots, drawn by Matplotlib as shaded triangles."""

from __future__ import annotations

import math
from operator import itemgetter
from pathlib import Path
from subprocess import CalledProcessError
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64, Progress, Rows
from batchpid.checks import file_path
from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.io.files import imported, replacing
from batchpid.sim.robot.robot import Robot
from batchpid.sim.rollout import Rollout
from batchpid.sim.view.scene import TILE, RobotScene, Surface
from batchpid.sim.view.view_data import Playback, rows_at
from batchpid.task_space.frames import matrix_of, rotate

LIGHT = LightSource(azdeg=68, altdeg=57)
"""Light from the side of the camera."""
_TILES = np.array([[0.74, 0.78, 0.83], [0.79, 0.82, 0.87]])
"""Colours of the tiles of the floor, like a chess board's."""
_TILE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
"""Corners of a tile."""
_CELL = 1.5
"""Edge of the cubes that keep one vertex of a mesh [pixels]."""
_NEARER = 0.85
"""Distance of the camera, as a share of that on the page, whose sides are covered by panels."""
_FOCAL_LENGTH = 0.12
"""Focal length of Matplotlib's camera."""
_HALF_BOX = 0.46
"""Half the edge of the box that the axes show, over the distance of a camera of that focal length
from its middle.
"""
_DPI = 100.0
"""Pixels of a picture to an inch of Matplotlib's."""
_NEAREST = 0.05
"""Distance from the camera below which nothing is drawn [m]."""


class Painter:
    """Camera of ``size`` (width, height) [pixels] on a scene of ``count`` robots."""

    def __init__(
        self,
        robot: Robot,
        count: int,
        ground: bool,
        size: tuple[int, int],
    ) -> None:
        self._scene = scene = RobotScene(robot, count, ground, segments=12)
        view = _NEARER * (scene.eye - scene.target)
        self._distance = float(np.linalg.norm(view))
        self._direction = view / self._distance
        half = _HALF_BOX * self._distance
        x, y, z = self._direction.tolist()
        # The axes are square, as wide as the picture.
        width, height = size
        self.figure = Figure((width / _DPI, height / _DPI), _DPI)
        self._canvas = FigureCanvasAgg(self.figure)
        square = (0, (1 - width / height) / 2, 1, width / height)
        self._axes = Axes3D(self.figure, square, computed_zorder=False)
        self.figure.add_axes(self._axes)
        self._axes.set_axis_off()
        self._axes.set_proj_type("persp", _FOCAL_LENGTH)
        self._axes.view_init(math.degrees(math.asin(z)), math.degrees(math.atan2(y, x)))
        box = np.stack([scene.target - half, scene.target + half], axis=1)
        self._axes.set(xlim=box[0], ylim=box[1], zlim=box[2], box_aspect=(1, 1, 1))
        self._draw_floor()
        self._surfaces = [coarse(surface, _CELL * 2 * half / width) for surface in scene.surfaces]
        counts = [len(surface.faces) for surface in self._surfaces]
        colours = np.repeat([surface.rgba[:3] for surface in self._surfaces], counts, axis=0)
        self._colours = np.tile(colours, (count, 1))
        self._robots: Any = None

    def show(self, qpos: Rows, base_pose: Rows | None = None) -> None:
        """Draw robots into :attr:`figure`, in poses as for :meth:`RobotScene.place`."""
        if self._robots is not None:
            self._robots.remove()
        poses = self._scene.place(qpos, base_pose)
        parts = []
        for surface, pose in zip(self._surfaces, poses.swapaxes(0, 1), strict=True):
            vertices = rotate(matrix_of(pose[:, None, 3:]), surface.vertices) + pose[:, None, :3]
            parts.append(vertices[:, surface.faces])
        corners = np.concatenate(parts, axis=1).reshape(-1, 3, 3)
        self._robots = self._draw(corners, self._colours)

    def picture(self, qpos: Rows, base_pose: Rows | None = None) -> NDArray[np.uint8]:
        """Return the picture (height, width, 3) in RGB of robots in poses as for :meth:`show`."""
        self.show(qpos, base_pose)
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _draw_floor(self) -> None:
        """Draw the tiles of the floor: without a ground, every second one."""
        scene = self._scene
        counts = np.rint(2 * scene.half_floor / TILE).astype(int)
        tiles = np.argwhere(np.ones(counts.tolist()))
        if not scene.ground:
            tiles = tiles[tiles.sum(1) % 2 == 0]
        places = np.insert(TILE * tiles - scene.half_floor, 2, scene.floor, axis=1)
        self._draw(places[:, None] + TILE * _TILE, _TILES[tiles.sum(1) % 2])

    def _draw(self, corners: Float64, colours: Float64) -> Any:
        """Draw polygons, ``corners`` (polygons, corners, 3) [m] and ``colours`` (polygons, 3), in
        front of those before, and return them.
        """
        depth = self._distance - (corners - self._scene.target) @ self._direction
        # Matplotlib would draw what is behind the camera upside down.
        seen = (depth > _NEAREST).all(axis=1)
        polygons = Poly3DCollection(
            corners[seen],
            facecolors=colours[seen],
            shade=True,
            lightsource=LIGHT,
            antialiased=False,
        )
        return self._axes.add_collection3d(polygons)


def coarse(surface: Surface, cell: float) -> Surface:
    """Return a surface with one vertex in each cube of edge ``cell`` [m], and the triangles that
    remain: published meshes have a hundred times as many as a film can show.
    """
    mesh = imported("trimesh").Trimesh(surface.vertices / cell, surface.faces, process=False)
    mesh.merge_vertices(digits_vertex=0)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    return surface._replace(vertices=cell * mesh.vertices, faces=mesh.faces)


SIZE = (960, 540)
"""Width and height of a film [pixels]; the formats need even ones."""
FPS = 30
"""Frames of a film per second."""
MOST_FRAMES = 100_000
"""Largest number of frames of a film, nearly an hour."""
CODECS = {".mp4": "h264", ".gif": "gif"}
"""Codec of each format."""


def write_film(
    rollout: Rollout,
    out: str | Path,
    *,
    robot: Robot | None = None,
    progress: Progress[int] | None = None,
) -> Path:
    """Write a film of ``rollout`` in real time, all envs next to each other, and return its path.

    Parameters
    ----------
    out
        File that ends in .mp4 or .gif.
    robot
        Robot of the run; default :func:`batchpid.sim.view.view_data.recorded_robot`.
    progress
        Wraps the rows that are filmed, e.g. ``tqdm.tqdm``.

    Raises
    ------
    InvalidArgumentError
        Another suffix, a run that is too long, has another number of joints, or has no robot.
    MissingDependencyError
        The package imageio-ffmpeg is missing.
    BatchPIDError
        ffmpeg failed.
    """
    path = file_path("out", out, CODECS)
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError:
        raise MissingDependencyError("imageio-ffmpeg", "a film", "view") from None
    recorded = Playback(rollout, robot)
    painter = Painter(recorded.robot, rollout.num_envs, recorded.ground, SIZE)
    if not recorded.duration * FPS <= MOST_FRAMES:
        problem = f"lasts {recorded.duration:g} s, more than {MOST_FRAMES} frames"
        remedy = "film a part: rollout.for_ticks(start, stop)"
        raise InvalidArgumentError("rollout", problem, remedy=remedy)
    times = np.arange(0.0, recorded.duration + 0.5 / FPS, 1 / FPS)
    rows = rows_at(rollout, times).tolist()
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = FFMpegWriter(FPS, CODECS[path.suffix.lower()])
    try:
        with (
            replacing(path) as temporary,
            rc_context({"animation.ffmpeg_path": get_ffmpeg_exe()}),
            writer.saving(painter.figure, str(temporary), _DPI),
        ):
            for row in rows if progress is None else progress(rows):
                seen = rollout.observation.map(itemgetter(row))
                painter.show(seen.qpos, seen.base_pose)
                writer.grab_frame()
    except CalledProcessError as error:
        # Ctrl-C ends ffmpeg, too.
        if isinstance(error.__context__, KeyboardInterrupt):
            raise error.__context__ from None
        raise BatchPIDError(f"{path}: ffmpeg: {error.stderr.strip()}") from error
    return path
