"""SAPIEN's tutorial "Drive Robot with PID Controller", as it is written there: the oracle and the baseline.

One robot in one scene, one Python object per joint, one call after another. Only what needs a display is left out. The
objects are SAPIEN's own, with its default settings; the Runner uses none of this.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.reference import SimplePID
from sim.engine.building import bare_scene
from sim.robot.robot import Robot


class TutorialLoop:
    """The tutorial's scene and loop for one bundled robot, with SAPIEN's default friction and damping.

    ``external_pid`` and ``internal_drive`` are the tutorial's two switches; ``target`` (dof,) [rad or m].
    """

    def __init__(
        self,
        robot: Robot,
        target: NDArray[np.float64],
        *,
        external_pid: bool = True,
        internal_drive: bool = False,
        start: NDArray[np.float64] | None = None,
    ) -> None:
        settings = robot.settings
        if settings is None:
            raise ValueError("the tutorial's loop needs a bundled robot, which carries the tutorial's gains")
        self.scene = bare_scene()
        self.scene.set_timestep(1 / settings.rate_hz)
        self.scene.add_ground(0, render=False)
        loader = self.scene.create_urdf_loader()
        loader.fix_root_link = True
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(robot.urdf)
            self.robot: Any = loader.load(str(path))
        self._gains = list(zip(settings.kp, settings.ki, settings.kd, strict=True)) if external_pid else []
        self.target = target
        self.reset(settings.start if start is None else start)
        if internal_drive:
            for joint, position in zip(self.robot.get_active_joints(), target, strict=True):
                joint.set_drive_property(stiffness=settings.drive_stiffness, damping=settings.drive_damping)
                joint.set_drive_target(position)

    def reset(self, qpos: NDArray[np.float64]) -> None:
        """Start anew from ``qpos`` (dof,), at rest."""
        self.robot.set_qpos(qpos)
        self.robot.set_qvel(np.zeros_like(qpos))
        self.pids = [SimplePID(*gains) for gains in self._gains]

    def step(self) -> None:
        """One sim step: passive force, one PID object per joint, set_qf, scene.step."""
        qf = self.robot.compute_passive_force(gravity=True, coriolis_and_centrifugal=True)
        if self.pids:
            qf = qf + self._pid_forward(self.robot.get_qpos(), self.scene.get_timestep())
        self.robot.set_qf(qf)
        self.scene.step()

    def run(self, steps: int, record: Callable[[NDArray[np.float32]], None] | None = None) -> NDArray[np.float32]:
        """``steps`` sim steps; ``record`` is given qpos after each. Returns the last qpos (dof,)."""
        for _ in range(steps):
            self.step()
            if record is not None:
                record(self.robot.get_qpos())
        return self.robot.get_qpos()

    def _pid_forward(self, position: NDArray[np.float32], dt: float) -> NDArray[np.float64]:
        errors = self.target - position
        return np.array([pid.compute(error, dt) for pid, error in zip(self.pids, errors, strict=True)])
