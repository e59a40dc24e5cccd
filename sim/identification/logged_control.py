"""Control of the robot in a log: the Runner's control step, along simulated and measured motions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

import batchpid as bp
from batchpid import motors as actuator_model
from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import TURN, namespace
from batchpid.arrays.trees import leaves, mapped, structure
from batchpid.motors import guard as guard_model
from batchpid.motors.actuators import Actuators
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import Friction
from batchpid.motors.guard import Guard
from batchpid.native.array_program import ArrayProgram
from batchpid.native.availability import obstacle
from batchpid.native.tracing import Trace, trace_trees
from batchpid.sim.identification.unknowns import LAW, Motors
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.control_step import control_step, mass_matrix
from batchpid.sim.loop.pid_law import PIDLaw, half_way
from batchpid.sim.loop.step_values import Constants, Layout, Measured, Model, Step, StepState


@dataclass(frozen=True)
class LoggedDrive:
    """Control of the robot in a log."""

    timestep: float
    """Time step of the simulation [s]."""
    params: bp.PIDParams | None
    """Params of the PID law, of the logged joints; None for a log of efforts."""
    compensate: str
    """"gravity+coriolis", "gravity" or "none"."""
    through: bool = False
    """True if the compensation passes through the motors, with their strength and delay."""
    knows_payload: bool = False
    """True if the compensation includes the payload."""
    noisy: bool = False
    """True if the law is given the logged positions with their noise, False if without."""
    substeps: int = 1
    """Sim steps in one step of the law, during which its effort is constant."""
    measured_rate: bool = False
    """True if the law is given the joint velocity, False if it takes differences of positions."""
    guard: Guard | None = None
    """Limit of the setpoints' rate."""

    @property
    def compensation(self) -> tuple[str, bool, bool]:
        """Hypothesis about the compensation."""
        return self.compensate, self.through, self.knows_payload

    def of(self, motors: Motors) -> LoggedDrive:
        """Return the drive with gains, saturation and limit of the setpoints' rate of n candidates (n, joints)."""
        params = self.params
        if params is None or motors.keys().isdisjoint(LAW):
            return self
        gain, damping = motors.get("gain", 1.0), motors.get("kd", 1.0)
        factors = {"kp": gain, "ki": gain, "kd": gain * damping}
        gains = {
            name: getattr(params, name) * each for name, each in factors.items() if getattr(params, name) is not None
        }
        params = params._replace(**gains)
        if "saturation" in motors:
            most = params.kp * motors["saturation"]
            params = params._replace(effort_min=-most, effort_max=most)
        if "slew" not in motors:
            return replace(self, params=params)
        turns = None if params.continuous is None else params.continuous / TURN
        return replace(self, params=params, guard=Guard(rate=motors["slew"], turns=turns))

    @property
    def assumptions(self) -> dict[str, str | bool]:
        """Hypotheses about compensation and law, as plain values."""
        return {
            "compensation": self.compensate,
            "through_the_motors": self.through,
            "knows_payload": self.knows_payload,
            "noise_in_the_law": self.noisy,
            "measured_rate": self.measured_rate,
        }


