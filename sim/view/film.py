"""Films of recorded runs, and SAPIEN's window.

Films are drawn by SAPIEN's renderer, which needs a Vulkan device, and without one by Matplotlib.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.checks.validate import file_path, integer, number
from batchpid.errors import MissingDependencyError
from batchpid.io.files import replacing
from batchpid.sim.observation import Rollout
from batchpid.sim.robot.robot import Robot
from batchpid.sim.view import renderer
from batchpid.sim.view.layout import FIELD_OF_VIEW, MAX_ROBOTS
from batchpid.sim.view.painter import PaintedScene
from batchpid.sim.view.playback import Playback, rows_at
from batchpid.sim.view.renderer import RenderError, RenderScene, check_renderer

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
        There is no display, or SAPIEN cannot render on this machine.
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
