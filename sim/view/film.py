"""Films of recorded runs and SAPIEN's window, drawn by SAPIEN's renderer, which needs a Vulkan device."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from batchpid.checks.validate import file_path, integer, number
from batchpid.errors import BatchPIDError, MissingDependencyError
from batchpid.io.files import replacing
from batchpid.sim.engine.native.library import import_sapien
from batchpid.sim.observation import Rollout
from batchpid.sim.robot.kinematics import Kinematics
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.rotations import from_rpy
from batchpid.sim.view.layout import FIELD_OF_VIEW, MAX_ROBOTS, TILE, RobotLayout, arrange_robots
from batchpid.sim.view.playback import had_ground, rows_at

sapien: Any = import_sapien()

FORMATS = (".mp4", ".gif")
_ENCODERS = {
    ".mp4": ("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"),  # which halves both sides for colours
    ".gif": ("-vf", "split[a][b];[a]palettegen[p];[b][p]paletteuse", "-loop", "0"),
}
"""ffmpeg's options for each format."""
_LINE = 4e-3
"""Half the width of a line of the grid [m]."""
_CLOSER = 0.72
"""Distance of the camera as a share of that in the browser, where panels cover the sides of the picture."""

TEST_PROGRAM = """
import os, sapien
scene = sapien.Scene()
camera = scene.add_camera("test", 16, 16, 1.0, 0.1, 10.0)
scene.update_render()
camera.take_picture()
camera.get_picture("Color")
print("rendered", flush=True)
os._exit(0)
"""
"""Program that prints "rendered" where SAPIEN can render."""
_REMEDY = (
    "it needs a Vulkan driver: that of the GPU, or Mesa's software one, version 25 or newer (Debian 12: "
    "apt-get install -t bookworm-backports mesa-vulkan-drivers). Without one, look at the same in a browser: "
    "batchpid view"
)


class RenderError(BatchPIDError, RuntimeError):
    """SAPIEN cannot render on this machine, or a film cannot be written; the message gives the cause."""


@cache
def render_problem(program: str = TEST_PROGRAM) -> str | None:
    """Return the reason why SAPIEN cannot render on this machine, or None if it can.

    The test runs once, in a child process, because a failed attempt can kill its process.
    """
    try:
        result = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return "a first picture took more than 120 s"
    if "rendered" in result.stdout:
        return None
    lines = result.stderr.strip().splitlines()
    return lines[-1] if lines else f"the test ended with status {result.returncode}"


def check_renderer() -> None:
    """Raise :class:`RenderError` unless SAPIEN can render on this machine."""
    if (problem := render_problem()) is not None:
        raise RenderError(f"SAPIEN cannot render on this machine ({problem}); {_REMEDY}")


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
        An argument is out of range, or the robot of the run is not bundled.
    MissingDependencyError
        The package imageio-ffmpeg is missing.
    RenderError
        SAPIEN cannot render on this machine, or the film cannot be written.
    """
    path = file_path("out", out, FORMATS)
    rate = number("fps", fps, 1.0, 120.0, "frames per second")
    size = integer("width", width, 16, 8192), integer("height", height, 16, 8192)
    integer("num_envs", rollout.num_envs, 1, MAX_ROBOTS)
    ffmpeg = _ffmpeg()
    check_renderer()
    scene = _RenderScene(rollout, robot)
    camera = scene.scene.add_camera("film", *size, FIELD_OF_VIEW, 0.05, 100.0)
    camera.entity.set_pose(scene.camera_pose)
    rows = film_rows(rollout, rate).tolist()

    def pictures() -> Iterable[NDArray[np.uint8]]:
        for row in rows if progress is None else progress(rows):
            scene.place(rollout.qpos[row])
            camera.take_picture()
            picture = camera.get_picture("Color")[..., :3]
            yield (255 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)

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
        There is no display, or SAPIEN cannot render on this machine.
    """
    check_renderer()
    from sapien.utils import Viewer

    scene = _RenderScene(rollout, robot)
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
        scene.place(rollout.qpos[rows_at(rollout, elapsed)])
        viewer.render()
    viewer.close()


def add_floor(scene: Any, layout: RobotLayout, ground: bool, material: Any) -> None:
    """Add a floor to a SAPIEN scene: a plane if physics has a ``ground``, otherwise a grid of lines."""
    if ground:
        scene.add_ground(layout.floor, render_material=material, render_half_size=[20, 20])
        return
    builder, (low, high) = scene.create_actor_builder(), layout.corners
    center, half = (low + high) / 2, (high - low) / 2
    for axis in (0, 1):
        for at in np.arange(low[axis], high[axis] + TILE / 2, TILE):
            position, size = np.array([*center, layout.floor]), np.array([*half, _LINE])
            position[axis], size[axis] = at, _LINE
            builder.add_box_visual(sapien.Pose(position), size, material)
    builder.build_kinematic(name="grid")


@contextmanager
def _drawn_file(robot: Robot) -> Iterator[str]:
    """Yield the path of a URDF to draw: the robot's own or, for one from an MJCF file, its collision shapes."""
    if robot.defaults is None:
        yield str(robot.path)
        return
    root = etree.fromstring(robot.urdf.encode())
    for collision in root.iter("collision"):
        collision.tag = "visual"
    with tempfile.NamedTemporaryFile("wb", suffix=".urdf") as file:
        file.write(etree.tostring(root))
        file.flush()
        yield file.name


class _RenderScene:
    """Lit SAPIEN scene with the robots of a run, which are placed and not simulated."""

    def __init__(self, rollout: Rollout, robot: Robot | None) -> None:
        robot = Robot.load(rollout.info.robot) if robot is None else robot
        ground = had_ground(rollout, robot)
        layout = arrange_robots(Kinematics(robot), robot, 1, rollout.num_envs, ground)
        eye = layout.target + _CLOSER * (layout.camera - layout.target)
        x, y, z = layout.target - eye  # a camera looks along its x axis
        self.camera_pose = sapien.Pose(eye, from_rpy([0.0, math.atan2(-z, math.hypot(x, y)), math.atan2(y, x)]))
        self.scene = sapien.Scene()
        self.scene.set_ambient_light([0.38, 0.4, 0.45])
        self.scene.add_directional_light([0.4, 0.5, -1.0], [1.5, 1.45, 1.35], shadow=True, shadow_scale=8.0)
        material = sapien.render.RenderMaterial(base_color=[0.62, 0.66, 0.72, 1.0], roughness=0.9)
        add_floor(self.scene, layout, ground, material)
        loader = self.scene.create_urdf_loader()
        with _drawn_file(robot) as path:
            self._articulations = [loader.load(path) for _ in layout.positions]
        for articulation, position in zip(self._articulations, layout.positions, strict=True):
            articulation.set_root_pose(sapien.Pose(position))

    def place(self, qpos: NDArray[Any]) -> None:
        """Set the joint positions (envs, dof) [rad or m]; a robot with a non-finite one keeps its pose."""
        for articulation, row in zip(self._articulations, qpos, strict=True):
            if np.isfinite(row).all():
                articulation.set_qpos(row)
        self.scene.update_render()
