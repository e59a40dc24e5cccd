"""SAPIEN as an :class:`batchpid.sim.engine.protocol.Engine`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

from batchpid.sim.engine.native.library import obstacle
from batchpid.sim.engine.physics import PHYSICS, Physics
from batchpid.sim.engine.protocol import Capability, Engine
from batchpid.sim.engine.sapien.building import scene_tree
from batchpid.sim.engine.sapien.pack import Pack
from batchpid.sim.engine.scene_spec import SceneSpec, Variation


class SapienEngine:
    """SAPIEN with PhysX on the CPU. Implements :class:`batchpid.sim.engine.protocol.Engine`."""

    name, title = "sapien", "SAPIEN"
    capabilities: frozenset[Capability] = frozenset(get_args(Capability)) - {"base_state"}
    physics: Mapping[str, Any] = PHYSICS
    group_size = 4

    def is_physics(self, settings: object) -> bool:
        """Return whether these are :class:`batchpid.sim.Physics`."""
        return isinstance(settings, Physics)

    def make_pack(
        self,
        spec: SceneSpec,
        size: int,
        first_env: int = 0,
        variation: Variation | None = None,
        carrier: str = "",
        links: Sequence[str] = (),
        workspace: dict[Any, Any] | None = None,
    ) -> Pack:
        """Return a new pack, with a PhysX system for each scene."""
        return Pack(spec, size, first_env, variation, carrier, links)

    native_obstacle = staticmethod(obstacle)
    scene_tree = staticmethod(scene_tree)


ENGINE: Engine = SapienEngine()
