"""SAPIEN's own renderer, where it works: films of rollouts, and its window.

It needs a Vulkan device. Whether there is one is tried in a child process, because a failed try can take the process
down with it. This module shows what was simulated elsewhere; it never steps a scene.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.validate import integer, number
from sim.engine.user_content import sapien
from sim.observation import Rollout
from sim.robot.kinematics import Kinematics
from sim.robot.robot import Robot
from sim.view.layout import FIELD_OF_VIEW, Stage, stage

MOST = 64
"""Robots in a film."""
FORMATS = (".mp4", ".gif")
_NEARER = 0.72
"""A film is wide and has no panels at its sides: the camera comes nearer than in the browser."""

_PROBE = """
import os, sapien
scene = sapien.Scene()
camera = scene.add_camera("probe", 16, 16, 1.0, 0.1, 10.0)
scene.update_render()
camera.take_picture()
camera.get_picture("Color")
print("rendered", flush=True)
os._exit(0)
"""
_REMEDY = (
    "it needs a Vulkan driver: that of the GPU, or Mesa's software one, version 25 or newer (Debian 12: "
    "apt-get install -t bookworm-backports mesa-vulkan-drivers). Without one, look at the same in a browser: "
    "batchpid view"
)


class RenderError(BatchPIDError, RuntimeError):
    """SAPIEN cannot render here; the message says why, and what to do."""


@cache
def problem() -> str | None:
    """Return what keeps SAPIEN from rendering on this machine, or None; tried once, in a child process."""
    try:
        tried = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return "a first picture took more than 120 s"
    if "rendered" in tried.stdout:
        return None
    last = [line for line in tried.stderr.splitlines() if line.strip()][-1:]
    return last[0] if last else f"it ended with status {tried.returncode}"


def check_renderer() -> None:
    """Raise :class:`RenderError` unless SAPIEN can render here."""
    if (found := problem()) is not None:
        raise RenderError(f"SAPIEN cannot render on this machine ({found}); {_REMEDY}")


def film(
    rollout: Rollout,
    robot: Robot,
    out: str | Path,
    *,
    fps: float = 30.0,
    width: int = 960,
    height: int = 540,
    progress: Any = None,
) -> Path:
    """Film ``rollout`` of ``robot``, all envs side by side, in real time; returns the path of the film.

    Parameters
    ----------
    out
        Ends in .mp4 or .gif.
    fps, width, height
        Frames a second; pixels.
    progress
        Wraps the range of frames, e.g. ``tqdm.tqdm``.

    Raises
    ------
    InvalidArgumentError
        An argument out of range.
    MissingDependencyError
        Without imageio and imageio-ffmpeg.
    RenderError
        SAPIEN cannot render here.
    """
    path = Path(out)
    if path.suffix not in FORMATS:
        raise InvalidArgumentError("out", "unknown format", value=str(path), remedy=f"end it in {' or '.join(FORMATS)}")
    rate = number("fps", fps, 1.0, 120.0, "frames a second")
    size = tuple(integer(name, value, 16, 8192) for name, value in (("width", width), ("height", height)))
    integer("num_envs", rollout.qpos.shape[1], 1, MOST)
    try:
        import imageio.v2 as imageio
        import imageio_ffmpeg  # noqa: F401 - imageio finds it for mp4
    except ImportError:
        raise MissingDependencyError("imageio-ffmpeg", "a film", "render") from None
    check_renderer()
    show = _Show(robot, rollout.qpos.shape[1])
    camera = show.add_camera(*size)
    rows = _rows(rollout, 1 / rate)
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {"macro_block_size": 2} if path.suffix == ".mp4" else {"loop": 0}
    writer: Any
    with imageio.get_writer(path, fps=rate, **options) as writer:
        for row in rows if progress is None else progress(rows):
            show.place(rollout.qpos[row])
            camera.take_picture()
            picture = camera.get_picture("Color")[..., :3]
            writer.append_data((255 * np.clip(picture, 0.0, 1.0)).astype(np.uint8))
    return path


def window(rollout: Rollout, robot: Robot, *, seconds: float | None = None) -> None:
    """Play ``rollout`` again and again in SAPIEN's window, until that is closed (or for ``seconds``).

    Raises
    ------
    RenderError
        There is no display, or SAPIEN cannot render here.
    """
    check_renderer()
    from sapien.utils import Viewer

    show = _Show(robot, rollout.qpos.shape[1])
    try:
        viewer = Viewer()
    except RuntimeError as error:
        raise RenderError(f"SAPIEN cannot open a window ({error}); set DISPLAY, or use batchpid view") from error
    viewer.set_scene(show.scene)
    viewer.set_camera_pose(_looking(show.stage))
    viewer.window.set_camera_parameters(near=0.05, far=100.0, fovy=FIELD_OF_VIEW)
    began = time.monotonic()
    for row in _again(rollout, began):
        if viewer.closed or (seconds is not None and time.monotonic() - began > seconds):
            break
        show.place(rollout.qpos[row])
        viewer.render()
    viewer.close()


def _rows(rollout: Rollout, period: float) -> NDArray[np.int64]:
    """Return the rows that are shown at a frame every ``period`` seconds."""
    when = np.arange(rollout.time[0], rollout.time[-1] + period / 2, period)
    return np.searchsorted(rollout.time, when - 1e-9).clip(0, len(rollout.time) - 1)


def _again(rollout: Rollout, began: float) -> Iterator[int]:
    """Yield the row of the present moment, over and over, with a second's rest at the end."""
    length = float(rollout.time[-1] - rollout.time[0])
    while True:
        now = (time.monotonic() - began) % (length + 1.0)
        yield int(np.searchsorted(rollout.time - rollout.time[0], now).clip(0, len(rollout.time) - 1))


class _Show:
    """A lit scene with N robots that are only placed."""

    def __init__(self, robot: Robot, count: int) -> None:
        self.stage: Stage = stage(Kinematics(robot), robot, 1, count)
        self.scene = sapien.Scene()
        self.scene.set_ambient_light([0.38, 0.4, 0.45])
        self.scene.add_directional_light([0.4, 0.5, -1.0], [1.5, 1.45, 1.35], shadow=True, shadow_scale=8.0)
        material = sapien.render.RenderMaterial(base_color=[0.62, 0.66, 0.72, 1.0], roughness=0.9)
        self.scene.add_ground(0.0, render_material=material, render_half_size=[20, 20])
        loader = self.scene.create_urdf_loader()
        loader.fix_root_link = True
        self._robots = []
        for place in self.stage.places:
            articulation = loader.load(str(robot.path))
            articulation.set_root_pose(sapien.Pose(place))
            self._robots.append(articulation)

    def add_camera(self, width: int, height: int) -> Any:
        """Return a camera that sees all robots."""
        camera = self.scene.add_camera("film", width, height, FIELD_OF_VIEW, 0.05, 100.0)
        camera.entity.set_pose(_looking(self.stage))
        return camera

    def place(self, qpos: NDArray[Any]) -> None:
        """Show the robots at ``qpos`` (envs, dof); one that is not finite stays as it is."""
        for articulation, row in zip(self._robots, qpos, strict=True):
            if np.isfinite(row).all():
                articulation.set_qpos(row)
        self.scene.update_render()


def _looking(view: Stage) -> Any:
    """Return the pose of a camera (x forward, y left, z up) at the stage's eye."""
    eye = view.at + _NEARER * (view.eye - view.at)
    forward = (view.at - eye) / np.linalg.norm(view.at - eye)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([forward, left, np.cross(forward, left)], axis=1)
    matrix[:3, 3] = eye
    return sapien.Pose(matrix)
