"""Films of recorded runs, and SAPIEN's window.

Films are drawn by SAPIEN's renderer, which needs a Vulkan device, and without one by Matplotlib: as triangles, the
farthest from the camera first.
"""

from __future__ import annotations

import math
import os
import subprocess
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64, Rows
from batchpid.checks.validate import file_path, integer, number
from batchpid.errors import MissingDependencyError
from batchpid.io.files import replacing
from batchpid.sim.observation import Rollout
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.shapes import surfaces
from batchpid.sim.view import renderer
from batchpid.sim.view.layout import FIELD_OF_VIEW, MAX_ROBOTS, TILE, arrange_robots
from batchpid.sim.view.playback import Playback, rows_at
from batchpid.sim.view.renderer import RenderError, RenderScene, check_renderer
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
    """Picture of ``count`` robots on a floor in given poses, like that of RenderScene without shadows and textures."""

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


FORMATS = (".mp4", ".gif")
_ENCODERS = {
    ".mp4": ("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"),  # which halves both sides for colours
    ".gif": ("-vf", "split[a][b];[a]palettegen[p];[b][p]paletteuse", "-loop", "0"),
}
"""ffmpeg's options for each format."""


def write_film(
    rollout: Rollout,
    out: str | Path,
    *,
    robot: Robot | None = None,
    fps: float = 30.0,
    width: int = 960,
    height: int = 540,
    progress: Callable[[Any], Any] | None = None,
) -> Path:
    """Write a film of ``rollout`` in real time, all envs next to each other, and return its path.

    Where SAPIEN cannot render, Matplotlib draws the robots, plainer: see
    :func:`batchpid.sim.view.renderer.render_problem`.

    Parameters
    ----------
    out
        File that ends in .mp4 or .gif.
    robot
        Robot of the run; default the bundled one of its name.
    fps, width, height
        Frames per second; size in pixels.
    progress
        Wraps the rows that are filmed, e.g. ``tqdm.tqdm``.

    Raises
    ------
    InvalidArgumentError, RobotNotFoundError
        An argument is out of range, the run has another number of joints, or its robot is not bundled.
    MissingDependencyError
        The package imageio-ffmpeg is missing.
    RenderError
        The film cannot be written.
    """
    path = file_path("out", out, FORMATS)
    rate = number("fps", fps, 1.0, 120.0, "frames per second")
    size = integer("width", width, 16, 8192), integer("height", height, 16, 8192)
    integer("num_envs", rollout.num_envs, 1, MAX_ROBOTS)
    ffmpeg = _ffmpeg()
    recorded, kind = Playback(rollout, robot), PaintedScene if renderer.render_problem() else RenderScene
    scene = kind(recorded.robot, rollout.num_envs, recorded.ground)
    picture = scene.add_camera(*size)
    rows = film_rows(rollout, rate).tolist()

    def pictures() -> Iterable[NDArray[np.uint8]]:
        for row in rows if progress is None else progress(rows):
            scene.place(rollout.qpos[row], None if rollout.base_pose is None else rollout.base_pose[row])
            yield picture()

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            encode(pictures(), temporary, ffmpeg, size, rate)
    except OSError as error:
        raise RenderError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def encode(pictures: Iterable[NDArray[np.uint8]], path: Path, ffmpeg: str, size: tuple[int, int], fps: float) -> None:
    """Write RGB ``pictures`` (height, width, 3) of ``size`` (width, height) to a film, by the program ``ffmpeg``.

    Raises
    ------
    OSError
        ffmpeg failed; the error has its first message.
    """
    source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", "{}x{}".format(*size), "-r", f"{fps}", "-i", "-")
    command = [ffmpeg, "-v", "error", *source, *_ENCODERS[path.suffix.lower()], "-y", f"file:{path}"]
    with (
        open(os.memfd_create("batchpid-ffmpeg"), "w+b") as messages,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=messages) as process,
    ):
        assert process.stdin is not None
        try:
            for picture in pictures:
                try:
                    process.stdin.write(np.ascontiguousarray(picture).data)
                except BrokenPipeError:  # ffmpeg has ended, with a message
                    break
            with suppress(BrokenPipeError):
                process.stdin.close()
            process.wait()
        except BaseException:
            process.kill()
            with suppress(BrokenPipeError):
                process.stdin.close()
            raise
        if process.returncode:
            messages.seek(0)
            first = messages.readline().decode(errors="replace").strip()
            raise OSError(first.partition("] ")[2] or first or f"ffmpeg ended with status {process.returncode}")


def _ffmpeg() -> str:
    """Return the path of the program ffmpeg."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingDependencyError("imageio-ffmpeg", "a film", "render") from None
    try:
        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        raise RenderError(
            f"there is no program ffmpeg for a film ({error}); install it, or set IMAGEIO_FFMPEG_EXE"
        ) from None


def film_rows(rollout: Rollout, fps: float) -> NDArray[np.int64]:
    """Return the rows of ``rollout`` that a film shows at ``fps`` frames per second, (frames,)."""
    return rows_at(rollout, np.arange(0.0, rollout.time[-1] - rollout.time[0] + 0.5 / fps, 1 / fps))


def show_window(rollout: Rollout, *, robot: Robot | None = None, seconds: float | None = None) -> None:
    """Play ``rollout`` repeatedly in SAPIEN's window, until that is closed or for ``seconds`` of wall time.

    Raises
    ------
    RenderError
        This machine has no display, or SAPIEN cannot render on it.
    """
    check_renderer()
    from sapien.utils import Viewer

    recorded = Playback(rollout, robot)
    scene = RenderScene(recorded.robot, rollout.num_envs, recorded.ground)
    try:
        viewer = Viewer()
    except RuntimeError as error:
        raise RenderError(f"SAPIEN cannot open a window ({error}); set DISPLAY, or use batchpid view") from error
    viewer.set_scene(scene.scene)
    viewer.set_camera_pose(scene.camera_pose)
    viewer.window.set_camera_parameters(near=0.05, far=100.0, fovy=FIELD_OF_VIEW)
    began, duration = time.monotonic(), float(rollout.time[-1] - rollout.time[0])
    while not viewer.closed and (seconds is None or time.monotonic() - began < seconds):
        elapsed = (time.monotonic() - began) % (duration + 1.0)  # a pause of 1 s
        row = rows_at(rollout, elapsed)
        scene.place(rollout.qpos[row], None if rollout.base_pose is None else rollout.base_pose[row])
        viewer.render()
    viewer.close()
