"""The closed loop over some packs of scenes: read, compensate, control, write, step.

The same code runs in a worker process and in the caller's. A group of envs runs all its substeps before the next
group, so that its working set stays in the cache; nothing depends on how envs are grouped.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from sim.engine.building import SceneSpec, parse
from sim.engine.pack import Pack
from sim.engine.variation import Variation, VariedPack
from sim.loop.arrays import Arrays, Command
from sim.loop.env_group import EnvGroup
from sim.loop.snapshot import EnvStates, Snapshot

COMPENSATE = {
    # name: (gravity, Coriolis and centrifugal)
    "gravity+coriolis": (True, True),
    "gravity": (True, False),
    "none": (False, False),
}
IN_STEP = 16
"""Envs that advance together: enough to share the cost of a call on arrays, few enough to stay in the cache."""


@dataclass(frozen=True)
class LoopSpec:
    """What a loop is built from, picklable. ``params`` holds one row, or one row for each of ``num_envs``."""

    scene: SceneSpec
    num_envs: int
    params: bp.PIDParams
    control: str = "pid"
    compensate: str = "gravity+coriolis"
    pack_size: int = 4
    first_env: int = 0
    variation: Variation | None = None
    on_fault: str = "hold"
    speed_limit: NDArray[np.float64] | None = None


class Loop:
    """The closed loop of ``spec.num_envs`` robots, which it builds.

    ``ticks`` is where it reads and writes, for each of the ticks that it may be told to run at once. What it does
    between ticks it tells in the first.
    """

    def __init__(self, spec: LoopSpec, ticks: list[Arrays]) -> None:
        self.spec, self.ticks = spec, ticks
        self._builder = parse(spec.scene)
        self._steps = 0
        size = max(IN_STEP // spec.pack_size, 1) * spec.pack_size
        starts = range(0, spec.num_envs, size)
        slices = [slice(start, min(start + size, spec.num_envs)) for start in starts]
        self.groups = [
            EnvGroup(
                self._build(envs),
                envs,
                spec.scene,
                spec.params.for_envs(envs),
                control=spec.control,
                compensate=COMPENSATE[spec.compensate],
                on_fault=spec.on_fault,
                speed_limit=spec.speed_limit,
            )
            for envs in slices
        ]

    def _build(self, envs: slice) -> Pack:
        spec, size = self.spec, envs.stop - envs.start
        if spec.variation is not None:
            first, variation = spec.first_env + envs.start, spec.variation.for_envs(envs)
            return VariedPack(self._builder, spec.scene, size, first, spec.pack_size, variation)
        return Pack(self._builder, spec.scene, size, spec.first_env + envs.start, spec.pack_size)

    def reset(self, mask: NDArray[np.bool_], qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> None:
        """Place the envs of ``mask`` (envs,) at ``qpos``, ``qvel`` (envs, dof), with a fresh controller state."""
        for group in self.groups:
            group.reset(mask[group.envs], qpos[group.envs], qvel[group.envs], self._steps)
            group.observe(self.ticks[0].for_envs(group.envs))

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times in flight; the controller's state is kept."""
        for group in self.groups:
            group.set_params(params.for_envs(group.envs))

    def run(self, ticks: int, substeps: int, use_rate: bool, use_feedforward: bool) -> float:
        """Run ``ticks`` of ``substeps`` sim steps under the commands in their arrays; returns the seconds it took."""
        began = time.perf_counter()
        for group in self.groups:
            for done, tick in enumerate(self.ticks[:ticks]):
                rows = tick.for_envs(group.envs)
                setpoint, rate, feedforward = rows.command
                command = Command(setpoint, rate if use_rate else None, feedforward if use_feedforward else None)
                group.run(self._steps + done * substeps, substeps, command)
                group.observe(rows)
        self._steps += ticks * substeps
        return time.perf_counter() - began

    def snapshot(self) -> EnvStates:
        """State of every env, physics and controller. It is a barrier: the loop goes on as if restored from it."""
        states = EnvStates.join([group.read() for group in self.groups])
        self._place(states)
        return states

    def restore(self, snapshot: Snapshot) -> None:
        """Put every env into the state that ``snapshot`` holds for it, with its params."""
        self._steps = snapshot.steps
        self.set_params(snapshot.params)
        self._place(snapshot.states)
        for group in self.groups:
            group.observe(self.ticks[0].for_envs(group.envs))

    def _place(self, states: EnvStates) -> None:
        # The engine's contact caches, and the order in which it solves contacts, depend on its past. Only a new
        # world has none.
        for group in self.groups:
            group.pack.close()
            group.write(self._build(group.envs), states.for_envs(group.envs))

    def content_sizes(self) -> list[int]:
        """How many numbers a snapshot holds of each env's content."""
        return [size for group in self.groups for size in group.pack.content_sizes()]

    def poses(self) -> list[NDArray[np.float32]]:
        """Poses of the entities that each env's content wants watched, (watched, 7) each."""
        return [rows for group in self.groups for rows in group.pack.read_poses()]

    def close(self) -> None:
        """Free the scenes."""
        for group in self.groups:
            group.pack.close()
        self.groups = []
