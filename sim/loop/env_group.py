"""A group of the loop: the envs that advance together, and their closed loop."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from sim.engine.building import SceneSpec
from sim.engine.pack import Pack
from sim.loop.arrays import Arrays, Command
from sim.loop.control import make_control
from sim.loop.faults import Containment, finite
from sim.loop.snapshot import EnvStates


class EnvGroup:
    """One pack and its controller: the sim steps of a tick, and what becomes of an env that fails.

    ``envs`` are its rows of the loop's arrays.
    """

    def __init__(
        self,
        pack: Pack,
        envs: slice,
        scene: SceneSpec,
        params: bp.PIDParams,
        *,
        control: str,
        compensate: tuple[bool, bool],
        on_fault: str,
        speed_limit: NDArray[np.float64] | None,
    ) -> None:
        self.pack, self.envs = pack, envs
        # The control asks about the robot alone, whatever else the scenes hold.
        self._scene = replace(scene, build=None)
        self._kind = control
        self._gravity, self._coriolis = compensate
        self._control = make_control(control, self._scene, params, pack.size)
        self._qpos = pack.read_qpos()
        self._watch = Containment(pack.size, pack.dof, on_fault, speed_limit)
        self._steps = 0

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times in flight; the controller's state is kept."""
        old = self._control
        if (params.gain_units is None) != (old.params.gain_units is None):
            self._control = make_control(self._kind, self._scene, params, self.pack.size)
            self._control.state, self._control.saturated = old.state, old.saturated
        self._control.set_params(self.pack, params)
        if self._control.state is not None:
            # The new params may need more of a state than the old ones, or less.
            both = zip(bp.init(params, self._qpos), self._control.state, strict=True)
            self._control.state = bp.PIDState(*(new if new is None or old is None else old for new, old in both))

    def reset(self, mask: NDArray[np.bool_], qpos: NDArray[np.float64], qvel: NDArray[np.float64], steps: int) -> None:
        """Place the envs of ``mask`` (M,), with a fresh controller state; ``steps`` sim steps have been made."""
        watch = self._watch
        bad = {cause: mask[:, None] & ~np.isfinite(rows) for cause, rows in (("qpos", qpos), ("qvel", qvel))}
        lost = (bad["qpos"] | bad["qvel"]).any(1)
        watch.start(mask, mask & ~lost, qpos, qvel)
        self._place(mask, watch.home_qpos, watch.home_qvel)
        for cause, entries in bad.items():
            watch.fail(entries, cause, steps, watch.home_qpos)
        self._put_back()

    def run(self, steps: int, substeps: int, command: Command) -> None:
        """Run ``substeps`` sim steps under ``command``, after ``steps`` in the past."""
        watch = self._watch
        self._steps, watch.flagged = steps, watch.stopped.copy()
        if watch.stopped.any() or not finite(*command):
            command = self._admit(command)
        with np.errstate(all="ignore"):  # what overflows or is not finite becomes a fault
            self._run(substeps, command)
            if not finite(self._qpos, self.pack.read_qvel()):
                self._contain(self._qpos, substeps)

    def observe(self, rows: Arrays) -> None:
        """Write observation and faults into these envs' rows."""
        watch, seen = self._watch, rows.observation
        seen.qpos[...] = self._qpos
        seen.qvel[...] = self.pack.read_qvel(np.float32)
        seen.effort[...] = self.pack.qf
        seen.saturated[...] = self._control.saturated
        seen.ok[...] = ~watch.flagged
        rows.fault.step[...], rows.fault.joint[...], rows.fault.cause[...] = watch.step, watch.joint, watch.cause
        if watch.stopped.any():
            held = watch.stopped
            seen.qpos[held] = watch.held_qpos[held]
            seen.qvel[held] = seen.effort[held] = seen.saturated[held] = 0

    def read(self) -> EnvStates:
        """State of these envs, physics and controller."""
        pack = self.pack
        return EnvStates(
            qpos=pack.read_qpos(np.float32),
            qvel=pack.read_qvel(np.float32),
            effort=pack.qf.copy(),
            root=pack.read_root(),
            content=pack.read_content(),
            isolated=pack.isolated.copy(),
            saturated=self._control.saturated,
            controller={name: leaf for name, leaf in self._control.state._asdict().items() if leaf is not None},
            containment=self._watch.read(),
        )

    def write(self, pack: Pack, states: EnvStates) -> None:
        """Go on with ``pack``, which is new, in the given state."""
        self.pack = pack
        self._control.set_params(pack, self._control.params)
        pack.write_state(range(pack.size), states.qpos, states.qvel, states.root)
        pack.write_content(states.content)
        pack.isolate(np.flatnonzero(states.isolated).tolist())
        self._watch.write(states.containment)
        pack.suspend(self._watch.stopped)
        pack.write_qf(states.effort)
        self._control.saturated = states.saturated
        self._control.state = bp.PIDState(**states.controller)
        self._qpos = pack.read_qpos()

    # -- what becomes of an env that fails -----------------------------------------------------------------------------

    def _sound(self, probe: NDArray[Any] | None) -> bool:
        """Whether no robot has failed, as far as ``probe``, some array that depends on all their states, tells."""
        limit = self._watch.speed_limit
        return finite(probe) and (limit is None or bool((np.abs(self.pack.read_qvel()) <= limit).all()))

    def _contain(self, qpos: NDArray[np.float64], done: int) -> None:
        """Put back the envs that failed, ``done`` substeps into a tick."""
        watch, step = self._watch, self._steps + done
        qvel = self.pack.read_qvel()
        bad = ~(np.isfinite(qpos) & np.isfinite(qvel))
        # One step after a joint's effort was NaN all joints are, so the effort tells better where it began.
        source = ~np.isfinite(self.pack.qf) & bad.any(1, keepdims=True)
        watch.fail(np.where(source.any(1, keepdims=True), source, bad), "state", step, self._qpos)
        if watch.speed_limit is not None:
            watch.fail((np.abs(qvel) > watch.speed_limit) & ~bad.any(1, keepdims=True), "speed", step, self._qpos)
        self._qpos = np.where(bad, self._qpos, qpos)
        self._put_back()

    def _admit(self, command: Command) -> Command:
        """Stop the envs whose commands are not finite; return the commands, harmless for all that are stopped."""
        watch = self._watch
        for cause, rows in command._asdict().items():
            if rows is not None:
                watch.fail(~np.isfinite(rows), cause, self._steps + 1, self._qpos)
        self._put_back()
        harmless = (0.0 if self._kind == "effort" else self._qpos, 0.0, 0.0)
        return Command._make(
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
        self.pack.suspend(self._watch.stopped)
        self._qpos = self.pack.read_qpos()
        self._control.reset(self._qpos, mask)

    # -- the closed loop --------------------------------------------------------------------------------------

    def _run(self, substeps: int, command: Command) -> None:
        """At every sim step: compensate, control, write, step, read."""
        pack, control = self.pack, self._control
        control.begin(pack, substeps, command.setpoint, command.setpoint_rate)
        for step in range(substeps):
            last = step == substeps - 1
            forward = self._feedforward(command.feedforward)
            if not control.reads_qpos_each_step and not self._sound(forward):
                # Without a look at qpos, the passive force is what tells of a state that has failed.
                self._contain(pack.read_qpos(), step)
                forward = self._feedforward(command.feedforward)
            effort = control.effort(pack, self._qpos, forward, step, last)
            if effort is not None:
                pack.write_qf(effort)
            pack.step()
            if control.reads_qpos_each_step:
                qpos = pack.read_qpos()
                if self._sound(qpos):
                    self._qpos = qpos
                else:
                    self._contain(qpos, step + 1)
        if not control.reads_qpos_each_step:
            self._qpos = pack.read_qpos()

    def _feedforward(self, extra: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        """Passive force as compensated, and the caller's effort on top."""
        if not self._gravity:
            return extra
        passive = self.pack.passive_force(self._gravity, self._coriolis)
        return passive if extra is None else passive + extra
