r"""One sim step of the control of many robots: a table of stages, each a pure function of arrays,
for NumPy and JAX.

With setpoint r, joint positions q and velocities v, and passive force p, :data:`STAGES` are in this
order::

    sensors         y    = sensors(q), y' = sensors(v)
    passive force   p    = p(y, y')                       where sensors measure
    inertia         of the friction model                 every 64 sim steps of an env
    mass matrix     M    = M(y) half way ahead            every 4 sim steps of a tick, 1 with the implicit law
    setpoint        r    = r at this moment of the tick   where its rate is given: :func:`carried`
    guard           r    = guard(r)                       limits of position, rate and acceleration
    feedforward     f    = p + feedforward + modelled friction
    controller      u    = the caller's own
    law             qf   = saturated(law(r, r', r'', y, y', f)), or saturated(u + f)
    motors          qf   = motors(qf)
    friction        qf   = qf - friction(qf, v)
    targets         of the engine's drives
    constraint      of coupled joints                     every 4 sim steps of a tick
    engine          applies qf, does its step; q, v and p are read

The executors run this table, each with its own kind of arrays.
:mod:`batchpid.sim.loop.numpy_executor` and :mod:`batchpid.sim.loop.xla_executor` call its
functions. :mod:`batchpid.sim.loop.native_program` makes native programs of them. The last three
stages are the executors' own. A :class:`batchpid.sim.loop.step_values.StepState` is the whole state
of the control between sim steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import clip, namespace, nearest_turn, replace_envs, wrap
from batchpid.law.pid import advance_drive
from batchpid.motors import advance_effort, advance_measurement, command_limits
from batchpid.motors import friction as friction_model
from batchpid.motors import guard as guard_model
from batchpid.motors.friction import FrictionState
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.step_values import (
    Constants,
    Layout,
    Measured,
    Outputs,
    Step,
    StepState,
    Values,
    half_way,
)

REFRESH_STEPS = 64
"""Sim steps of an env between updates of the friction model's inertia."""
COUPLING_STEPS = 4
"""Sim steps for which the constraint efforts of coupled joints keep their mass matrix within a
tick.
"""


def control_step(
    layout: Layout,
    constants: Constants,
    state: StepState,
    setpoint: Array,
    measured: Measured,
    step: Step,
) -> tuple[StepState, Outputs]:
    """Advance the control by one sim step under a setpoint; return its state and the efforts to
    apply. Inputs are not modified.
    """
    zero = namespace(setpoint).zeros_like(setpoint)
    command = Command(setpoint, zero, zero, zero)
    values = sim_step(layout, constants, Values(state, command, measured, step, measured), {})
    return values.state, values.outputs


def sim_step(
    layout: Layout,
    constants: Constants,
    values: Values,
    engine: Mapping[str, StageFunction],
) -> Values:
    """Run the stages of a sim step in the order of the table; ``engine`` has the executor's own
    stages, by name.
    """
    for stage in STAGES:
        function = stage.function or engine.get(stage.name)
        if function is not None and stage.applies(layout, constants):
            values = function(layout, constants, values)
    return values


def mass_matrix(layout: Layout, constants: Constants, qpos: Array) -> Array:
    """Return the law's mass matrix (M, dof, dof): M + known armature + dt B, for the leaders
    only.
    """
    xp = namespace(qpos)
    matrix = layout.model.mass_matrix(qpos)
    if constants.armature is not None:
        matrix = matrix + xp.diag(constants.armature)
    if constants.damping is not None:
        matrix = matrix + constants.timestep * xp.diag(constants.damping)
    return constants.coupling.mass_matrix(matrix)


def refreshed(
    layout: Layout,
    constants: Constants,
    friction: FrictionState,
    qpos: Array,
) -> FrictionState:
    """Return the state of the friction model with the inertia at ``qpos``, for the leaders only."""
    if layout.model.refresh is not None:
        fresh: FrictionState = layout.model.refresh(friction, qpos)
        return fresh
    matrix = constants.coupling.mass_matrix(layout.model.joint_mass_matrix(qpos))
    return friction_model.refresh(
        constants.friction, friction, matrix, constants.timestep, *constants.drive
    )


