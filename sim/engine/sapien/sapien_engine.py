"""SAPIEN with PhysX on the CPU, as an :class:`batchpid.sim.engine.protocol.Engine`."""

from __future__ import annotations

from typing import get_args

from batchpid.sim.engine.native.library import obstacle
from batchpid.sim.engine.physics import PHYSICS
from batchpid.sim.engine.protocol import Capability, Engine
from batchpid.sim.engine.sapien.pack import Pack

ENGINE = Engine(
    name="sapien",
    title="SAPIEN",
    capabilities=frozenset(get_args(Capability)) - {"base_state"},
    physics=PHYSICS,
    group_size=4,
    make_pack=Pack,
    native_obstacle=obstacle,
)
