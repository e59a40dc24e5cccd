"""Pictures of single envs for ``render_mode="rgb_array"``, drawn by SAPIEN's renderer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Rows
from batchpid.checks.validate import integer
from batchpid.errors import InvalidArgumentError
from batchpid.sim.observation import Observation
from batchpid.sim.robot.robot import Robot

RENDER_MODES = ["rgb_array"]


def check_render_mode(mode: Any, num_envs: int) -> str | None:
    """Return the render mode, None for no pictures.

    Raises
    ------
    InvalidArgumentError
        The mode is another one, or there are too many envs to draw.
    RenderError
        SAPIEN cannot render on this machine.
    """
    if mode is None:
        return None
    if mode not in RENDER_MODES:
        remedy = "use 'rgb_array', or watch robots in a browser with batchpid view"
        raise InvalidArgumentError("render_mode", "is not supported", value=mode, remedy=remedy)
    from batchpid.sim.view.layout import MAX_ROBOTS
    from batchpid.sim.view.renderer import check_renderer

    integer("num_envs", num_envs, 1, MAX_ROBOTS)
    check_renderer()
    return str(mode)


class EnvMetadata(dict[str, Any]):
    """Metadata of an env. Its "render_modes" are those of this machine, which is tested when they are first read."""

    def __getitem__(self, key: str) -> Any:
        if key == "render_modes" and not super().__contains__(key):
            from batchpid.sim.view.renderer import render_problem

            self[key] = list(RENDER_MODES) if render_problem() is None else []
        return super().__getitem__(key)

    def __contains__(self, key: object) -> bool:
        return key == "render_modes" or super().__contains__(key)

    def get(self, key: str, default: Any = None) -> Any:
        """Return the value of ``key``, or ``default``."""
        try:
            return self[key]
        except KeyError:
            return default


class EnvPictures:
    """Lit scene of each env, with its robot and the content of ``build``, and a camera of ``size`` (width, height)."""

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        ground: bool,
        build: Callable[[Any, int], Any] | None,
        size: tuple[int, int],
    ) -> None:
        from batchpid.sim.view.renderer import RenderScene

        self._scenes = [RenderScene(robot, 1, ground) for _ in range(num_envs)]
        self._cameras = [scene.add_camera(*size) for scene in self._scenes]
        for env, scene in enumerate(self._scenes):
            if build is not None:
                scene.add_content(build, env)

    def draw(self, observed: Observation, poses: Rows | None) -> tuple[NDArray[np.uint8], ...]:
        """Return a picture (height, width, 3) of each env at the observed joints and base, and content ``poses``."""
        pictures, base = [], observed.base_pose
        for env, (scene, camera) in enumerate(zip(self._scenes, self._cameras, strict=True)):
            if poses is not None:
                scene.place_content(poses[env])
            scene.place(observed.qpos[env : env + 1], None if base is None else base[env : env + 1])
            pictures.append(camera())
        return tuple(pictures)
