"""Workload of the benchmarks: robots and motion, the same in every case; and the interface of a
case.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from batchpid.sim import Robot, Runner
from batchpid.sim.engine.scene_spec import PHYSICS, SceneSpec

TIMESTEP = 1 / 2000
"""Time step of simulation and control [s]."""
DISTANCE = 0.3
"""Distance of the start from the target, per joint [rad]."""
MOVED = 0.01
"""Least motion in a round of each joint that starts away from its target [rad]: SAPIEN's friction
slows some.
"""


@dataclass(frozen=True)
class Workload:
    """Bundled robots that move from ``start`` to ``target`` in ``ticks`` of ``substeps`` sim steps,
    in ``rounds``.
    """

    robot: Robot
    num_envs: int = 64
    workers: int = 2
    physics: str = "accurate"
    substeps: int = 20
    ticks: int = 100
    rounds: int = 5

    @property
    def target(self) -> np.ndarray:
        """Setpoint of every case (dof,) [rad or m]."""
        return self.robot.target

    @property
    def start(self) -> np.ndarray:
        """Start of every case (dof,) [rad or m]: ``DISTANCE`` below the target, on joints whose
        limits allow it.
        """
        away = self.target - DISTANCE
        roomy = (self.robot.upper - self.robot.lower > 1.0) & (away > self.robot.lower)
        return np.where(roomy, away, self.target)

    @property
    def moving(self) -> np.ndarray:
        """Joints that start away from their target (dof,), bool."""
        return self.start != self.target

    @property
    def steps(self) -> int:
        """Sim steps of one round, per env."""
        return self.ticks * self.substeps

    @property
    def processes(self) -> int:
        """Number of stepping processes: the workers, or this process."""
        return max(self.workers, 1)

    def simulated_robot(self, engine: str = "sapien") -> Robot:
        """Return the robot: in SAPIEN with SAPIEN's own friction and damping, as in the tutorial's
        loop.
        """
        return Robot.load(self.robot.path, dissipation="sapien" if engine == "sapien" else "urdf")

    def weightless_scene(self, collisions: bool = True) -> SceneSpec:
        """Return the scene in SAPIEN without gravity: a drive reaches the target without
        compensation.
        """
        robot = self.simulated_robot()
        options: dict[str, Any] = {
            "dissipation": robot.source.dissipation,
            "collisions": collisions,
            "ground": collisions,
        }
        spec = SceneSpec(
            robot.tables,
            robot.self_contact.ignored,
            robot.joints,
            TIMESTEP,
            PHYSICS[self.physics],
            **options,
        )
        return replace(spec, gravity=(0.0, 0.0, 0.0))

    def runner(self, **options: Any) -> Runner:
        """Return a runner of the robots with the tutorial's gains."""
        robot = self.simulated_robot(options.get("engine", "sapien"))
        ours = {
            "engine": "sapien",
            "physics": self.physics,
            "substeps": self.substeps,
            "timestep": TIMESTEP,
            "workers": self.workers,
        }
        return Runner(robot, self.num_envs, params=robot.params(), **ours | options)

    def check_motion(self, case: str, final: np.ndarray) -> None:
        """Raise RuntimeError unless the robot at ``final`` (dof,) has moved from the start towards
        the target.
        """
        moved, left = (np.abs(final - place)[self.moving] for place in (self.start, self.target))
        if not np.isfinite(final).all() or moved.min() < MOVED or left.max() > DISTANCE:
            raise RuntimeError(
                f"case {case!r}: the robots did not move as they should (moved {moved.round(3)},"
                f" left {left.round(3)}); its speed would mean nothing: run more ticks"
            )


class Case(NamedTuple):
    """Way of stepping the robots of a workload."""

    env_steps: int
    """Env-steps of one round."""
    reset: Callable[[], object]
    """Puts the robots at the start."""
    run: Callable[[], np.ndarray]
    """Steps one round; returns the final positions of the first env (dof,) [rad or m]."""
    close: Callable[[], None]
    """Ends processes and frees scenes; may be called again."""
    processes: int
    """Number of stepping processes, or threads."""


def run_round(case: Case) -> tuple[float, np.ndarray]:
    """Run one round of ``case``; return the seconds of stepping and the final positions of the
    first env (dof,).
    """
    case.reset()
    began = time.perf_counter()
    final = case.run()
    return time.perf_counter() - began, final.astype(np.float64)
