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

from .faults import Containment, finite
from .scenes import Pack, SceneSpec, parse, probe
from .snapshot import EnvStates, Snapshot

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
    on_fault: str = "hold"
    speed_limit: NDArray[np.float64] | None = None


class Arrays(NamedTuple):
    """What goes in and out of a loop, one row per env: (envs, dof), ``ok`` (envs,).

    ``setpoint`` [rad or m] is the effort [N m or N] under control "effort"; ``setpoint_rate`` and ``feedforward``
    count only when a tick says so. ``effort`` and ``saturated`` are those of the last substep. ``fault_step`` is the
    sim step in which the env failed (-1: it did not), ``fault_joint`` where, ``fault_cause`` an index into
    :data:`sim.faults.CAUSES`.
    """

    setpoint: NDArray[np.float64]
    setpoint_rate: NDArray[np.float64]
    feedforward: NDArray[np.float64]
    qpos: NDArray[np.float32]
    qvel: NDArray[np.float32]
    effort: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    ok: NDArray[np.bool_]
    fault_step: NDArray[np.int64]
    fault_joint: NDArray[np.int64]
    fault_cause: NDArray[np.int64]

    @staticmethod
    def layout(num_envs: int, dof: int) -> dict[str, tuple[tuple[int, ...], Any]]:
        """Name -> (shape, dtype) of every field."""
        table = (num_envs, dof)
        doubles = ("setpoint", "setpoint_rate", "feedforward")
        return (
            {name: (table, np.float64) for name in doubles}
            | {name: (table, np.float32) for name in ("qpos", "qvel", "effort")}
            | {"saturated": (table, np.bool_), "ok": ((num_envs,), np.bool_)}
            | {name: ((num_envs,), np.int64) for name in ("fault_step", "fault_joint", "fault_cause")}
        )

    def rows(self, envs: slice) -> Arrays:
        """Views of some envs."""
        return Arrays._make(field[envs] for field in self)