class LoggedControl:
    """Control and motors of n robots: :func:`batchpid.sim.loop.control_step.control_step` at every sim step.

    It is a native program where programs are used, with the same bits as NumPy.
    """

    def __init__(
        self,
        drive: LoggedDrive,
        actuators: Actuators,
        qpos: Float64,
        qvel: Float64,
        asked: Float64 | None = None,
        damping: Float64 | None = None,
        model: Callable[[Float64], Float64] | None = None,
    ) -> None:
        """Begin at ``qpos`` and ``qvel`` (n, joints).

        ``asked`` are the efforts asked for so far, the latest first (samples, n, joints); None: 0. Laws with the mass
        matrix take ``model``, from positions to matrices, and the ``damping`` (joints,) that it knows.
        """
        dt, params, self._drive = drive.timestep, drive.params, drive
        self._number, self._matrix_steps = 0, 0
        control, state, k, law = "effort", StepState(None), None, None
        if params is not None:
            law = PIDLaw.of(params)._replace(measures_rate=drive.measured_rate)
            params = params._replace(measurement_rate=None)  # the log's loop decides, not the params
            control, k = "pid", bp.discretise(params, dt * drive.substeps, len(qpos))
            first = bp.init(params, qpos)
            guarded = None if drive.guard is None else guard_model.init(drive.guard, qpos)
            state = StepState(first if drive.substeps == 1 else (first, np.zeros_like(qpos)), guard=guarded)
        self._layout = Layout(control, law)
        constants = Constants(
            dt,
            (None, None),
            Coupling.of(qpos.shape[1]),
            k,
            friction=Friction(viscous=actuators.viscous),
            guard=drive.guard,
        )
        if not actuators._replace(**dict.fromkeys(actuator_model.JOINT_SIDE)).is_ideal:
            latest = None if asked is None else asked[0]
            motors = actuator_model.init(actuators, qpos, dt, qvel=qvel, effort=latest)
            if motors.command is not None and asked is not None:
                samples = np.minimum(np.arange(motors.command.shape[1]), len(asked) - 1)
                motors = motors._replace(command=np.ascontiguousarray(asked[samples].swapaxes(0, 1)))
            constants = constants._replace(motors=actuator_model.discretise(actuators, motors, dt, len(qpos)))
            state = state._replace(motors=motors)
        if law is not None and law.uses_mass_matrix:
            self._matrix_steps = law.matrix_steps
            state = state._replace(matrix=np.zeros((*qpos.shape, qpos.shape[1])))
            constants = constants._replace(damping=damping if np.any(damping) else None)
        self._model = Model(model)
        self._constants, self._state = constants, mapped(partial(np.array, order="C"), state)
        self._programs: dict[tuple[bool, bool], Any] = {}

    def advance(
        self, command: Float64, qpos: Float64, qvel: Float64, passive: Float64 | None, noise: Float64 | None = None
    ) -> Float64:
        """Return the motors' efforts in a sim step, less viscous friction (n, joints); which the next step may reuse.

        ``command`` are setpoints or efforts, ``passive`` is the force that the law compensates, and ``noise`` that of
        the measured positions, each (n, joints).
        """
        substeps = self._drive.substeps
        due = None if substeps == 1 else np.array([[float(self._number % substeps == 0)]])
        if self._matrix_steps and self._number % (substeps * self._matrix_steps) == 0:
            self._update_matrix(qpos, qvel)
        self._number += 1
        inputs = command, qpos, qvel, passive, noise, due
        key = passive is None, noise is None
        if key not in self._programs:
            self._programs[key] = self._program(inputs)
        if (program := self._programs[key]) is None:
            self._state, effort = _step(self._layout, self._constants, self._state, inputs)
            return effort
        run, state, results, effort = program
        run(*state, *[each for each in inputs if each is not None], out=results)
        return effort

    def _update_matrix(self, qpos: Float64, qvel: Float64) -> None:
        steps, dt = self._matrix_steps, self._drive.timestep * self._drive.substeps
        layout = self._layout._replace(model=self._model)
        self._state.matrix[...] = mass_matrix(layout, self._constants, half_way(qpos, qvel, steps, dt))

    def _program(self, inputs: tuple[Any, ...]) -> Any:
        """Return the program, the arrays of its state, of its results, and of the efforts; None for NumPy."""
        if obstacle():
            return None
        constants = mapped(lambda array: tuple(array) if array.ndim == 3 else array, self._constants)
        try:
            traced = _trace(self._layout, *map(structure, (constants, self._state, inputs)))
        except (
            TypeError,
            AttributeError,
            AssertionError,
        ):  # with tables, or with operations that programs lack: NumPy runs it
            return None
        effort, state = np.zeros_like(inputs[1]), leaves(self._state)
        program = ArrayProgram(traced, leaves(constants), len(state) + len(leaves(inputs)), effort.shape)
        return program, state, (*leaves(_returned(self._state)), effort), effort


def _step(layout: Layout, constants: Constants, state: StepState, inputs: tuple[Any, ...]) -> tuple[StepState, Any]:
    """Return state and efforts of a control step; ``due`` is 1.0 where the law is, 0.0 where its effort is kept."""
    command, qpos, qvel, passive, noise, due = inputs
    model = Model(
        when=lambda due, function, otherwise: otherwise,
        law=PIDLaw.advance if due is None else partial(_where_due, due),
        noise=None if noise is None else lambda *_: (noise, None),
    )
    measured, step = Measured(qpos, qvel, passive), Step(0, 1)
    new, outputs = control_step(layout._replace(model=model), constants, state, Command(command), measured, step)
    return new, outputs.qf


def _where_due(due: Any, law: PIDLaw, k: Any, state: Any, *inputs: Any, **options: Any) -> Any:
    """Advance a law where it is due; its state includes the effort that it asked for."""
    before, asked = state
    new, effort, saturated = law.advance(k, state[0], *inputs, **options)
    xp = namespace(due, effort)
    both = zip(new, before, strict=True)
    law_state = [None if leaf is None else xp.where(due > 0, leaf, old) for leaf, old in both]
    asked = xp.where(due > 0, effort, asked)
    return (bp.PIDState(*law_state), asked), asked, saturated


@lru_cache(maxsize=64)
def _trace(layout: Layout, *structures: Any) -> Trace:
    def function(*parts: Any) -> list[Any]:
        new, effort = _step(layout, *parts)
        return [*leaves(_returned(new)), effort]

    return trace_trees(function, *structures)


def _returned(state: StepState) -> StepState:
    """Return what a program returns of a state: without the matrix, and histories, which it changes in place."""
    motors = None if state.motors is None else state.motors._replace(command=None, sensor=None)
    return state._replace(matrix=None, motors=motors)
