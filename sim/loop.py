"""The closed loop over some packs of scenes: read, compensate, control, write, step.

The same code runs in a worker process and in the caller's. A pack runs all its substeps before the next pack, so
that its working set stays in the cache; nothing depends on how envs are grouped.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.inertia import advance_with_mass_matrix, per_inertia
from batchpid.markers import PerMassMatrix

from .scenes import Pack, SceneSpec, parse, probe

COMPENSATE = {
    # name: (gravity, Coriolis and centrifugal)
    "gravity+coriolis": (True, True),
    "gravity": (True, False),
    "none": (False, False),
}
CONTROLS = ("pid", "drive", "effort")
IN_STEP = 16
"""Envs that advance together: enough to share the cost of a call on arrays, few enough to stay in the cache."""
INERTIA_EVERY = 5
"""Sim steps after which a mass matrix counts as old within a tick."""


@dataclass(frozen=True)
class LoopSpec:
    """What a loop is built from, picklable. ``params`` holds one row, or one row for each of ``num_envs``."""

    scene: SceneSpec
    num_envs: int
    params: bp.PIDParams
    control: str = "pid"
    compensate: str = "gravity+coriolis"
    measurement_rate: bool = False
    pack_size: int = 4
    first_env: int = 0


class Arrays(NamedTuple):
    """What goes in and out of a loop, one row per env: (envs, dof), ``ok`` (envs,).

    ``setpoint`` [rad or m] is the effort [N m or N] under control "effort"; ``setpoint_rate`` and ``feedforward``
    count only when a tick says so. ``effort`` and ``saturated`` are those of the last substep.
    """

    setpoint: NDArray[np.float64]
    setpoint_rate: NDArray[np.float64]
    feedforward: NDArray[np.float64]
    qpos: NDArray[np.float32]
    qvel: NDArray[np.float32]
    effort: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    ok: NDArray[np.bool_]

    @staticmethod
    def layout(num_envs: int, dof: int) -> dict[str, tuple[tuple[int, ...], Any]]:
        """Name -> (shape, dtype) of every field."""
        table = (num_envs, dof)
        doubles = ("setpoint", "setpoint_rate", "feedforward")
        return (
            {name: (table, np.float64) for name in doubles}
            | {name: (table, np.float32) for name in ("qpos", "qvel", "effort")}
            | {"saturated": (table, np.bool_), "ok": ((num_envs,), np.bool_)}
        )

    def rows(self, envs: slice) -> Arrays:
        """Views of some envs."""
        return Arrays._make(field[envs] for field in self)


class Loop:
    """The closed loop of ``spec.num_envs`` robots, which it builds. ``arrays`` is where it reads and writes."""

    def __init__(self, spec: LoopSpec, arrays: Arrays) -> None:
        self.spec, self.arrays = spec, arrays
        builder = parse(spec.scene)
        size = max(IN_STEP // spec.pack_size, 1) * spec.pack_size
        starts = range(0, spec.num_envs, size)
        slices = [slice(start, min(start + size, spec.num_envs)) for start in starts]
        self.cells = [
            _Cell(
                Pack(
                    builder, spec.scene, envs.stop - envs.start, spec.first_env + envs.start, spec.pack_size
                ),
                envs,
                spec,
            )
            for envs in slices
        ]
        self.set_params(spec.params)

    def reset(self, mask: NDArray[np.bool_], qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> None:
        """Place the envs of ``mask`` (envs,) at ``qpos``, ``qvel`` (envs, dof), with a fresh controller state."""
        for cell in self.cells:
            cell.reset(mask[cell.envs], qpos[cell.envs], qvel[cell.envs])
            cell.observe(self.arrays.rows(cell.envs))

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times in flight; the controller's state is kept."""
        for cell in self.cells:
            cell.set_params(params.for_envs(cell.envs))

    def tick(self, substeps: int, use_rate: bool, use_feedforward: bool) -> float:
        """Run ``substeps`` sim steps under the commands in ``arrays``; returns the seconds it took."""
        began = time.perf_counter()
        for cell in self.cells:
            rows = self.arrays.rows(cell.envs)
            cell.run(
                substeps,
                rows.setpoint,
                rows.setpoint_rate if use_rate else None,
                rows.feedforward if use_feedforward else None,
            )
            cell.observe(rows)
        return time.perf_counter() - began

    def poses(self) -> list[NDArray[np.float32]]:
        """Poses of the entities that each env's content wants watched, (watched, 7) each."""
        return [rows for cell in self.cells for rows in cell.pack.read_poses()]

    def close(self) -> None:
        """Free the scenes."""
        for cell in self.cells:
            cell.pack.close()
        self.cells = []