class Loop:
    """The closed loop of ``spec.num_envs`` robots, which it builds. ``arrays`` is where it reads and writes."""

    def __init__(self, spec: LoopSpec, arrays: Arrays) -> None:
        self.spec, self.arrays = spec, arrays
        self._builder = parse(spec.scene)
        self._steps = 0
        size = max(IN_STEP // spec.pack_size, 1) * spec.pack_size
        starts = range(0, spec.num_envs, size)
        slices = [slice(start, min(start + size, spec.num_envs)) for start in starts]
        self.cells = [_Cell(self._build(envs), envs, spec) for envs in slices]
        self.set_params(spec.params)

    def _build(self, envs: slice) -> Pack:
        spec, size = self.spec, envs.stop - envs.start
        return Pack(self._builder, spec.scene, size, spec.first_env + envs.start, spec.pack_size)

    def reset(self, mask: NDArray[np.bool_], qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> None:
        """Place the envs of ``mask`` (envs,) at ``qpos``, ``qvel`` (envs, dof), with a fresh controller state."""
        for cell in self.cells:
            cell.reset(mask[cell.envs], qpos[cell.envs], qvel[cell.envs], self._steps)
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
                self._steps,
                substeps,
                rows.setpoint,
                rows.setpoint_rate if use_rate else None,
                rows.feedforward if use_feedforward else None,
            )
            cell.observe(rows)
        self._steps += substeps
        return time.perf_counter() - began

    def snapshot(self) -> EnvStates:
        """State of every env, physics and controller. It is a barrier: the loop goes on as if restored from it."""
        states = EnvStates.join([cell.read() for cell in self.cells])
        self._place(states)
        return states

    def restore(self, snapshot: Snapshot) -> None:
        """Put every env into the state that ``snapshot`` holds for it, with its params."""
        self._steps = snapshot.steps
        self.set_params(snapshot.params)
        self._place(snapshot.states)
        for cell in self.cells:
            cell.observe(self.arrays.rows(cell.envs))

    def _place(self, states: EnvStates) -> None:
        # The engine's contact caches, and the order in which it solves contacts, depend on its past. Only a new
        # world has none.
        for cell in self.cells:
            cell.pack.close()
            cell.write(self._build(cell.envs), states.for_envs(cell.envs))

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
        self._damping = np.array([joint.damping for joint in spec.scene.joints])
        self._gravity, self._coriolis = COMPENSATE[spec.compensate]
        self._measurement_rate = spec.measurement_rate
        self._control = spec.control
        self._run: Callable[..., None] = getattr(self, f"_run_{spec.control}")
        self._params: bp.PIDParams = spec.params
        self._coefficients: Any = None
        self._state: Any = None
        self._qpos = pack.read_qpos()
        self._saturated: NDArray[np.bool_] = np.zeros((pack.size, pack.dof), bool)
        self._watch = Containment(pack.size, pack.dof, spec.on_fault, spec.speed_limit)
        self._steps = 0

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

    def reset(
        self, mask: NDArray[np.bool_], qpos: NDArray[np.float64], qvel: NDArray[np.float64], steps: int
    ) -> None:
        watch = self._watch
        bad = {cause: mask[:, None] & ~np.isfinite(rows) for cause, rows in (("qpos", qpos), ("qvel", qvel))}
        lost = (bad["qpos"] | bad["qvel"]).any(1)
        watch.start(mask, mask & ~lost, qpos, qvel)
        self._place(mask, watch.home_qpos, watch.home_qvel)
        for cause, entries in bad.items():
            watch.fail(entries, cause, steps, watch.home_qpos)
        self._put_back()

    def run(self, steps: int, substeps: int, *command: NDArray[np.float64] | None) -> None:
        watch = self._watch
        self._steps, watch.flagged = steps, watch.stopped.copy()
        if watch.stopped.any() or not finite(*command):
            command = self._admit(command)
        self._run(substeps, *command)
        if not finite(self._qpos, self.pack.read_qvel()):
            self._contain(self._state, self._qpos, substeps)

    def observe(self, rows: Arrays) -> None:
        watch = self._watch
        rows.qpos[...] = self._qpos
        rows.qvel[...] = self.pack.read_qvel(np.float32)
        rows.effort[...] = self.pack.qf
        rows.saturated[...] = self._saturated
        rows.ok[...] = ~watch.flagged
        rows.fault_step[...], rows.fault_joint[...], rows.fault_cause[...] = (
            watch.step,
            watch.joint,
            watch.cause,
        )
        if watch.stopped.any():
            held = watch.stopped
            rows.qpos[held] = watch.held_qpos[held]
            rows.qvel[held] = rows.effort[held] = rows.saturated[held] = 0

    def read(self) -> EnvStates:
        """State of these envs, physics and controller."""
        pack = self.pack
        return EnvStates(
            qpos=pack.read_qpos(np.float32),
            qvel=pack.read_qvel(np.float32),
            effort=pack.qf.copy(),
            root=pack.read_root(),
            content=pack.read_content(),
            saturated=self._saturated,
            controller={name: leaf for name, leaf in self._state._asdict().items() if leaf is not None},
            containment=self._watch.read(),
        )

    def write(self, pack: Pack, states: EnvStates) -> None:
        """Go on with ``pack``, which is new, in the given state."""
        self.pack = pack
        self.set_params(self._params)
        pack.write_state(range(pack.size), states.qpos, states.qvel, states.root)
        pack.write_content(states.content)
        self._watch.write(states.containment)
        pack.hold(self._watch.stopped)
        pack.write_qf(states.effort)
        self._saturated = states.saturated
        self._state = bp.PIDState(**states.controller)
        self._qpos = pack.read_qpos()

    # -- what becomes of an env that fails -----------------------------------------------------------------------------

    def _sound(self, probe: NDArray[Any] | None) -> bool:
        """Whether no robot has failed, as far as ``probe``, some array that depends on all their states, tells."""
        limit = self._watch.speed_limit
        return finite(probe) and (limit is None or bool((np.abs(self.pack.read_qvel()) <= limit).all()))

    def _contain(self, state: Any, qpos: NDArray[np.float64], done: int) -> tuple[Any, NDArray[np.float64]]:
        """After ``done`` substeps of a tick: put back the envs that failed; the state and qpos to go on with."""
        watch, step = self._watch, self._steps + done
        qvel = self.pack.read_qvel()
        bad = ~(np.isfinite(qpos) & np.isfinite(qvel))
        # One step after a joint's effort was NaN all joints are, so the effort tells better where it began.
        source = ~np.isfinite(self.pack.qf) & bad.any(1, keepdims=True)
        watch.fail(np.where(source.any(1, keepdims=True), source, bad), "state", step, self._qpos)
        if watch.speed_limit is not None:
            watch.fail(
                (np.abs(qvel) > watch.speed_limit) & ~bad.any(1, keepdims=True), "speed", step, self._qpos
            )
        self._state, self._qpos = state, np.where(bad, self._qpos, qpos)
        self._put_back()
        return self._state, self._qpos

    def _admit(
        self, command: tuple[NDArray[np.float64] | None, ...]
    ) -> tuple[NDArray[np.float64] | None, ...]:
        """Stop the envs whose commands are not finite; the commands, harmless for all that are stopped."""
        watch = self._watch
        for cause, rows in zip(("setpoint", "setpoint_rate", "feedforward"), command, strict=True):
            if rows is not None:
                watch.fail(~np.isfinite(rows), cause, self._steps + 1, self._qpos)
        self._put_back()
        harmless = (0.0 if self._control == "effort" else self._qpos, 0.0, 0.0)
        return tuple(
            None if rows is None else np.where(watch.flagged[:, None], value, rows)
            for rows, value in zip(command, harmless, strict=True)
        )

    def _put_back(self) -> None:
        """Place the envs that failed where they are held, or where they start over."""
        watch = self._watch
        failed = watch.take_failed()
        if failed.any():
            if watch.holds:
                self._place(failed, watch.held_qpos, np.zeros_like(watch.held_qpos))
            else:
                self._place(failed, watch.home_qpos, watch.home_qvel)

    def _place(self, mask: NDArray[np.bool_], qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> None:
        rows = np.flatnonzero(mask)
        self.pack.write_state(rows.tolist(), qpos[rows], qvel[rows])
        self.pack.hold(self._watch.stopped)
        self._qpos = self.pack.read_qpos()
        self._saturated[rows] = False
        if self._state is None:
            self._state = bp.init(self._params, self._qpos)
        else:
            self._state = bp.reset(self._params, self._state, self._qpos, mask)

    # -- the loop, under each kind of control ---------------------------------------------------------------

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
        for done in range(1, substeps + 1):
            passive = self._passive()
            if feedforward is not None:
                passive = feedforward if passive is None else passive + feedforward
            qvel = pack.read_qvel() if self._measurement_rate else None
            state, effort, *aux = bp.advance(
                coefficients, state, setpoint, qpos, qvel, setpoint_rate, passive, aux=done == substeps
            )
            pack.write_qf(effort)
            pack.step()
            qpos = pack.read_qpos()
            if not self._sound(qpos):
                state, qpos = self._contain(state, qpos, done)
        self._saturated = aux[0].saturated
        self._state, self._qpos = state, qpos

    def _run_pid_inertia(
        self,
        substeps: int,
        setpoint: NDArray[np.float64],
        setpoint_rate: NDArray[np.float64] | None,
        feedforward: NDArray[np.float64] | None,
    ) -> None:
        """As :meth:`_run_pid`, with gains per unit of inertia; the mass matrix is kept for some substeps.

        With the whole matrix M the joints' own viscous damping B is made up for as well. The engine takes it
        implicitly, (M + dt B) (v+ - v) = dt (u - B v), so u = (M + dt B) a + B v gives exactly v+ = v + dt a.
        """
        pack, coefficients, state, qpos = self.pack, self._coefficients, self._state, self._qpos
        whole = isinstance(self._params.gain_units, PerMassMatrix)
        damping = self._damping if whole and self._damping.any() else None
        aux: list[bp.Terms] = []
        for done in range(substeps):
            if done % INERTIA_EVERY == 0:
                matrix = self._mass_matrix(qpos)
                if damping is not None:
                    matrix += self._dt * np.diag(damping)
                k = (
                    coefficients
                    if whole
                    else per_inertia(coefficients, np.diagonal(matrix, axis1=1, axis2=2))
                )
            passive = self._passive()
            if feedforward is not None:
                passive = feedforward if passive is None else passive + feedforward
            qvel = pack.read_qvel() if self._measurement_rate or damping is not None else None
            if damping is not None:
                passive = damping * qvel if passive is None else passive + damping * qvel
            if not self._measurement_rate:
                qvel = None
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
            if not self._sound(qpos):
                state, qpos = self._contain(state, qpos, done + 1)
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
        for done in range(substeps):
            passive = self._passive()
            if not self._sound(passive):
                self._contain(self._state, pack.read_qpos(), done)
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
        for done in range(substeps):
            passive = self._passive()
            if not self._sound(passive):
                self._contain(self._state, pack.read_qpos(), done)
                passive = self._passive()
            total = wanted if passive is None else wanted + passive
            pack.write_qf(total if low is None or high is None else np.minimum(np.maximum(total, low), high))
            pack.step()
        if low is not None and high is not None:
            self._saturated = (total < low) | (total > high)
        self._qpos = pack.read_qpos()
