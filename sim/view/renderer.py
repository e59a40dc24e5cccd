"""SAPIEN's renderer, which needs a Vulkan device: a test of whether it works, and a scene with robots."""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from batchpid.arrays.array_types import Rows, SapienScene
from batchpid.errors import BatchPIDError
from batchpid.sim.engine.native.library import import_sapien
from batchpid.sim.robot.robot import Robot
from batchpid.sim.view.layout import FIELD_OF_VIEW, TILE, RobotLayout, arrange_robots
from batchpid.task_space.rotations import from_rpy

sapien: Any = import_sapien()

_LINE = 4e-3
"""Half the width of a line of the grid [m]."""

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
REMEDY = (
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
        raise RenderError(f"SAPIEN cannot render on this machine ({problem}); {REMEDY}")


def add_floor(scene: SapienScene, layout: RobotLayout, ground: bool, material: Any) -> None:
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


class RenderScene:
    """Lit SAPIEN scene with ``count`` robots, which are placed and not simulated, on a floor: see :func:`add_floor`."""

    def __init__(self, robot: Robot, count: int, ground: bool) -> None:
        layout = arrange_robots(robot, 1, count, ground)
        eye = layout.film_eye
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
        self._positions, self._content = layout.positions, list[Any]()

    def add_camera(self, width: int, height: int) -> Callable[[], NDArray[np.uint8]]:
        """Return a function that returns the present picture (height, width, 3) in RGB."""
        camera = self.scene.add_camera("camera", width, height, FIELD_OF_VIEW, 0.05, 100.0)
        camera.entity.set_pose(self.camera_pose)

        def picture() -> NDArray[np.uint8]:
            camera.take_picture()
            colours = camera.get_picture("Color")[..., :3]
            return (255 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)

        return picture

    def add_content(self, build: Callable[[Any, int], Any], env: int) -> None:
        """Add the content of an env (the option ``build`` of a Runner), of one robot at the origin."""
        returned = build(self.scene, env)
        several = isinstance(returned, Iterable) and not isinstance(returned, str)
        self._content = [] if returned is None else list(returned) if several else [returned]

    def place_content(self, poses: Rows) -> None:
        """Set the poses (entities, 7) of what ``build`` returned: position [m], w, x, y, z. Links are the robot's."""
        for entity, pose in zip(self._content, poses, strict=True):
            if not isinstance(entity, str) and np.isfinite(pose).all():
                entity.set_pose(sapien.Pose(pose[:3], pose[3:]))

    def place(self, qpos: Rows, base_pose: Rows | None = None) -> None:
        """Set the joint positions (envs, dof) [rad or m], and poses of floating bases (envs, 7).

        A robot with a number that is not finite keeps its pose.
        """
        for env, (articulation, row) in enumerate(zip(self._articulations, qpos, strict=True)):
            if np.isfinite(row).all():
                articulation.set_qpos(row)
            if base_pose is not None and np.isfinite(base_pose[env]).all():
                pose = base_pose[env]
                articulation.set_root_pose(sapien.Pose(self._positions[env] + pose[:3], pose[3:]))
        self.scene.update_render()
