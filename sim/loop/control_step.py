r"""One sim step of the control of many robots: a pure function of arrays, for NumPy and JAX.

In this order, with setpoint r, joint positions q and velocities v, and passive force p::

    setpoint    r    = r at this moment of the tick   where its rate is given: :func:`carried`
    guard       r    = guard(r)                       limits of position, rate and acceleration
    sensors     y    = sensors(q), y' = sensors(v)
    forward     f    = p + feedforward + known friction
    law         u    = saturated(law(r, r', r'', y, y', f))
    motors      m    = motors(u)
    friction    qf   = m - friction(m, v)             applied in the next sim step

Executors call :func:`control_step` at every sim step, each with its own kind of arrays:
:mod:`batchpid.sim.loop.numpy_executor`, :mod:`batchpid.sim.loop.xla_executor`. A :class:`StepState` is the whole state
of the control between sim steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.elementwise import clip, namespace, nearest_turn, replace_envs, wrap
from batchpid.law.coefficients import Coefficients
from batchpid.motors import STAGES, ActuatorState, Stages, advance_effort, advance_measurement
from batchpid.motors import friction as friction_model
from batchpid.motors import guard as guard_model
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import Friction, FrictionState
from batchpid.motors.guard import GuardState
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.pid_law import PIDLaw, half_way

REFRESH_STEPS = 64
"""Sim steps of an env between updates of the friction model's inertia."""


class StepState(NamedTuple):
    """State of the control of M envs between sim steps; arrays have the envs as their first axis."""

    law: Any
    """:class:`batchpid.PIDState`, or the arrays of the caller's own controller by name."""
    friction: FrictionState = FrictionState()
    age: Any = None
    """Sim steps since the last update of the friction model's inertia (M,); None without Coulomb friction."""
    motors: ActuatorState | None = None
    """Motors and sensors; None for ideal ones."""
    guard: GuardState | None = None
    matrix: Any = None
    """Mass matrix of the law (M, dof, dof), or its diagonal (M, dof). Each tick begins with a new one."""


class Measured(NamedTuple):
    """Reading of the robots before a sim step, arrays (M, dof)."""

    qpos: Any
    qvel: Any
    """None where nothing needs it."""
    passive: Any
    """Efforts that cancel gravity, and Coriolis and centrifugal forces; None without compensation."""


class Step(NamedTuple):
    """Place of a sim step in its tick."""

    index: Any
    """Sim steps of the tick before this one."""
    end: Any
    """Sim steps of the tick."""
    observed: bool = True
    """Whether :attr:`Outputs.saturated` is wanted."""
    left: Any = 0.0
    """:meth:`Layout.left`: time from the moment of the law's setpoint to the end of the tick [s]."""


class Inputs(NamedTuple):
    """Inputs of a law in a sim step."""

    command: Command
    """Command, with guarded setpoints."""
    seen: Measured
    """Measurement by the sensors, with the whole feedforward as its passive force."""
    limits: tuple[Any, Any]
    """Least and largest effort that the motors do not clip; None for no limit."""
    step: Step


class Outputs(NamedTuple):
    """Results of a sim step, arrays (M, dof)."""

    qf: Any
    """Effort to apply to the joints in the next step of the engine [N m or N]."""
    motor: Any
    """Effort of the motors."""
    saturated: Any
    """Joints whose effort was limited; None where it is not wanted."""
    guarded: Any = None
    """Setpoints that the guard changed; None without guard."""
    returned: Any = None
    """Effort that the caller's own controller returned; None for other controls."""
    target: Any = None
    """Position target of the engine's drives [rad or m]; None without drives."""
    target_rate: Any = None


class KnownFriction(NamedTuple):
    """Friction that the compensation cancels, arrays (dof,)."""

    friction: Any
    """[N m or N]"""
    band: Any
    """Half width of the band of small errors in which the compensation is reduced [rad or m]."""
    turns: Any
    """1 / (2 pi) on continuous joints, 0 elsewhere; None without such joints."""