def carried(command: Command, left: Array) -> Command:
    """Return ``command`` at the time ``left`` before the end of its tick::

        r <- r - left (r' - left r'' / 2)        r' <- r' - left r''

    A setpoint and its rate hold at the end of their tick, as in
    :class:`batchpid.trajectories.Trajectory`; an acceleration is the same in the whole tick.
    """
    setpoint, rate, acceleration, _ = command
    change = left * acceleration
    return command._replace(
        setpoint=setpoint - left * (rate - 0.5 * change), setpoint_rate=rate - change
    )


# -- stages
# --------------------------------------------------------------------------------------------------


def _sensors(layout: Layout, constants: Constants, values: Values) -> Values:
    motors = values.state.motors
    (qpos, qvel, passive) = values.measured
    model = layout.model
    if model.noise is None:
        noise = values.noise
    else:
        noise = model.noise(constants.motors, motors, qpos)
    motors, qpos, qvel = advance_measurement(constants.motors, motors, qpos, qvel, noise)
    seen = Measured(qpos, qvel, passive)
    return values._replace(state=values.state._replace(motors=motors), seen=seen, noise=None)


def _passive_force(layout: Layout, constants: Constants, values: Values) -> Values:
    """The passive force of the description at the measured state, which the engine does not
    know.
    """
    passive = layout.model.passive_force(values.seen.qpos, values.seen.qvel)
    return values._replace(seen=values.seen._replace(passive=passive))


def _inertia(layout: Layout, constants: Constants, values: Values) -> Values:
    """The inertia of the friction model, for the envs where it is ``REFRESH_STEPS`` old."""
    state, qpos = values.state, values.measured.qpos
    # The age counts from the env's own reset, so that an env does not depend on others.
    xp = namespace(state.age)
    due = state.age == REFRESH_STEPS

    def fresh() -> FrictionState:
        return replace_envs(state.friction, refreshed(layout, constants, state.friction, qpos), due)

    friction = layout.model.when(due, fresh, state.friction)
    age = xp.where(due, 0, state.age) + 1
    return values._replace(state=state._replace(friction=friction, age=age))


def _mass_matrix(layout: Layout, constants: Constants, values: Values) -> Values:
    """The mass matrix of the law, which is kept for ``law.matrix_steps``."""
    (qpos, qvel, _) = values.seen
    step = values.step
    law = layout.law
    assert law is not None

    def fresh() -> Any:
        # Half way through the steps for which it serves, where its error is least on average.
        xp = namespace(qpos)
        steps = xp.minimum(law.matrix_steps, step.end - step.index).astype(qpos.dtype)
        return mass_matrix(layout, constants, half_way(qpos, qvel, steps, constants.timestep))

    matrix = layout.model.when(step.index % law.matrix_steps == 0, fresh, values.state.matrix)
    return values._replace(state=values.state._replace(matrix=matrix))


def _setpoint(layout: Layout, constants: Constants, values: Values) -> Values:
    """The setpoint at the moment of this sim step."""
    return values._replace(command=carried(values.command, values.step.left))


def _guard(layout: Layout, constants: Constants, values: Values) -> Values:
    """Guarded setpoints and rates, and the mask of changes. Followers move with their leaders.

    A given acceleration is 0 where the guard changes the setpoint.
    """
    setpoint, rate, acceleration, _ = values.command
    coupling = constants.coupling
    xp = namespace(setpoint)
    state, changed = guard_model.advance(
        constants.guard, values.state.guard, setpoint, constants.timestep
    )
    # The guard limits leaders; a follower's setpoint comes from its leader's.
    command = values.command._replace(setpoint=coupling.positions(state.setpoint))
    if layout.moves:
        command = command._replace(
            setpoint_rate=coupling.rates(xp.where(changed, state.rate, rate)),
            setpoint_acceleration=coupling.rates(xp.where(changed, 0.0, acceleration)),
        )
    return values._replace(
        state=values.state._replace(guard=state),
        command=command,
        outputs=values.outputs._replace(guarded=coupling.of_leaders(changed)),
    )


