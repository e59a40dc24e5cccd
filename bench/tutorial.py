"""SAPIEN's tutorial "Drive Robot with PID Controller", as written: reference of tests, baseline of
the benchmarks.

It has one robot in one scene, one Python object per joint, and one call after another. Only the
parts that need a display are left out. The objects are SAPIEN's, with its default settings. The
Runner does not use this module.
"""

from __future__ import annotations

import re
import tempfile
from typing import Any

import numpy as np

from batchpid.sim import Robot, to_urdf
from batchpid.sim.engine.sapien.user_content import HeadlessScene


class SimplePID:
    """u = kp e + ki I + kd (e - e') / dt, with I += e dt before, and e' = 0 at the start, hence a
    first kick.
    """

    def __init__(self, kp: float = 0.0, ki: float = 0.0, kd: float = 0.0) -> None:
        self.kp, self.ki, self.kd = kp, ki, kd
        self.integral = self.last_error = 0.0

    def compute(self, error: float, dt: float) -> float:
        """Return the effort for this error, ``dt`` seconds after the last."""
        self.integral += error * dt
        derivative = (error - self.last_error) / dt
        self.last_error = error
        return self.kp * error + self.ki * self.integral + self.kd * derivative


class TutorialLoop:
    """Scene and loop of the tutorial for one bundled robot, with SAPIEN's default friction and
    damping.

    ``external_pid`` and ``internal_drive`` are the tutorial's two switches. ``target`` and
    ``start`` are (dof,) [rad or m]; by default the start is the one in the robot's settings.
    """

    def __init__(
        self,
        robot: Robot,
        target: np.ndarray,
        *,
        external_pid: bool = True,
        internal_drive: bool = False,
        start: np.ndarray | None = None,
    ) -> None:
        settings = robot.settings
        self.scene = HeadlessScene()
        self.scene.set_timestep(1 / settings.rate_hz)
        self.scene.add_ground(0, render=False)
        loader = self.scene.create_urdf_loader()
        loader.fix_root_link = True
        with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
            # Without visuals, which need a render device.
            file.write(re.sub(r"<visual>.*?</visual>", "", to_urdf(robot).text, flags=re.DOTALL))
            file.flush()
            self.robot: Any = loader.load(file.name)
        self._gains = (
            list(zip(settings.kp, settings.ki, settings.kd, strict=True)) if external_pid else []
        )
        self._start, self.target = settings.start if start is None else start, target
        self.reset()
        if internal_drive:
            for joint, position in zip(self.robot.get_active_joints(), target, strict=True):
                joint.set_drive_property(
                    stiffness=settings.drive_stiffness, damping=settings.drive_damping
                )
                joint.set_drive_target(position)

    def reset(self) -> None:
        """Put the robot at rest at the start, with new PID objects."""
        self.robot.set_qpos(self._start)
        self.robot.set_qvel(np.zeros_like(self._start))
        self.pids = [SimplePID(*gains) for gains in self._gains]

    def step(self) -> None:
        """Make one sim step: passive force, one PID object per joint, set_qf, scene.step."""
        qf = self.robot.compute_passive_force(gravity=True, coriolis_and_centrifugal=True)
        if self.pids:
            errors, dt = self.target - self.robot.get_qpos(), self.scene.get_timestep()
            qf = qf + np.array(
                [pid.compute(error, dt) for pid, error in zip(self.pids, errors, strict=True)]
            )
        self.robot.set_qf(qf)
        self.scene.step()

    def run(self, steps: int) -> np.ndarray:
        """Make ``steps`` sim steps; return the last qpos (dof,) [rad or m]."""
        for _ in range(steps):
            self.step()
        return self.robot.get_qpos()
