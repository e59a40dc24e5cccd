"""One robot that stands still, asked about its poses: dynamics, and what it touches."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sapien import physx

from sim.engine.building import SceneSpec, bare_scene, build_robot, engine_settings, parse
from sim.engine.contact_prediction import WORLD, Gap
from sim.engine.physics import PHYSICS
from sim.robot.description import RobotDescription

Float32 = NDArray[np.float32]


class Dynamics:
    """One robot by itself on a fixed base, asked about poses qpos (n, dof); nothing of it moves in time.

    The dynamics are Pinocchio's, on the model that SAPIEN derives.
    """

    def __init__(self, spec: SceneSpec) -> None:
        with engine_settings(spec):
            self._system = physx.PhysxCpuSystem()
            self._system.timestep = 1e-6
            self._scene = bare_scene(self._system)
            self._robot = build_robot(parse(spec), self._scene, spec)
            if spec.ground:
                self._scene.add_ground(0.0, render=False)
        self._dof = self._robot.dof
        self._model = self._robot.create_pinocchio_model()
        self._links = {link: place for place, link in enumerate(self._robot.links)}
        # Links that fixed joints tie together are one body; its number, per link name. The base and the ground are 0.
        self._body: dict[str, int] = {}
        for number, link in enumerate(self._robot.links):
            tied = link.parent is not None and link.joint.type == "fixed"
            self._body[link.name] = self._body[link.parent.name] if tied else number

    def mass_matrix(self, qpos: NDArray[Any]) -> NDArray[np.float64]:
        """Joint-space mass matrices (n, dof, dof) [kg m^2 or kg]."""
        matrices = np.empty((len(qpos), self._dof, self._dof))
        for matrix, row in zip(matrices, np.asarray(qpos, np.float64), strict=True):
            matrix[...] = self._model.compute_generalized_mass_matrix(row)
        return matrices

    def inverse_dynamics(self, qpos: NDArray[Any], qvel: NDArray[Any], qacc: NDArray[Any]) -> NDArray[np.float64]:
        """Efforts (n, dof) [N m or N] of a motion, gravity included, friction and damping left out."""
        rows = zip(*(np.asarray(table, np.float64) for table in (qpos, qvel, qacc)), strict=True)
        return np.array([self._model.compute_inverse_dynamics(*row) for row in rows])

    def forward_dynamics(self, qpos: NDArray[Any], qvel: NDArray[Any], effort: NDArray[Any]) -> NDArray[np.float64]:
        """Accelerations (n, dof) [rad/s^2 or m/s^2] under ``effort`` [N m or N], gravity included, damping left out."""
        rows = zip(*(np.asarray(table, np.float64) for table in (qpos, qvel, effort)), strict=True)
        return np.array([self._model.compute_forward_dynamics(*row) for row in rows])

    def touches(self, qpos: NDArray[Any], clearance: float = 0.0) -> NDArray[np.bool_]:
        """Whether links come nearer than ``clearance`` [m] to each other or to the ground (n,).

        Links that fixed joints tie together do not count, nor the base and what is tied to it with the ground.
        """
        return np.array([self._touches(row.astype(np.float32), clearance) for row in np.asarray(qpos)])

    def gaps(self, qpos: NDArray[Any]) -> list[Gap]:
        """Pairs of shapes that are near each other at one pose (dof,), as the engine lists them."""
        self._look(qpos.astype(np.float32))
        gaps = []
        for contact in self._system.get_contacts():
            first, second = (self._links.get(body, WORLD) for body in contact.bodies)
            gaps.append(Gap(first, second, min(point.separation for point in contact.points)))
        return gaps

    def _look(self, qpos: Float32) -> None:
        self._robot.set_qpos(qpos)
        self._robot.set_qvel(np.zeros_like(qpos))
        self._system.step()

    def _touches(self, qpos: Float32, clearance: float) -> bool:
        self._look(qpos)
        for contact in self._system.get_contacts():
            if len({self._body.get(body.entity.name, 0) for body in contact.bodies}) == 1:
                continue
            if any(point.separation < clearance for point in contact.points):
                return True
        return False


@lru_cache(maxsize=8)
def scene_dynamics(spec: SceneSpec) -> Dynamics:
    """Return the probe of this scene, built at most once."""
    return Dynamics(spec)


def robot_dynamics(robot: RobotDescription, ground: bool = True) -> Dynamics:
    """Return the dynamics of ``robot`` on a fixed base, with or without a ground at height 0."""
    return scene_dynamics(SceneSpec(robot.urdf, robot.srdf, robot.joints, 1e-3, PHYSICS["fast"], ground=ground))
