"""Group of envs that advance together, and their closed loop.

Longer than 300 lines because everything that a sim step does, faults included, is read in one place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from sim.engine.engines import scene_dynamics
from sim.engine.protocol import EnginePack as Pack
from sim.loop.actuators import JointActuators
from sim.loop.arrays import Arrays, Command
from sim.loop.compiled_tick import CompiledTick, compiled_tick
from sim.loop.faults import FaultContainment, far, finite, near
from sim.loop.friction import JointFriction
from sim.loop.guard import SetpointGuard
from sim.loop.jitted import make_control
from sim.loop.snapshot import EnvStates
from sim.loop.variation import acting_actuators, acting_params, variation
from sim.options import RunnerOptions
from sim.randomization.draws import Draws
from sim.robot.actuators import known_joints

Float64 = NDArray[np.float64]

COUPLING_STEPS = 4
"""Sim steps for which the constraint efforts of coupled joints keep their mass matrix within a tick."""


class EnvGroup:
    """One pack and its control; runs the sim steps of a tick, and suspends or resets envs that fail.

    ``envs`` are its rows of the loop's arrays, ``params`` those of these envs.
    """

    def __init__(self, pack: Pack, envs: slice, params: bp.PIDParams, options: RunnerOptions) -> None:
        self.pack, self.envs, self._options = pack, envs, options
        compensated = options.compensate.split("+")
        self._gravity, self._coriolis = "gravity" in compensated, "coriolis" in compensated
        self._speed_limit = None if options.speed_limit is None else np.asarray(options.speed_limit)
        self._coupling = options.robot.coupling
        self.draws: Draws | None = None
        """Draws of the randomization for these envs; a reset, or new params, put them into effect."""
        self._params = params  # before the randomization
        self._own_actuators: bp.Actuators | None = None  # likewise
        self._control = make_control(options, pack.spec, params, pack)
        self._containment = FaultContainment(pack.size, pack.dof, options.on_fault)
        self._friction = JointFriction(pack, self._control.drive, known_joints(self._options.robot).coulomb)
        self._motor = np.zeros((pack.size, pack.dof), np.float32)
        self._qpos = pack.read_qpos()
        self._compensates = self._friction.compensates and "friction" in compensated and options.sets_positions
        self._steps = 0
        self._actuators: JointActuators | None = None  # with effects on efforts or measurements
        self._guard: SetpointGuard | None = None
        if isinstance(options.guard, bp.Guard):
            limits = options.guard.for_envs(slice(pack.first_env, pack.first_env + pack.size))
            self._guard = SetpointGuard(limits, self._coupling, self._qpos, options.timestep)
        collides, ground = options.collisions, options.robot.has_ground
        self._contacts = None if collides else options.load_engine().missed_contacts(pack.spec, pack.size, ground)
        self._compiled = self._make_compiled()

    def _make_compiled(self) -> CompiledTick | None:
        """Return the sim steps of a tick as one program, where the options ask for it and it can be."""
        compensated = self._gravity, self._coriolis, self._compensates
        return compiled_tick(self._options, self.pack, self._control, self._friction, self._actuators, compensated)

    def _release(self) -> None:
        """Let the state of control, friction and robots be changed from here."""
        if self._compiled is not None:
            self._compiled.release()

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times in flight; the controller's state carries on."""
        self._release()
        self._params = params
        self._control.set_params(acting_params(self._options, params, self.draws))
        self._friction.drive = self._control.drive

    def set_actuators(self, actuators: bp.Actuators | None) -> None:
        """Change the actuators in flight; their state carries on."""
        self._release()
        if actuators is not None or self._own_actuators is not None:
            self._own_actuators = actuators
            self.pack.write_joints(self._take_actuators())
            self._friction.update()
            self._compiled = self._make_compiled()

    def _take_actuators(self) -> bp.Actuators | None:
        """Let efforts and measurements be those of the actuators with the draws applied; return these."""
        actuators = acting_actuators(self._options, self._own_actuators, self.draws)
        if actuators is None or not (actuators.measures or actuators.delivers):
            self._actuators, self._control.limits = None, (None, None)
        elif self._actuators is None:
            self._actuators = JointActuators(actuators, self._qpos, self._options.timestep, self.pack.first_env)
        else:
            self._actuators.set_actuators(actuators, self._qpos)
        return actuators

    def reset(self, mask: NDArray[np.bool_], qpos: Float64, qvel: Float64, steps: int) -> None:
        """Place the envs of ``mask`` (M,), with a fresh controller state, after ``steps`` sim steps.

        An env whose ``qpos`` or ``qvel`` (M, dof) is not finite starts where it did last, and has failed.
        """
        self._release()
        containment = self._containment
        containment.clear(mask)
        self._vary(mask)
        bad = {cause: mask[:, None] & ~np.isfinite(rows) for cause, rows in (("qpos", qpos), ("qvel", qvel))}
        good = mask & ~(bad["qpos"] | bad["qvel"]).any(1)
        containment.start_qpos[good], containment.start_qvel[good] = qpos[good], qvel[good]
        self._place(mask, containment.start_qpos, containment.start_qvel)
        for cause, entries in bad.items():
            containment.fail(entries, cause, steps, containment.start_qpos)
        self._place_failed()

    def run(self, steps: int, substeps: int, command: Command) -> None:
        """Run ``substeps`` sim steps under ``command``, after ``steps`` in the past."""
        containment = self._containment
        self._steps, containment.failed = steps, containment.suspended.copy()
        if containment.suspended.any() or not finite(*command):
            command = self._without_faults(command)
        with np.errstate(all="ignore"):  # overflow and invalid values become faults
            self._run_substeps(substeps, command)
            if not (near(self._qpos) and finite(self.pack.read_qvel())):
                self._contain(self._qpos, substeps)
        if self._contacts is not None:
            self._contacts.look(self._qpos, steps + substeps, containment.missed_contact)

    def observe(self, rows: Arrays) -> None:
        """Write observation and faults into these envs' rows."""
        containment, observation = self._containment, rows.observation
        observation.qpos[...] = self._qpos
        observation.qvel[...] = self.pack.read_qvel(np.float32)
        observation.effort[...] = self._motor
        observation.saturated[...] = self._control.saturated
        observation.guarded[...] = False if self._guard is None else self._guard.changed
        observation.ok[...] = ~containment.failed
        fault = rows.fault
        fault.step[...], fault.joint[...], fault.cause[...] = containment.step, containment.joint, containment.cause
        fault.missed_contact[...] = containment.missed_contact
        if containment.suspended.any():
            envs = containment.suspended
            observation.qpos[envs] = containment.suspended_qpos[envs]
            observation.qvel[envs] = observation.effort[envs] = 0
            observation.saturated[envs] = observation.guarded[envs] = False

    def read(self) -> EnvStates:
        """Return the state of these envs, physics and controller."""
        pack = self.pack
        self._release()
        return EnvStates(
            engine=pack.read_state(),
            effort=self._motor.copy(),
            saturated=self._control.saturated,
            controller=self._control.read(),
            friction=self._friction.read(),
            actuators={} if self._actuators is None else self._actuators.read(),
            guard={} if self._guard is None else self._guard.read(),
            containment=self._containment.read(),
        )

    def write(self, pack: Pack, states: EnvStates) -> None:
        """Continue with ``pack``, which is new, in the given state."""
        self.pack = pack
        if self._own_actuators is not None:
            pack.write_joints(self._take_actuators())
        if self._actuators is not None:
            self._actuators.write(states.actuators)
        self._control = make_control(self._options, pack.spec, self._control.params, pack)
        pack.write_state_rows(states.engine)
        self._containment.write(states.containment)
        pack.suspend(self._containment.suspended)
        pack.write_qf(states.effort)
        self._control.write(states.controller, states.saturated)
        self._friction = JointFriction(pack, self._control.drive, known_joints(self._options.robot).coulomb)
        self._friction.write(states.friction)
        if self._guard is not None:
            self._guard.write(states.guard)
        self._motor[...] = states.effort
        self._qpos = pack.read_qpos()
        if self._contacts is not None:
            self._contacts.place(np.ones(pack.size, bool))
        self._compiled = self._make_compiled()

    def _vary(self, mask: NDArray[np.bool_]) -> None:
        """Put the draws of the envs of ``mask`` (M,), which are to be placed, into effect."""
        rows = np.flatnonzero(mask).tolist()
        if self._options.randomization is None or self.draws is None or not rows:
            return
        if self._options.randomization.changes_robot:
            self.pack.vary(rows, variation(self._options, len(rows), self.draws.for_envs(rows)))
        self.pack.write_joints(self._take_actuators(), rows)
        self.set_params(self._params)

    # -- the closed loop ---------------------------------------------------------------------------------------

    def _run_substeps(self, substeps: int, command: Command) -> None:
        """Run the sim steps of a tick, each of them: compensate, control, write, step, read."""
        if self._compiled is not None:
            self._run_compiled(self._compiled, substeps, command)
            return
        pack, control, friction = self.pack, self._control, self._friction
        control.begin(command, substeps)
        actuators, guard, asked = self._actuators, self._guard, command
        for step in range(substeps):
            qvel: Any = None
            if guard is not None:
                command = guard.advance(asked)
                control.begin(command, substeps)
            if actuators is None:
                forward = self._feedforward(command, self._qpos)
                if friction.acts:
                    qvel = pack.read_qvel()
                effort = control.effort(self._qpos, forward, step, qvel)
            else:
                qvel = pack.read_qvel()
                effort = self._actuated(actuators, command, step, qvel)
            if effort is not None and step + 1 == substeps:
                self._motor[...] = effort
            if friction.acts:
                motor = np.zeros_like(self._qpos) if effort is None else effort
                effort = friction.effort(motor, qvel)
            if effort is not None:
                pack.write_qf(effort)
            pack.step(step % COUPLING_STEPS == 0)
            qpos = pack.read_qpos()
            if self._sound(qpos):
                self._qpos = qpos
            else:
                self._contain(qpos, step + 1)

    def _run_compiled(self, compiled: CompiledTick, substeps: int, command: Command) -> None:
        """Run the sim steps of a tick by the program, and do here what it stops for."""
        done = 0
        while done < substeps:
            done, status = compiled.run(command, done, substeps)
            self._motor[...] = compiled.read("motor")
            self._control.saturated = compiled.read("saturated", bool)
            if not status:
                continue
            compiled.look()
            qpos = self.pack.read_qpos()
            if not self._sound(qpos):
                if self._control.returned is not None:
                    self._control.returned = self._motor
                self._qpos = compiled.read("qpos_before")
                self._contain(qpos, done)
        self._qpos = self.pack.read_qpos()

    def _actuated(
        self, actuators: JointActuators, command: Command, step: int, qvel: NDArray[Any]
    ) -> NDArray[Any] | None:
        """Return the efforts that real motors deliver under a control that sees what real sensors measure."""
        seen = actuators.measure(self._qpos, qvel)
        self._control.limits = actuators.limits(*seen)
        forward = self._feedforward(command, *(seen if actuators.measures else (self._qpos,)))
        effort = self._control.effort(seen[0], forward, step, seen[1])
        return None if effort is None else actuators.deliver(effort, self._qpos, qvel)

    def _feedforward(self, command: Command, qpos: Float64, qvel: Float64 | None = None) -> Float64 | None:
        """Return the compensation plus the caller's feedforward, those of followers on their leaders; None for zero.

        The passive force is the engine's, or with ``qvel`` that of the model at ``qpos`` and ``qvel``.
        """
        forward = command.feedforward
        if self._gravity:
            which = self._gravity, self._coriolis
            pack = self.pack
            passive = (
                pack.passive_force(*which)
                if qvel is None
                else scene_dynamics(pack.spec).passive_force(qpos, qvel, *which)
            )
            forward = passive if forward is None else passive + forward
        if forward is not None and self._coupling is not None:
            forward = self._coupling.efforts(forward)
        if self._compensates:
            friction = self._friction.feedforward(command, qpos)
            forward = friction if forward is None else friction + forward
        return forward

    # -- envs that fail ----------------------------------------------------------------------------------------

    def _sound(self, qpos: Float64) -> bool:
        """Return whether certainly no robot has failed."""
        limit = self._speed_limit
        return near(qpos) and (limit is None or bool((np.abs(self.pack.read_qvel()) <= limit).all()))

    def _contain(self, qpos: Float64, done: int) -> None:
        """Suspend or reset the envs that failed, ``done`` substeps into a tick."""
        containment, step = self._containment, self._steps + done
        qvel = self.pack.read_qvel()
        bad = far(qpos) | ~np.isfinite(qvel)
        # One step after the effort of one joint was NaN all joints are, so the effort shows where it began.
        failed = bad.any(1, keepdims=True)
        source = ~np.isfinite(self.pack.qf) & failed
        if self._control.returned is not None:
            wrong = ~np.isfinite(self._control.saturate(self._control.returned)) & failed
            wrong = np.where(wrong.any(1, keepdims=True), wrong, source)  # actuators may have delayed it
            containment.fail(wrong, "effort", step, self._qpos)
        containment.fail(np.where(source.any(1, keepdims=True), source, bad), "state", step, self._qpos)
        if self._speed_limit is not None:
            fast = (np.abs(qvel) > self._speed_limit) & ~failed
            containment.fail(fast, "speed", step, self._qpos)
        self._qpos = np.where(bad, self._qpos, qpos)
        self._place_failed()

    def _without_faults(self, command: Command) -> Command:
        """Fail the envs whose commands are not finite; return commands that keep all failed envs where they are."""
        containment = self._containment
        for cause, rows in command._asdict().items():
            if rows is not None:
                containment.fail(~np.isfinite(rows), cause, self._steps + 1, self._qpos)
        self._place_failed()
        neutral, failed = (
            (self._qpos if self._options.sets_positions else 0.0, 0.0, 0.0),
            containment.failed[:, None],
        )
        both = zip(command, neutral, strict=True)
        return Command._make(None if rows is None else np.where(failed, value, rows) for rows, value in both)

    def _place_failed(self) -> None:
        """Place the envs that have failed since the last call: suspended, or at their start."""
        containment = self._containment
        failed = containment.pop_unplaced()
        if failed.any() and containment.suspends:
            self._place(failed, containment.suspended_qpos, np.zeros_like(containment.suspended_qpos))
        elif failed.any():
            self._place(failed, containment.start_qpos, containment.start_qvel)

    def _place(self, mask: NDArray[np.bool_], qpos: Float64, qvel: Float64) -> None:
        self._release()
        rows = np.flatnonzero(mask)
        self.pack.write_state(rows.tolist(), qpos[rows], qvel[rows])
        self.pack.suspend(self._containment.suspended)
        self._motor[mask] = 0.0
        self._qpos = self.pack.read_qpos()
        if self._contacts is not None:
            self._contacts.place(mask)
        qpos = self._qpos
        if self._actuators is not None:
            holding = self.pack.passive_force(self._gravity, self._coriolis) if self._gravity else None
            if holding is not None and self._coupling is not None:
                holding = self._coupling.efforts(holding)
            self._actuators.reset(mask, qpos, (qvel := self.pack.read_qvel()), holding)
            qpos, _ = self._actuators.measured(qpos, qvel)
        self._control.reset(qpos, mask)
        self._friction.reset(mask)
        if self._guard is not None:
            self._guard.reset(mask, self._qpos)