class _Cell:
    """One pack, its rows of the parameters, and its controller's state."""

    def __init__(self, pack: Pack, envs: slice, spec: LoopSpec) -> None:
        self.pack, self.envs = pack, envs
        self._dt = spec.scene.timestep
        self._scene = replace(spec.scene, build=None)
        self._gravity, self._coriolis = COMPENSATE[spec.compensate]
        self._measurement_rate = spec.measurement_rate
        self._control = spec.control
        self._run: Callable[..., None] = getattr(self, f"_run_{spec.control}")
        self._params: bp.PIDParams = spec.params
        self._coefficients: Any = None
        self._state: Any = None
        self._qpos = pack.read_qpos()
        self._saturated: NDArray[np.bool_] = np.zeros((pack.size, pack.dof), bool)

    def set_params(self, params: bp.PIDParams) -> None:
        self._params = params
        self._coefficients = bp.discretise(params, self._dt, self.pack.size)
        if self._control == "pid":
            self._run = self._run_pid
            if params.gain_units is not None:
                self._run, self._mass_matrix = self._run_pid_inertia, probe(self._scene).mass_matrix
        if self._control == "drive":
            effort_max = np.inf if params.effort_max is None else params.effort_max
            self.pack.write_drive(
                np.asarray(params.kp),
                np.asarray(0.0 if params.kd is None else params.kd),
                np.asarray(effort_max),
            )

    def reset(self, mask: NDArray[np.bool_], qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> None:
        rows = np.flatnonzero(mask)
        self.pack.write_state(rows.tolist(), qpos[rows], qvel[rows])
        self._qpos = self.pack.read_qpos()
        self._saturated[rows] = False
        if self._state is None:
            self._state = bp.init(self._params, self._qpos)
        else:
            self._state = bp.reset(self._params, self._state, self._qpos, mask)

    def run(self, substeps: int, *command: NDArray[np.float64] | None) -> None:
        self._run(substeps, *command)

    def observe(self, rows: Arrays) -> None:
        rows.qpos[...] = self._qpos
        rows.qvel[...] = self.pack.read_qvel(np.float32)
        rows.effort[...] = self.pack.qf
        rows.saturated[...] = self._saturated
        rows.ok[...] = np.isfinite(rows.qpos).all(1) & np.isfinite(rows.qvel).all(1)

    def _passive(self) -> NDArray[np.float64] | None:
        if not self._gravity:
            return None
        return self.pack.passive_force(self._gravity, self._coriolis)

    def _run_pid(
        self,
        substeps: int,
        setpoint: NDArray[np.float64],
        setpoint_rate: NDArray[np.float64] | None,
        feedforward: NDArray[np.float64] | None,
    ) -> None:
        """qf = sat(PID(setpoint, qpos) + passive force + feedforward), at every sim step."""
        pack, coefficients, state, qpos = self.pack, self._coefficients, self._state, self._qpos
        aux: list[bp.Terms] = []
        for left in range(substeps - 1, -1, -1):
            passive = self._passive()
            if feedforward is not None:
                passive = feedforward if passive is None else passive + feedforward
            qvel = pack.read_qvel() if self._measurement_rate else None
            state, effort, *aux = bp.advance(
                coefficients, state, setpoint, qpos, qvel, setpoint_rate, passive, aux=left == 0
            )
            pack.write_qf(effort)
            pack.step()
            qpos = pack.read_qpos()
        self._saturated = aux[0].saturated
        self._state, self._qpos = state, qpos

    def _run_pid_inertia(
        self,
        substeps: int,
        setpoint: NDArray[np.float64],
        setpoint_rate: NDArray[np.float64] | None,
        feedforward: NDArray[np.float64] | None,
    ) -> None:
        """As :meth:`_run_pid`, with gains per unit of inertia; the mass matrix is kept for some substeps."""
        pack, coefficients, state, qpos = self.pack, self._coefficients, self._state, self._qpos
        whole = isinstance(self._params.gain_units, PerMassMatrix)
        aux: list[bp.Terms] = []
        for done in range(substeps):
            if done % INERTIA_EVERY == 0:
                matrix = self._mass_matrix(qpos)
                k = (
                    coefficients
                    if whole
                    else per_inertia(coefficients, np.diagonal(matrix, axis1=1, axis2=2))
                )
            passive = self._passive()
            if feedforward is not None:
                passive = feedforward if passive is None else passive + feedforward
            qvel = pack.read_qvel() if self._measurement_rate else None
            last = done == substeps - 1
            if whole:
                state, effort, *aux = advance_with_mass_matrix(
                    k, state, setpoint, qpos, matrix, qvel, setpoint_rate, passive, aux=last
                )
            else:
                state, effort, *aux = bp.advance(
                    k, state, setpoint, qpos, qvel, setpoint_rate, passive, aux=last
                )
            pack.write_qf(effort)
            pack.step()
            qpos = pack.read_qpos()
        self._saturated = aux[0].saturated
        self._state, self._qpos = state, qpos

    def _run_drive(
        self,
        substeps: int,
        setpoint: NDArray[np.float64],
        setpoint_rate: NDArray[np.float64] | None,
        feedforward: NDArray[np.float64] | None,
    ) -> None:
        """PhysX's drive with stiffness kp and damping kd; qf = passive force + feedforward."""
        pack = self.pack
        pack.write_drive_target(setpoint, np.zeros_like(setpoint) if setpoint_rate is None else setpoint_rate)
        for _ in range(substeps):
            passive = self._passive()
            if feedforward is not None:
                passive = feedforward if passive is None else passive + feedforward
            if passive is not None:
                pack.write_qf(passive)
            pack.step()
        self._qpos = pack.read_qpos()

    def _run_effort(
        self,
        substeps: int,
        command: NDArray[np.float64],
        setpoint_rate: NDArray[np.float64] | None,
        feedforward: NDArray[np.float64] | None,
    ) -> None:
        """qf = sat(the caller's effort + passive force + feedforward)."""
        pack, low, high = self.pack, self._params.effort_min, self._params.effort_max
        wanted = command if feedforward is None else command + feedforward
        total = wanted
        for _ in range(substeps):
            passive = self._passive()
            total = wanted if passive is None else wanted + passive
            pack.write_qf(total if low is None or high is None else np.minimum(np.maximum(total, low), high))
            pack.step()
        if low is not None and high is not None:
            self._saturated = (total < low) | (total > high)
        self._qpos = pack.read_qpos()
