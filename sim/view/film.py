"""Pictures and films of robots, drawn by Matplotlib: as shaded triangles, the farthest from the
camera first.
"""

from __future__ import annotations

import math
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.transforms import Bbox, IdentityTransform
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64, Progress, Rows
from batchpid.checks import file_path
from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.io.files import replacing
from batchpid.sim.robot.robot import Robot
from batchpid.sim.rollout import Rollout
from batchpid.sim.view.scene import FIELD_OF_VIEW, TILE, RobotScene, Surface
from batchpid.sim.view.view_data import Playback, rows_at
from batchpid.task_space.frames import matrix_of, rotate

LIGHT = np.array([0.5, 0.2, 0.84])
"""Direction to the light."""
_TILES = np.array([[0.74, 0.78, 0.83], [0.79, 0.82, 0.87]])
"""Colours of the tiles of the floor, like a chess board's."""
_NEAREST = 0.05
"""Distance from the camera below which nothing is drawn [m]."""
_FARTHEST_POINT = 100.0
"""Distance from the middle of a picture beyond which nothing is drawn, in half heights."""
_CELL = 1.5
"""Edge of the cubes that keep one vertex of a mesh [pixels]."""
_NEARER = 0.85
"""Distance of the camera, as a share of that on the page, whose sides are covered by panels."""


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
        self._size = size
        self._eye = scene.target + _NEARER * (scene.eye - scene.target)
        distance = float(np.linalg.norm(scene.target - self._eye))
        forward = (scene.target - self._eye) / distance
        right = np.cross(forward, [0.0, 0.0, 1.0]) / np.linalg.norm(forward[:2])
        self._axes = np.stack([right, np.cross(right, forward), forward])  # right, up, forward
        pixel = 2 * math.tan(FIELD_OF_VIEW / 2) * distance / size[1]
        self._surfaces = [coarse(surface, _CELL * pixel) for surface in scene.surfaces]
        counts = [len(surface.faces) for surface in self._surfaces]
        colours = np.repeat([surface.rgba[:3] for surface in self._surfaces], counts, axis=0)
        self._colours = np.tile(colours, (count, 1))
        self._renderer: Any = RendererAgg(*size, 100)
        self._draw(*self._floor())
        self._background = self._renderer.copy_from_bbox(Bbox.from_bounds(0, 0, *size))

    def picture(self, qpos: Rows, base_pose: Rows | None = None) -> NDArray[np.uint8]:
        """Return the picture (height, width, 3) in RGB of robots in poses as for
        :meth:`RobotScene.place`.
        """
        self._renderer.restore_region(self._background)
        self._draw(self._corners(self._scene.place(qpos, base_pose)), self._colours)
        return np.asarray(self._renderer.buffer_rgba())[..., :3].copy()

    def _draw(self, corners: Float64, colours: Float64) -> None:
        """Draw triangles, ``corners`` (triangles, 3, 3) [m] and ``colours`` (triangles, 3), over the
        picture.
        """
        seen = (corners - self._eye) @ self._axes.T
        depth = seen[..., 2]
        scale = math.tan(FIELD_OF_VIEW / 2) * np.maximum(depth, _NEAREST)
        # Places in a picture whose upper edge is at 1.
        places = seen[..., :2] / scale[..., None]
        # A triangle far outside the picture, or of a pose that is not a number, is not drawn.
        near = (np.abs(places) < _FARTHEST_POINT).all(axis=(1, 2))
        visible = np.flatnonzero(near & (depth > _NEAREST).all(axis=1))
        order = visible[np.argsort(-depth[visible].mean(axis=1))]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        brightness = 0.55 + 0.45 * np.clip(normals @ LIGHT, 0, 1)
        # One colour at the three corners of a triangle.
        shades = np.ones((len(order), 3, 4))
        shades[..., :3] = np.clip(colours * brightness[:, None], 0, 1)[order, None]
        width, height = self._size
        points = places[order] * height / 2 + [width / 2, height / 2]
        context = self._renderer.new_gc()
        self._renderer.draw_gouraud_triangles(context, points, shades, IdentityTransform())

    def _floor(self) -> tuple[Float64, Float64]:
        """Return corners and colours of the floor's triangles: without a ground, of every second
        tile.
        """
        scene = self._scene
        counts = np.rint(2 * scene.half_floor / TILE).astype(int)
        tiles = np.argwhere(np.ones(counts.tolist()))
        if not scene.ground:
            tiles = tiles[tiles.sum(1) % 2 == 0]
        places = np.insert(TILE * tiles - scene.half_floor, 2, scene.floor, axis=1)
        halves = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[1, 1, 0], [0, 1, 0], [0, 0, 0]]])
        corners = (places[:, None, None] + TILE * halves).reshape(-1, 3, 3)
        return corners, _TILES[tiles.sum(1) % 2].repeat(2, axis=0)

    def _corners(self, poses: Float64) -> Float64:
        """Return the corners (triangles, 3, 3) [m] of all robots for the ``poses`` of their
        surfaces.
        """
        parts = []
        for surface, pose in zip(self._surfaces, poses.swapaxes(0, 1), strict=True):
            vertices = rotate(matrix_of(pose[:, None, 3:]), surface.vertices) + pose[:, None, :3]
            parts.append(vertices[:, surface.faces])
        return np.concatenate(parts, axis=1).reshape(-1, 3, 3)


