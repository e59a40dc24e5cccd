"""MuJoCo on the CPU, as an :class:`batchpid.sim.engine.protocol.Engine`."""

from __future__ import annotations

from batchpid.sim.engine.mujoco.mujoco_pack import MujocoPack
from batchpid.sim.engine.mujoco.mujoco_step import obstacle
from batchpid.sim.engine.physics import SOLVERS
from batchpid.sim.engine.protocol import Engine

ENGINE = Engine(
    name="mujoco",
    title="MuJoCo",
    capabilities=frozenset({"drive", "compiled_steps", "base_state"}),
    physics=SOLVERS,
    group_size=64,
    make_pack=MujocoPack,
    native_obstacle=obstacle,
)