class Constants(NamedTuple):
    """Arrays that stay the same for many ticks, (M, dof) or (1, dof); None where they are not needed."""

    timestep: Any
    """[s]"""
    limits: tuple[Any, Any]
    """Least and largest effort of the params [N m or N]."""
    coupling: Coupling
    k: Coefficients | None = None
    """Coefficients of the PID law."""
    armature: Any = None
    """Armature of the motors that the law knows (dof,) [kg m^2 or kg]."""
    damping: Any = None
    """Viscous damping B that a law with the mass matrix compensates (dof,) [N m s/rad or N s/m]."""
    friction: Friction = Friction()
    drive: tuple[Any, Any] = (0.0, 0.0)
    """Damping and stiffness of the engine's drives [N m s/rad, N m/rad]."""
    known: KnownFriction | None = None
    guard: Any = None
    """:class:`batchpid.Guard`"""
    motors: Any = None
    """:class:`batchpid.motors.Coefficients` of motors and sensors."""
    driven: bp.PIDParams | None = None
    """Params of the integral that moves the targets of drives."""
    turns: Any = None
    """1 / (2 pi) on continuous joints with drives, 0 elsewhere; None without such joints."""


def when(due: Any, function: Callable[[], Any], otherwise: Any) -> Any:
    """Return ``function()`` if ``due``, a bool or an array, has a True entry; else ``otherwise``."""
    return function() if np.any(due) else otherwise


class Model(NamedTuple):
    """Functions that an executor passes to the control step. Their results do not depend on the executor."""

    mass_matrix: Any = None
    """qpos (M, dof) -> mass matrix of the description (M, dof, dof), as the law knows it."""
    joint_mass_matrix: Any = None
    """qpos -> effective mass matrix of the joints, armature of the motors included."""
    refresh: Any = None
    """state of the friction model, qpos -> the state with its inertia there; None: by :attr:`joint_mass_matrix`."""
    passive_force: Any = None
    """qpos, qvel -> passive force of the description, for a measured state that differs from the joints' state."""
    when: Callable[[Any, Callable[[], Any], Any], Any] = when
    """:func:`when`, or a conditional of JAX."""
    law: Callable[..., Any] = PIDLaw.advance
    """:meth:`batchpid.sim.loop.pid_law.PIDLaw.advance`, or its compiled form."""
    controller: Any = None
    """Caller's own controller: (state, setpoint, qpos, qvel, feedforward) -> (state, effort), and, if it limits efforts
    itself, the mask of joints with limited efforts."""
    noise: Any = None
    """coefficients and state of the sensors, qpos -> their noise, drawn in advance; None to draw it at each step."""
    stages: Stages = STAGES
    measure: Callable[..., Any] = advance_measurement
    """:func:`batchpid.motors.advance_measurement`, or its known results."""


class Layout(NamedTuple):
    """Options of a control step that are not arrays; hashable."""

    control: str
    """"pid", "drive", "effort" or "custom"."""
    law: PIDLaw | None = None
    """Law of control "pid"."""
    measures: bool = False
    """Whether the law takes the joints' state from sensors."""
    model: Model = Model()

    def left(self, index: Any, end: Any, timestep: Any) -> Any:
        """Return the time from the law's setpoint in sim step ``index`` to the end of a tick of ``end`` steps [s].

        The explicit law takes its setpoint at the beginning of the step, the implicit law and drives at the end.
        """
        return (end - index - self.late) * timestep

    @property
    def late(self) -> int:
        """1 if the law takes its setpoint at the end of a sim step, else 0."""
        return int(self.control == "drive" or (self.law is not None and self.law.implicit))


def control_step(
    layout: Layout, constants: Constants, state: StepState, command: Command, measured: Measured, step: Step
) -> tuple[StepState, Outputs]:
    """Advance the control by one sim step; return its state and the efforts to apply. Inputs are not modified."""
    qpos, qvel, passive = measured
    guard, motors, guarded, seen, seen_rate = state.guard, state.motors, None, qpos, qvel
    if layout.control in ("pid", "drive"):
        command = carried(command, step.left)
    limits: tuple[Any, Any] = (None, None)
    if guard is not None:
        guard, command, guarded = _guarded(constants, guard, command)
    if motors is not None:
        noise = None if layout.model.noise is None else layout.model.noise(constants.motors, motors, qpos)
        stages = layout.model.stages
        motors, seen, seen_rate = layout.model.measure(constants.motors, motors, qpos, qvel, noise, stages)
        limits = stages.limits(constants.motors, seen, seen_rate)
        if layout.measures and layout.model.passive_force is not None:
            passive = layout.model.passive_force(seen, seen_rate)
    forward = feedforward(constants, command, seen, passive)
    given = Inputs(command, Measured(seen, seen_rate, forward), limits, step)
    state, outputs = _CONTROLS[layout.control](layout, constants, state, given)
    motor = outputs.motor
    if motors is not None:
        motors, motor = advance_effort(constants.motors, motors, motor, qpos, qvel, layout.model.stages)
    friction, age, qf = apply_friction(layout, constants, state, motor, measured)
    new = state._replace(friction=friction, age=age, motors=motors, guard=guard)
    return new, outputs._replace(qf=qf, motor=motor, guarded=guarded)


