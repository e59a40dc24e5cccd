"""Group of envs that advance together: their state, and its changes by ticks, resets, params,
actuators and faults.

Longer than 350 lines because every change of the state is here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Array, Float64
from batchpid.arrays.elementwise import clip
from batchpid.motors import ActuatorState, advance_measurement
from batchpid.motors.friction import FrictionState
from batchpid.motors.guard import GuardState
from batchpid.sim.engine.missed_contacts import MissedContacts
from batchpid.sim.engine.protocol import CompiledPack, DrivenPack, EnginePack
from batchpid.sim.loop.acting_draws import acting_actuators, acting_params, variation
from batchpid.sim.loop.arrays import Arrays, Command, FaultArrays, Ticks
from batchpid.sim.loop.custom import OwnController
from batchpid.sim.loop.faults import FaultContainment, far, finite, near
from batchpid.sim.loop.native_executor import NativeExecutor
from batchpid.sim.loop.native_ticks import Table
from batchpid.sim.loop.numpy_executor import NumPyExecutor, Span, passive_forces, with_model
from batchpid.sim.loop.pid_law import PIDLaw
from batchpid.sim.loop.pushes import Pushes
from batchpid.sim.loop.snapshot import AGE, CHANGED, EPISODE, EnvStates
from batchpid.sim.loop.step_setup import (
    init_motors,
    make_constants,
    make_layout,
    reset_friction,
    reset_guard,
    with_friction,
    with_params,
)
from batchpid.sim.loop.step_values import StepState
from batchpid.sim.loop.xla_executor import XLAExecutor
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import Draws
from batchpid.sim.signals.observation import untouched


class EnvGroup:
    """One pack and its control; runs the sim steps of a tick, and suspends or resets envs that
    fail.

    ``envs`` are its rows in the loop's arrays, and ``params`` the params of these envs.
    ``controller`` is the caller's own, or None.
    """

    def __init__(
        self,
        pack: EnginePack,
        envs: slice,
        params: bp.PIDParams,
        options: RunnerOptions,
        controller: OwnController | None = None,
    ) -> None:
        self.pack = pack
        self.envs = envs
        self._options = options
        self._controller = controller
        self.draws: Draws | None = None
        """Draws of the randomization for these envs; a reset, or new params, put them into
        effect.
        """
        self._params = self._acting_params = params  # before and after the randomization
        self._own_actuators: bp.Actuators | None = None  # before the randomization
        self._actuators: bp.Actuators | None = (
            None  # after it; None without effect on efforts or measurements
        )
        self._episode = np.zeros(pack.size, np.int64)
        self._drops_actuators = False  # of a pack in use, at the next write()
        self._containment = FaultContainment(pack.size, pack.dof, options.on_fault)
        self._motor = np.zeros((pack.size, pack.dof), np.float32)
        self._saturated, self._guarded = (np.zeros((pack.size, pack.dof), bool) for _ in range(2))
        self._table: Table | None = None
        self._sensed = untouched(pack.size, options.observed)
        self._pushes = Pushes(options, pack.size) if options.has_pushes else None
        reads_base = "base_state" in options.load_engine().capabilities and pack.spec.mjcf is None
        observed = pack.spec.is_alone or (reads_base and not pack.spec.fixed_base)
        self._observes_natively = observed and not self._sensed and self._pushes is None
        self._steps = 0
        missed = (
            MissedContacts(pack.spec, pack.size, options.robot.has_ground)
            if options.misses_contacts
            else None
        )
        self._contacts = missed
        qpos = pack.read_qpos()
        self._state = StepState(
            bp.init(params, qpos) if controller is None else controller.init(pack.size)
        )
        self._prepare()
        everyone = np.ones(pack.size, bool)
        self._state = reset_guard(self._constants, self._state, qpos, everyone)
        self._state = reset_friction(self._layout, self._constants, self._state, pack, everyone)
        self._write_drives()

    def _prepare(self) -> None:
        """Make constants and executor for the present robots, params and actuators."""
        options = self._options
        pack = self.pack
        motors = self._state.motors
        constants = make_constants(options, pack, self._acting_params, self._actuators, motors)
        layout = make_layout(options, self._acting_params, self._actuators)
        layout = with_model(options, pack, layout, constants, self._controller)
        self._layout, self._constants = layout, constants
        # Native wherever the engine has native steps, under backend "numpy" too: the bits are the
        # same.
        self._executor: NumPyExecutor | XLAExecutor
        if not isinstance(pack, CompiledPack) or not pack.steps_natively:
            self._executor = NumPyExecutor(options, pack, layout, constants)
        elif options.backend == "jax":
            self._executor = XLAExecutor(options, pack, layout, constants, self._controller)
        else:
            self._executor = NativeExecutor(options, pack, layout, constants)
        self._measured = self._executor.measure()

    def execute_in_numpy(self) -> None:
        """Run sim steps call by call in NumPy until the next change, so that the phases of a step
        can be timed.
        """
        self._executor = NumPyExecutor(self._options, self.pack, self._layout, self._constants)

    def _write_drives(self) -> None:
        """Set the engine's drives, under control "drive"."""
        if self._options.control == "drive" and isinstance(self.pack, DrivenPack):
            damping, stiffness = self._constants.drive
            limit = self._acting_params.effort_max
            self.pack.write_drive(
                stiffness, damping, np.full_like(stiffness, np.inf) if limit is None else limit
            )

    @property
    def _qpos(self) -> Float64:
        return self._executor.rows(self._measured.qpos)

    def _take_state(self) -> StepState:
        """Convert the state of the control to NumPy arrays, which may be changed; return it."""
        self._state = self._executor.numpy_state(self._state)
        return self._state

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times in flight; the controller's state carries on."""
        state = self._take_state()
        before = self._acting_params
        constants = self._constants
        self._params, self._acting_params = params, acting_params(self._options, params, self.draws)
        self._prepare()
        if not PIDLaw.of(before).uses_mass_matrix:
            constants = self._constants
        qpos = self.pack.read_qpos()
        self._state = with_params(self._layout, constants, state, before, self._acting_params, qpos)
        self._write_drives()

    def set_actuators(self, actuators: bp.Actuators | None) -> None:
        """Change the actuators in flight; their state carries on."""
        if actuators is not None or self._own_actuators is not None:
            self._take_state()
            self._own_actuators = actuators
            self.pack.write_joints(self._take_actuators())
            self._prepare()
            self._state = with_friction(self._layout, self._constants, self._state, self.pack)

    def _take_actuators(self) -> bp.Actuators | None:
        """Put the actuators, with the draws applied, into effect; return them."""
        actuators = acting_actuators(self._options, self._own_actuators, self.draws)
        old, motors = self._state.motors, None
        self._actuators = (
            actuators
            if actuators is not None and (actuators.measures or actuators.delivers)
            else None
        )
        if self._actuators is not None:
            if old is None:
                self._episode[:] = 0
            fresh = init_motors(self._actuators, self.pack, self._qpos, self._episode)
            motors = fresh if old is None else old.matched_to(fresh)
        self._state = self._state._replace(motors=motors)
        return actuators

    def reset(
        self,
        mask: NDArray[np.bool_],
        qpos: Float64,
        qvel: Float64,
        steps: int,
        base: Float64 | None = None,
    ) -> None:
        """Place the envs of ``mask`` (M,), with a fresh controller state, after ``steps`` sim
        steps.

        Floating bases are placed at ``base`` (M, 13).

        An env whose ``qpos`` or ``qvel`` (M, dof) is not finite returns to its last start, and has
        failed.
        """
        containment = self._containment
        containment.clear(mask)
        self._vary(mask)
        bad = {
            cause: mask[:, None] & ~np.isfinite(rows)
            for cause, rows in (("qpos", qpos), ("qvel", qvel))
        }
        good = mask & ~(bad["qpos"] | bad["qvel"]).any(1)
        containment.start_qpos[good], containment.start_qvel[good] = qpos[good], qvel[good]
        if base is not None:
            containment.start_base[good] = base[good]
        self._place(mask, containment.start_qpos, containment.start_qvel)
        for sensed in self._sensed.values():
            sensed[mask] = 0
        for cause, entries in bad.items():
            containment.fail(entries, cause, steps, containment.start_qpos)
        self._place_failed()

    def run(
        self,
        ticks: Ticks,
        given: tuple[bool, ...],
        first: int,
        until: int,
        substeps: int,
        steps: int,
    ) -> int:
        """Run ticks of ``substeps`` sim steps from ``first`` on, at least one; observe them; return
        the next one.

        It returns before ``until`` after a tick with an event: a possible contact, or a failed env.
        ``given`` marks the commands that are used, and ``steps`` is the number of sim steps before
        the first tick.
        """
        containment, command = self._containment, ticks[first].command.with_only(given)
        containment.failed, table = containment.suspended.copy(), None
        self._steps = steps
        if self._sensed:
            self.pack.take_sensed()
        if self._pushes is not None:
            self._push(self._pushes, substeps)
        if containment.suspended.any() or not finite(*command):
            command = self._without_faults(command)
        elif self._contacts is None and self._observes_natively:
            if self._table is None:
                fault = FaultArrays(*[getattr(containment, name) for name in FaultArrays._fields])
                self._table = Table(
                    ticks.arrays, self._motor, self._saturated, self._guarded, fault
                )
            table = self._table
        # With a table native code reads the commands and writes the observations of many ticks by
        # itself. It stops within a tick where Python has to look: then ``done`` steps of it are
        # made, and the rest follows here.
        tick, done = self._execute(command, Span(first, 0, until, substeps), table)
        if not done:
            return tick
        while done < substeps:
            if table is not None:
                command = ticks[tick].command.with_only(given)
            _, done = self._execute(command, Span(tick, done, tick + 1, substeps), None)
        with np.errstate(all="ignore"):
            strays = not self.pack.spec.is_alone and self.pack.strays().any()
            if strays or not (near(self._qpos) and finite(self.pack.read_qvel())):
                self._contain(self._qpos, substeps, None)
        if self._contacts is not None:
            self._contacts.look(self._qpos, self._steps + substeps, containment.missed_contact)
        if self._sensed:
            for name, rows in self.pack.take_sensed().items():
                sensed = self._sensed[name]
                sensed[...] = rows > 0 if sensed.dtype == bool else rows / substeps
                sensed[containment.failed] = 0
        self.observe(ticks[tick])
        return tick + 1

    def _push(self, pushes: Pushes, substeps: int) -> None:
        """Push the bases that are due before a tick."""
        assert self.draws is not None
        rows, twists = pushes.due(self._containment.suspended, self.draws.episodes)
        if rows:
            self.pack.push(rows, twists)
            self._measured = self._executor.measure()
        pushes.advance(substeps)

    def _execute(self, command: Command, span: Span, table: Table | None) -> tuple[int, int]:
        """Run sim steps and handle an event; return the first tick that is not observed, and its
        steps done.
        """
        with np.errstate(all="ignore"):  # overflow and invalid values become faults
            ran = self._executor.run(self._state, self._measured, command, span, table)
            self._state = ran.state
            self._measured = ran.measured
            rows = self._executor.rows
            self._steps += (ran.tick - span.tick) * span.steps
            if ran.done == span.steps:
                self._motor[...] = rows(ran.outputs.motor)
                self._saturated[...] = self._mask(ran.outputs.saturated)
                self._guarded[...] = self._mask(ran.outputs.guarded)
            if ran.failed:
                self._contain(rows(ran.before), ran.done, ran.outputs.returned)
        return ran.tick, ran.done

    def _mask(self, array: Array) -> Array:
        return False if array is None else self._executor.rows(array)

    def observe(self, rows: Arrays) -> None:
        """Write observation and faults into these envs' rows."""
        containment, observation = self._containment, rows.observation
        observation.qpos[...] = self._qpos
        observation.qvel[...] = self.pack.read_qvel(np.float32)
        observation.effort[...] = self._motor
        observation.saturated[...] = self._saturated
        observation.guarded[...] = self._guarded
        observation.ok[...] = ~containment.failed
        if observation.base_pose is not None and observation.base_twist is not None:
            observation.base_pose[...], observation.base_twist[...] = np.split(
                self.pack.read_base(), [7], axis=1
            )
        for name, values in self._sensed.items():
            getattr(observation, name)[...] = values
        fault = rows.fault
        fault.step[...], fault.joint[...], fault.cause[...] = (
            containment.step,
            containment.joint,
            containment.cause,
        )
        fault.missed_contact[...] = containment.missed_contact
        if containment.suspended.any():
            envs = containment.suspended
            observation.qpos[envs] = containment.suspended_qpos[envs]
            observation.qvel[envs] = observation.effort[envs] = 0
            observation.saturated[envs] = observation.guarded[envs] = False
            if observation.base_twist is not None:
                observation.base_twist[envs] = 0

    def read(self) -> EnvStates:
        """Return the state of these envs, physics and controller."""
        pack, state = self.pack, self._take_state()
        friction = {} if state.age is None else {**state.friction._asdict(), AGE: state.age}
        return EnvStates(
            engine=pack.read_state(),
            effort=self._motor.copy(),
            saturated=self._saturated.copy(),
            controller=(
                state.law.leaves() if isinstance(state.law, bp.PIDState) else dict(state.law)
            ),
            friction=friction,
            actuators=(
                {}
                if state.motors is None
                else {**state.motors.leaves(), EPISODE: self._episode.copy()}
            ),
            guard=(
                {}
                if state.guard is None
                else {**state.guard._asdict(), CHANGED: self._guarded.copy()}
            ),
            containment=self._containment.read(),
            sensors={name: rows.copy() for name, rows in self._sensed.items()},
            pushes=(
                {}
                if self._pushes is None
                else {name: rows.copy() for name, rows in self._pushes.counts.items()}
            ),
        )

    def adopt(self, params: bp.PIDParams, actuators: bp.Actuators | None, draws: Draws) -> None:
        """Take the params, actuators and draws of a snapshot; :meth:`write` puts them into
        effect.
        """
        self._drops_actuators = actuators is None and self._own_actuators is not None
        self.draws = draws
        self._params = params
        self._own_actuators = actuators
        self._acting_params = acting_params(self._options, params, draws)

    def write(self, pack: EnginePack, states: EnvStates) -> None:
        """Continue with ``pack`` in the given state."""
        self.pack = pack
        if self._own_actuators is not None or self._drops_actuators:
            pack.write_joints(self._take_actuators())
        pack.write_state_rows(states.engine)
        self._containment.write(states.containment)
        pack.suspend(self._containment.suspended)
        pack.write_qf(states.effort)
        state = StepState(
            states.controller if self._controller else bp.PIDState(**states.controller)
        )
        self._saturated[...], self._motor[...] = states.saturated, states.effort
        for name, rows in states.sensors.items():
            self._sensed[name][...] = rows
        if self._pushes is not None:
            self._pushes.counts = {name: rows.copy() for name, rows in states.pushes.items()}
        if states.friction:
            leaves = (states.friction[name] for name in FrictionState._fields)
            state = state._replace(friction=FrictionState(*leaves), age=states.friction[AGE])
        if self._actuators is not None:
            motors = dict(states.actuators)
            self._episode = motors.pop(EPISODE).copy()
            state = state._replace(motors=ActuatorState(**motors))
        if states.guard:
            self._guarded[...] = states.guard[CHANGED]
            state = state._replace(
                guard=GuardState(*(states.guard[name] for name in GuardState._fields))
            )
        self._state = state
        self._prepare()
        self._write_drives()
        if self._contacts is not None:
            self._contacts.place(np.ones(pack.size, bool))

    def _vary(self, mask: NDArray[np.bool_]) -> None:
        """Put the draws of the envs of ``mask`` (M,) into effect, before these envs are placed."""
        rows = np.flatnonzero(mask).tolist()
        if self._options.randomization is None or self.draws is None or not rows:
            return
        self._take_state()
        if self._options.randomization.changes_robot:
            self.pack.vary(rows, variation(self._options, len(rows), self.draws.for_envs(rows)))
        self.pack.write_joints(self._take_actuators(), rows)
        self.set_params(self._params)

    # -- envs that fail
    # ----------------------------------------------------------------------------------------

    def _contain(self, before: Float64, done: int, returned: Any) -> None:
        """Suspend or reset the envs that failed ``done`` substeps into a tick, after positions
        ``before`` (M, dof).

        ``returned`` is the effort of the caller's own controller, or None.
        """
        containment, step = self._containment, self._steps + done
        qpos, qvel = self.pack.read_qpos(), self.pack.read_qvel()
        bad = far(qpos) | ~np.isfinite(qvel) | self.pack.strays()[:, None]
        # One step after a NaN effort at one joint, all joints are NaN. The effort shows the first
        # joint.
        failed = bad.any(1, keepdims=True)
        source = ~np.isfinite(self.pack.qf) & failed
        if returned is not None:
            wanted = clip(self._executor.rows(returned), *self._constants.limits, np)
            wrong = ~np.isfinite(wanted) & failed
            wrong = np.where(
                wrong.any(1, keepdims=True), wrong, source
            )  # actuators may have delayed it
            containment.fail(wrong, "effort", step, before)
        containment.fail(np.where(source.any(1, keepdims=True), source, bad), "state", step, before)
        if (limit := self._options.speed_limit) is not None:
            containment.fail((np.abs(qvel) > limit) & ~failed, "speed", step, before)
        self._place_failed()

    def _without_faults(self, command: Command) -> Command:
        """Mark the envs with non-finite commands as failed; return commands with neutral values for
        all failed envs.
        """
        containment = self._containment
        for cause, rows in command._asdict().items():
            if rows is not None:
                containment.fail(~np.isfinite(rows), cause, self._steps + 1, self._qpos)
        self._place_failed()
        neutral, failed = (
            (
                self._qpos if self._options.sets_positions else self._options.command.neutral,
                0.0,
                0.0,
                0.0,
            ),
            containment.failed[:, None],
        )
        both = zip(command, neutral, strict=True)
        return Command._make(
            None if rows is None else np.where(failed, value, rows) for rows, value in both
        )

    def _place_failed(self) -> None:
        """Place the envs that have failed since the last call: suspended, or at their start."""
        containment = self._containment
        failed = containment.pop_unplaced()
        if failed.any() and containment.suspends:
            self._place(
                failed, containment.suspended_qpos, np.zeros_like(containment.suspended_qpos)
            )
        elif failed.any():
            self._place(failed, containment.start_qpos, containment.start_qvel)

    def _place(self, mask: NDArray[np.bool_], qpos: Float64, qvel: Float64) -> None:
        """Place the envs of ``mask`` (M,), and restart their control."""
        rows = np.flatnonzero(mask)
        pack = self.pack
        state = self._take_state()
        base = None if pack.spec.fixed_base else self._containment.start_base[rows]
        pack.write_state(rows.tolist(), qpos[rows], qvel[rows], base)
        pack.suspend(self._containment.suspended)
        self._motor[mask], self._saturated[mask], self._guarded[mask] = 0.0, False, False
        if self._pushes is not None and self.draws is not None:
            self._pushes.begin(mask, self.draws.episodes)
        self._measured = self._executor.measure()
        if self._contacts is not None:
            self._contacts.place(mask)
        layout, qpos = self._layout, self._qpos
        state = reset_guard(self._constants, state, qpos, mask)
        if self._actuators is not None and state.motors is not None:
            self._episode[mask] += 1
            gravity, coriolis = passive_forces(self._options)
            holding = (
                self._constants.coupling.efforts(pack.passive_force(gravity, coriolis))
                if gravity
                else None
            )
            qvel = pack.read_qvel()
            fresh = init_motors(
                self._actuators, pack, qpos, self._episode, qvel=qvel, effort=holding
            )
            motors = bp.motors.reset(state.motors, fresh, mask)
            state = state._replace(motors=motors)
            model = layout.model
            noise = model.noise(self._constants.motors, motors, qpos)
            _, qpos, _ = advance_measurement(self._constants.motors, motors, qpos, qvel, noise)
        if self._controller is None:
            state = state._replace(law=bp.reset(self._acting_params, state.law, qpos, mask))
        else:
            state = state._replace(law=self._controller.reset(state.law, mask))
        self._state = reset_friction(layout, self._constants, state, pack, mask)
