"""Films of recorded runs and SAPIEN's window, drawn by SAPIEN's renderer, which needs a Vulkan device."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import BatchPIDError, MissingDependencyError
from batchpid.files import replacing
from batchpid.validate import file_path, integer, number
from sim.engine import sapien
from sim.observation import Rollout
from sim.robot.kinematics import Kinematics
from sim.robot.robot import Robot
from sim.robot.rotations import from_rpy
from sim.view.layout import FIELD_OF_VIEW, MAX_ROBOTS, arrange_robots
from sim.view.playback import rows_at

FORMATS = (".mp4", ".gif")
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
    """SAPIEN cannot render on this machine; the message gives the cause and the remedy."""


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
        The packages imageio and imageio-ffmpeg are missing.
    RenderError
        SAPIEN cannot render on this machine.
    """
    path = file_path("out", out, FORMATS)
    rate = number("fps", fps, 1.0, 120.0, "frames per second")
    size = integer("width", width, 16, 8192), integer("height", height, 16, 8192)
    integer("num_envs", rollout.num_envs, 1, MAX_ROBOTS)
    try:
        import imageio.v2 as imageio
        import imageio_ffmpeg  # noqa: F401 - imageio finds it for mp4
    except ImportError:
        raise MissingDependencyError("imageio-ffmpeg", "a film", "render") from None
    check_renderer()
    scene = _RenderScene(rollout, robot)
    camera = scene.scene.add_camera("film", *size, FIELD_OF_VIEW, 0.05, 100.0)
    camera.entity.set_pose(scene.camera_pose)
    rows = film_rows(rollout, rate).tolist()
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {"macro_block_size": 2} if path.suffix.lower() == ".mp4" else {"loop": 0}
    writer: Any
    with replacing(path) as temporary, imageio.get_writer(temporary, fps=rate, **options) as writer:
        for row in rows if progress is None else progress(rows):
            scene.place(rollout.qpos[row])
            camera.take_picture()
            picture = camera.get_picture("Color")[..., :3]
            writer.append_data((255 * np.clip(picture, 0.0, 1.0)).astype(np.uint8))
    return path


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


class _RenderScene:
    """Lit SAPIEN scene with the robots of a run, which are placed and not simulated."""

    def __init__(self, rollout: Rollout, robot: Robot | None) -> None:
        robot = Robot.load(rollout.info.robot) if robot is None else robot
        layout = arrange_robots(Kinematics(robot), robot, 1, rollout.num_envs)
        eye = layout.target + _CLOSER * (layout.camera - layout.target)
        x, y, z = layout.target - eye  # a camera looks along its x axis
        self.camera_pose = sapien.Pose(eye, from_rpy([0.0, math.atan2(-z, math.hypot(x, y)), math.atan2(y, x)]))
        self.scene = sapien.Scene()
        self.scene.set_ambient_light([0.38, 0.4, 0.45])
        self.scene.add_directional_light([0.4, 0.5, -1.0], [1.5, 1.45, 1.35], shadow=True, shadow_scale=8.0)
        material = sapien.render.RenderMaterial(base_color=[0.62, 0.66, 0.72, 1.0], roughness=0.9)
        self.scene.add_ground(0.0, render_material=material, render_half_size=[20, 20])
        loader = self.scene.create_urdf_loader()
        self._articulations = [loader.load(str(robot.path)) for _ in layout.positions]
        for articulation, position in zip(self._articulations, layout.positions, strict=True):
            articulation.set_root_pose(sapien.Pose(position))

    def place(self, qpos: NDArray[Any]) -> None:
        """Set the joint positions (envs, dof) [rad or m]; a robot with a non-finite one keeps its pose."""
        for articulation, row in zip(self._articulations, qpos, strict=True):
            if np.isfinite(row).all():
                articulation.set_qpos(row)
        self.scene.update_render()