def mass_matrix(layout: Layout, constants: Constants, qpos: Any) -> Any:
    """Return the law's mass matrix (M, dof, dof): M + known armature + dt B, for the leaders only."""
    xp, matrix = namespace(qpos), layout.model.mass_matrix(qpos)
    if constants.armature is not None:
        matrix = matrix + xp.diag(constants.armature)
    if constants.damping is not None:
        matrix = matrix + constants.timestep * xp.diag(constants.damping)
    return constants.coupling.mass_matrix(matrix)


def refreshed(layout: Layout, constants: Constants, friction: FrictionState, qpos: Any) -> FrictionState:
    """Return the state of the friction model with the inertia at ``qpos``, for the leaders only."""
    if layout.model.refresh is not None:
        return layout.model.refresh(friction, qpos)
    matrix = constants.coupling.mass_matrix(layout.model.joint_mass_matrix(qpos))
    return friction_model.refresh(constants.friction, friction, matrix, constants.timestep, *constants.drive)


def carried(command: Command, left: Any) -> Command:
    """Return ``command`` at the time ``left`` before the end of its tick, where its rate is given::

        r <- r - left (r' - left r'' / 2)        r' <- r' - left r''

    A setpoint and its rate hold at the end of their tick, as in :class:`batchpid.trajectories.Trajectory`; an
    acceleration is the same in the whole tick.
    """
    setpoint, rate, acceleration, _ = command
    if rate is None:
        return command
    if acceleration is None:
        return command._replace(setpoint=setpoint - left * rate)
    change = left * acceleration
    return command._replace(setpoint=setpoint - left * (rate - 0.5 * change), setpoint_rate=rate - change)


def _guarded(constants: Constants, state: GuardState, command: Command) -> tuple[Any, Command, Any]:
    """Return the guard's state, ``command`` with guarded setpoints and rates (if given), and the mask of changes.

    A given acceleration is 0 where the guard changes the setpoint. Followers move with their leaders.
    """
    xp = namespace(command.setpoint)
    state, changed = guard_model.advance(constants.guard, state, command.setpoint, constants.timestep)
    setpoint, rate, acceleration = state.setpoint, command.setpoint_rate, command.setpoint_acceleration
    if rate is not None:
        rate = xp.where(changed, state.rate, rate)
    if acceleration is not None:
        acceleration = xp.where(changed, 0.0, acceleration)
    coupling = constants.coupling
    setpoint, changed = coupling.positions(setpoint), coupling.of_leaders(changed)
    rate, acceleration = (None if each is None else coupling.rates(each) for each in (rate, acceleration))
    moved = {"setpoint": setpoint, "setpoint_rate": rate, "setpoint_acceleration": acceleration}
    return state, command._replace(**moved), changed


def feedforward(constants: Constants, command: Command, qpos: Any, passive: Any) -> Any:
    """Return the passive force plus the caller's feedforward and known friction, for the leaders; None for zero."""
    forward = _sum(passive, command.feedforward)
    forward = None if forward is None else constants.coupling.efforts(forward)
    if (known := constants.known) is None:
        return forward
    error = wrap(command.setpoint - qpos, known.turns, namespace(qpos))
    return _sum(friction_model.compensation(known.friction, error, command.setpoint_rate, known.band), forward)


