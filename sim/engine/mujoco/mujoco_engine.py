"""MuJoCo as an :class:`batchpid.sim.engine.protocol.Engine`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from batchpid.sim.engine.mujoco.mujoco_pack import MujocoPack
from batchpid.sim.engine.mujoco.mujoco_step import obstacle
from batchpid.sim.engine.physics import SOLVERS, MujocoSolver
from batchpid.sim.engine.protocol import Capability, Engine
from batchpid.sim.engine.robot_model import description_tree
from batchpid.sim.engine.scene_spec import SceneSpec, Variation
from batchpid.task_space.rigid_tree import RigidTree


class MujocoEngine:
    """MuJoCo on the CPU. Implements :class:`batchpid.sim.engine.protocol.Engine`."""

    name, title = "mujoco", "MuJoCo"
    capabilities: frozenset[Capability] = frozenset({"drive", "compiled_steps", "base_state"})
    physics: Mapping[str, Any] = SOLVERS
    group_size = 64

    native_obstacle = staticmethod(obstacle)

    def is_physics(self, settings: object) -> bool:
        """Return whether these are :class:`batchpid.sim.MujocoSolver`."""
        return isinstance(settings, MujocoSolver)

    def make_pack(
        self,
        spec: SceneSpec,
        size: int,
        first_env: int = 0,
        variation: Variation | None = None,
        carrier: str = "",
        links: Sequence[str] = (),
        workspace: dict[Any, Any] | None = None,
    ) -> MujocoPack:
        """Return a new pack."""
        return MujocoPack(spec, size, first_env, variation, carrier, links, workspace)

    def scene_tree(self, spec: SceneSpec) -> RigidTree:
        """Return the rigid tree of the robot of ``spec``."""
        return description_tree(spec)


ENGINE: Engine = MujocoEngine()