def _feedforward(layout: Layout, constants: Constants, values: Values) -> Values:
    """The passive force plus the caller's feedforward and modelled friction, for the leaders."""
    command, seen = values.command, values.seen
    forward = constants.coupling.efforts(seen.passive + command.feedforward)
    if (modelled := constants.modelled) is not None:
        error = wrap(command.setpoint - seen.qpos, modelled.turns, namespace(seen.qpos))
        forward = forward + friction_model.compensation(
            modelled.friction, error, command.setpoint_rate, modelled.band
        )
    return values._replace(seen=seen._replace(passive=forward))


def _controller(layout: Layout, constants: Constants, values: Values) -> Values:
    """The caller's own controller; the feedforward is one of its inputs."""
    inputs = values.command.setpoint, *values.seen, values.step.left
    law, returned, *limited = layout.model.controller(values.state.law, *inputs)
    return values._replace(
        state=values.state._replace(law=law),
        limited=limited[0] if limited else None,
        outputs=values.outputs._replace(returned=returned),
    )


def _law(layout: Layout, constants: Constants, values: Values) -> Values:
    """Effort within the limits of params and motors."""
    qvel = values.seen.qvel
    limits: tuple[Array, Array] = (None, None)
    if constants.motors is not None:
        limits = command_limits(constants.motors, qvel)
    values = _LAWS[layout.control](layout, constants, values, limits)
    return values._replace(outputs=values.outputs._replace(motor=values.outputs.qf))


def _pid(
    layout: Layout,
    constants: Constants,
    values: Values,
    limits: tuple[Array, Array],
) -> Values:
    """qf = sat(PID(setpoint, qpos) + feedforward)."""
    qpos, qvel, forward = values.seen
    state, law = values.state, layout.law
    coupling = constants.coupling
    assert law is not None
    # The engine integrates this damping implicitly: see PIDLaw.advance.
    viscous = None
    if constants.damping is not None:
        viscous = coupling.efforts(constants.damping * qvel)
    setpoint, rate, acceleration, _ = values.command
    motion: tuple[Array, Array, Array] = (setpoint, None, None)
    if layout.moves:  # the leaders' mass matrix has the followers' share
        motion = setpoint, rate, coupling.of_independent(acceleration)
    inputs = motion, qpos, qvel, forward, state.matrix, viscous, *limits
    new, effort, saturated = law.advance(constants.k, state.law, *inputs)
    outputs = values.outputs._replace(qf=effort, saturated=saturated)
    return values._replace(state=state._replace(law=new), outputs=outputs)


def _drive(
    layout: Layout,
    constants: Constants,
    values: Values,
    limits: tuple[Array, Array],
) -> Values:
    """The engine's drives with stiffness kp and damping kd; qf = feedforward.

    With ki the drive's target moves by the integral over kp (:func:`batchpid.drive_target`), so
    that the drive acts as a PID whose P and D the engine integrates implicitly. The engine's drives
    do not know whole turns, so the target of a continuous joint is the one next to qpos, which may
    jump at every sim step.
    """
    (target, rate, *_) = values.command
    seen = values.seen
    state = values.state
    target = nearest_turn(target, seen.qpos, constants.turns, namespace(seen.qpos))
    if constants.driven is not None:
        rates = {"setpoint_rate": rate if layout.moves else None, "feedforward": seen.passive}
        law, target = advance_drive(constants.driven, state.law, target, seen.qpos, **rates)
        state = state._replace(law=law)
    outputs = values.outputs._replace(qf=seen.passive, target=target, target_rate=rate)
    return values._replace(state=state, outputs=outputs)