def coarse(surface: Surface, cell: float) -> Surface:
    """Return a surface with one vertex in each cube of edge ``cell`` [m], and the triangles that
    remain.

    Published meshes have a hundred times as many triangles as a film can show. (Vertex clustering:
    J. Rossignac and P. Borrel, Multi-resolution 3D approximations for rendering complex scenes,
    1993.)
    """
    cubes = np.round((surface.vertices - surface.vertices.min(0)) / cell).astype(np.int64)
    sizes = cubes.max(0) + 1
    number = (cubes[:, 0] * sizes[1] + cubes[:, 1]) * sizes[2] + cubes[:, 2]
    _, first, place = np.unique(number, return_index=True, return_inverse=True)
    faces = place[surface.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    # Triangles of the same corners are drawn once.
    _, distinct = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return surface._replace(vertices=surface.vertices[first], faces=faces[np.sort(distinct)])


SIZE = (960, 540)
"""Width and height of a film [pixels]; the formats need even ones."""
FPS = 30.0
"""Frames of a film per second."""
MOST_FRAMES = 100_000
"""Largest number of frames of a film, nearly an hour."""
ENCODERS = {
    ".mp4": "-pix_fmt yuv420p",
    ".gif": "-vf split[a][b];[a]palettegen[p];[b][p]paletteuse -loop 0",
}
"""Options of ffmpeg for each format."""


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
    path = file_path("out", out, ENCODERS)
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

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for row in rows if progress is None else progress(rows):
            base = None
            if rollout.base_pose is not None:
                base = rollout.base_pose[row]
            yield painter.picture(rollout.qpos[row], base)

    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        encode(pictures(), temporary, get_ffmpeg_exe())
    return path


def encode(
    pictures: Iterable[NDArray[np.uint8]],
    path: Path,
    ffmpeg: str,
) -> None:
    """Write RGB ``pictures`` (height, width, 3) of :data:`SIZE` to a film, by the program
    ``ffmpeg``.
    """
    source = "-v error -f rawvideo -pix_fmt rgb24 -s {}x{} -r {} -i -".format(*SIZE, FPS)
    options = ENCODERS[path.suffix.lower()]
    command = [ffmpeg, *source.split(), *options.split(), "-y", f"file:{path}"]
    with tempfile.TemporaryFile() as messages:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=messages,
        )
        try:
            # The pipe breaks where ffmpeg has ended, with a message.
            with suppress(BrokenPipeError), cast("IO[bytes]", process.stdin) as pipe:
                for picture in pictures:
                    pipe.write(picture.tobytes())
        finally:
            # Its input is closed, so ffmpeg ends, also after Ctrl-C.
            status = process.wait()
        if status:
            messages.seek(0)
            text = messages.read().decode(errors="replace").strip()
            raise BatchPIDError(f"{path}: ffmpeg: {text}")