def _pid(layout: Layout, constants: Constants, state: StepState, given: Inputs) -> tuple[StepState, Outputs]:
    """qf = sat(PID(setpoint, qpos) + feedforward). A mass matrix is kept for ``law.matrix_steps``."""
    command, seen, limits, step = given
    law, matrix, qvel = layout.law, state.matrix, seen.qvel
    assert law is not None

    def fresh() -> Any:
        xp = namespace(seen.qpos)
        steps = xp.minimum(law.matrix_steps, step.end - step.index).astype(seen.qpos.dtype)
        found = mass_matrix(layout, constants, half_way(seen.qpos, qvel, steps, constants.timestep))
        return found if law.whole else xp.einsum("ejj->ej", found).copy()

    if law.needs_matrix:
        matrix = layout.model.when(step.index % law.matrix_steps == 0, fresh, matrix)
    viscous = None if constants.damping is None else constants.coupling.efforts(constants.damping * qvel)
    setpoint, rate, acceleration, _ = command
    if acceleration is not None:  # the leaders' mass matrix has the followers' share
        acceleration = constants.coupling.of_independent(acceleration)
    inputs = ((setpoint, rate, acceleration), seen.qpos, qvel, seen.passive, matrix, viscous, *limits)
    new, effort, saturated = layout.model.law(law, constants.k, state.law, *inputs)
    return state._replace(law=new, matrix=matrix), Outputs(effort, effort, saturated)


def _drive(layout: Layout, constants: Constants, state: StepState, given: Inputs) -> tuple[StepState, Outputs]:
    """PhysX's internal drive with stiffness kp and damping kd; qf = feedforward.

    With ki the drive's target moves by the integral over kp (:func:`batchpid.drive_target`), so that the drive acts as
    a PID whose P and D the engine integrates implicitly. The engine's drives do not know whole turns, so the target of
    a continuous joint is the one next to qpos, which may jump at every sim step.
    """
    (target, rate, *_), seen, *_ = given
    xp = namespace(seen.qpos)
    target = nearest_turn(target, seen.qpos, constants.turns, xp)
    if constants.driven is not None:
        rates = {"setpoint_rate": rate, "feedforward": seen.passive}
        law, target = bp.drive_target(constants.driven, state.law, target, seen.qpos, constants.timestep, **rates)
        state = state._replace(law=law)
    effort = xp.zeros_like(seen.qpos) if seen.passive is None else seen.passive
    return state, Outputs(effort, effort, None, target=target, target_rate=rate)


def _effort(layout: Layout, constants: Constants, state: StepState, given: Inputs) -> tuple[StepState, Outputs]:
    """qf = sat(the caller's effort + feedforward); the setpoint is the effort, and a follower's acts on its leader."""
    asked = constants.coupling.efforts(given.command.setpoint)
    return state, _saturated(constants, _sum(asked, given.seen.passive), given)


def _custom(layout: Layout, constants: Constants, state: StepState, given: Inputs) -> tuple[StepState, Outputs]:
    """qf = sat(effort of the caller's own controller). The feedforward is an input of the controller."""
    seen = given.seen
    passive = namespace(seen.qpos).zeros_like(seen.qpos) if seen.passive is None else seen.passive
    law, returned, *limited = layout.model.controller(state.law, given.command.setpoint, seen.qpos, seen.qvel, passive)
    outputs = _saturated(constants, constants.coupling.efforts(returned), given)._replace(returned=returned)
    if limited and outputs.saturated is not None:
        outputs = outputs._replace(saturated=outputs.saturated | limited[0])
    return state._replace(law=law), outputs


_CONTROLS: dict[str, Callable[..., tuple[StepState, Outputs]]] = {
    "pid": _pid,
    "drive": _drive,
    "effort": _effort,
    "custom": _custom,
}


def apply_friction(
    layout: Layout, constants: Constants, state: StepState, motor: Any, measured: Measured
) -> tuple[FrictionState, Any, Any]:
    """Return the friction model's state, its age, and the effort to apply for the motors' effort ``motor`` (M, dof)."""
    model, friction, age = constants.friction, state.friction, state.age
    if model.coulomb is not None:
        xp, due = namespace(age), age == REFRESH_STEPS

        def fresh() -> FrictionState:
            return replace_envs(friction, refreshed(layout, constants, friction, measured.qpos), due)

        friction = layout.model.when(due, fresh, friction)
        age = xp.where(due, 0, age) + 1
    friction, qf = friction_model.advance(model, friction, motor, measured.qvel)
    return friction, age, qf


def _saturated(constants: Constants, total: Any, given: Inputs) -> Outputs:
    """Return ``total`` clipped to the limits of motors and params."""
    xp = namespace(total, *given.limits)
    effort = clip(clip(total, *given.limits, xp), *constants.limits, xp)
    return Outputs(effort, effort, effort != total if given.step.observed else None)


def _sum(first: Any, second: Any) -> Any:
    """Return the sum of two arrays, either of which may be None for zero."""
    return first if second is None else second if first is None else first + second