def _effort(
    layout: Layout,
    constants: Constants,
    values: Values,
    limits: tuple[Array, Array],
) -> Values:
    """qf = sat(the caller's effort + feedforward); the setpoint is the effort, and a follower's
    acts on its leader.
    """
    effort = constants.coupling.efforts(values.command.setpoint)
    return _saturated(constants, effort + values.seen.passive, values, limits)


def _custom(
    layout: Layout,
    constants: Constants,
    values: Values,
    limits: tuple[Array, Array],
) -> Values:
    """qf = sat(effort of the caller's own controller)."""
    # A follower's effort acts on its leader.
    effort = constants.coupling.efforts(values.outputs.returned)
    values = _saturated(constants, effort, values, limits)
    if values.limited is None:
        return values
    saturated = values.outputs.saturated | (values.limited > 0)
    return values._replace(outputs=values.outputs._replace(saturated=saturated))


_LAWS: dict[str, Callable[..., Values]] = {
    "pid": _pid,
    "drive": _drive,
    "effort": _effort,
    "custom": _custom,
}


def _motors(layout: Layout, constants: Constants, values: Values) -> Values:
    (qpos, qvel, _) = values.measured
    state = values.state
    outputs = values.outputs
    motors, effort = advance_effort(constants.motors, state.motors, outputs.qf, qpos, qvel)
    return values._replace(
        state=state._replace(motors=motors), outputs=outputs._replace(qf=effort, motor=effort)
    )


def _friction(layout: Layout, constants: Constants, values: Values) -> Values:
    state, outputs = values.state, values.outputs
    friction, qf = friction_model.advance(
        constants.friction, state.friction, outputs.qf, values.measured.qvel
    )
    return values._replace(state=state._replace(friction=friction), outputs=outputs._replace(qf=qf))


def _saturated(
    constants: Constants,
    total: Array,
    values: Values,
    limits: tuple[Array, Array],
) -> Values:
    """Return ``values`` with the effort ``total`` clipped to the limits of motors and params."""
    xp = namespace(total, *limits)
    effort = clip(clip(total, *limits, xp), *constants.limits, xp)
    return values._replace(outputs=values.outputs._replace(qf=effort, saturated=effort != total))


StageFunction = Callable[[Layout, Constants, Values], Values]


def _always(layout: Layout, constants: Constants) -> bool:
    return True


def _has_motors(layout: Layout, constants: Constants) -> bool:
    return constants.motors is not None


def uses_mass_matrix(layout: Layout, constants: Constants) -> bool:
    """Return whether the law has gains per mass matrix."""
    return layout.law is not None and layout.law.uses_mass_matrix


class SimStage(NamedTuple):
    """Stage of a sim step."""

    name: str
    applies: Callable[[Layout, Constants], bool] = _always
    """Whether a group of envs needs it."""
    function: StageFunction | None = None
    """Pure function of arrays; None for a stage that executors do in their own ways."""


STAGES = (
    SimStage("sensors", _has_motors, _sensors),
    SimStage("passive force", lambda layout, _: layout.measures and layout.gravity, _passive_force),
    SimStage("inertia", lambda _, constants: constants.friction.coulomb is not None, _inertia),
    SimStage("mass matrix", uses_mass_matrix, _mass_matrix),
    SimStage("setpoint", lambda layout, _: layout.moves, _setpoint),
    SimStage("guard", lambda _, constants: constants.guard is not None, _guard),
    SimStage("feedforward", _always, _feedforward),
    SimStage("controller", lambda layout, _: layout.control == "custom", _controller),
    SimStage("law", _always, _law),
    SimStage("motors", _has_motors, _motors),
    SimStage("friction", _always, _friction),
    SimStage("targets", lambda layout, _: layout.control == "drive"),
    SimStage("constraint", lambda _, constants: not constants.coupling.is_identity),
    SimStage("engine"),
)
"""Stages of a sim step, in order."""
