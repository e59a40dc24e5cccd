"""Layout, constants and state of the control step of a group of envs, from its options, params and
robots.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid import motors as actuator_model
from batchpid.arrays.array_types import Array, Bool, Float64
from batchpid.arrays.elementwise import TURN, replace_envs
from batchpid.law.computed_torque import convert_integral
from batchpid.motors import ActuatorState
from batchpid.motors import friction as friction_model
from batchpid.motors import guard as guard_model
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import FrictionState
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.control_step import REFRESH_STEPS, mass_matrix, refreshed
from batchpid.sim.loop.pid_law import PIDLaw
from batchpid.sim.loop.step_values import Constants, KnownFriction, Layout, StepState
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.robot.actuator_checks import BAND, known_joints
from batchpid.sim.robot.mimics import coupling_of
from batchpid.sim.robot.parts import DISSIPATION


def make_layout(
    options: RunnerOptions, params: bp.PIDParams, actuators: bp.Actuators | None
) -> Layout:
    """Return the layout of the control step, without the executor's model."""
    control = options.control if isinstance(options.control, str) else "custom"
    law = PIDLaw.of(params) if control == "pid" else None
    return Layout(control, law, actuators is not None and actuators.measures)


def make_constants(
    options: RunnerOptions,
    pack: EnginePack,
    params: bp.PIDParams,
    actuators: bp.Actuators | None = None,
    motors: ActuatorState | None = None,
) -> Constants:
    """Return the constants of the envs of ``pack``.

    ``params`` and ``actuators`` include the draws of the randomization. ``motors`` is the state of
    actuators that change efforts or measurements; None without such actuators.
    """
    scene = pack.spec
    robot = options.robot
    guard = None
    known = None if robot.actuators is None else known_joints(robot)
    law, damping = PIDLaw.of(params), np.array([joint.damping for joint in scene.joints])
    damping = damping if known is None else damping + known.viscous
    coupling = coupling_of(scene.joints)
    acting = acting_gains(params, coupling)
    if options.guard is not None:
        row = pack.first_env - options.first_env
        guard = options.guard.for_envs(slice(row, row + pack.size))
    constants = Constants(
        timestep=scene.timestep,
        limits=(params.effort_min, params.effort_max),
        friction=pack.friction,
        known=_known_friction(options, pack),
        guard=guard,
        coupling=coupling,
        motors=(
            None
            if actuators is None or motors is None
            else actuator_model.discretise(actuators, motors, scene.timestep, pack.size)
        ),
    )
    if options.control == "pid":
        return constants._replace(
            k=bp.discretise(acting, scene.timestep),
            armature=None if known is None else known.armature,
            damping=damping if law.uses_mass_matrix and damping.any() else None,
        )
    if options.control == "drive":
        kd = np.zeros_like(acting.kp) if acting.kd is None else acting.kd
        integrates = params.ki is not None and bool(np.any(params.ki > 0))
        driven = (
            bp.discretise(acting._replace(measurement_rate=None), scene.timestep)
            if integrates
            else None
        )
        return constants._replace(drive=(kd, acting.kp), driven=driven, turns=_turns(pack))
    return constants


def acting_gains(params: bp.PIDParams, coupling: Coupling) -> bp.PIDParams:
    """Return ``params`` with zero gains for followers, which move with their leaders."""
    gains = {"kp": params.kp, "ki": params.ki, "kd": params.kd}
    own = {name: coupling.of_independent(gain) for name, gain in gains.items() if gain is not None}
    return params._replace(**own)


def _known_friction(options: RunnerOptions, pack: EnginePack) -> KnownFriction | None:
    """Return the friction to compensate, from the description and the robot's own actuators, or
    None.
    """
    joints = pack.spec.joints
    modelled = DISSIPATION[pack.spec.dissipation].modelled
    friction = (
        np.array([joint.friction * modelled for joint in joints])
        + known_joints(options.robot).coulomb
    )
    if not (
        friction.any() and "friction" in options.compensate.split("+") and options.sets_positions
    ):
        return None
    return KnownFriction(friction, np.array([BAND[joint.unit] for joint in joints]), _turns(pack))


def _turns(pack: EnginePack) -> Array:
    """Return 1 / (2 pi) for continuous joints and 0 for others (dof,); None without continuous
    joints.
    """
    turns = np.array([joint.continuous / TURN for joint in pack.spec.joints])
    return turns if turns.any() else None


def needs_qvel(layout: Layout, constants: Constants, speed_limit: Array) -> bool:
    """Return whether the joint velocities are needed at each sim step."""
    law = layout.law
    takes = law is not None and (law.measures_rate or law.uses_mass_matrix)
    rubs = any(leaf is not None for leaf in constants.friction)
    return (
        takes
        or rubs
        or constants.motors is not None
        or layout.control == "custom"
        or speed_limit is not None
    )


def reset_friction(
    layout: Layout, constants: Constants, state: StepState, pack: EnginePack, mask: Bool
) -> StepState:
    """Return ``state`` with the friction model of the envs of ``mask`` (M,) restarted at the
    robots' present state.
    """
    model = constants.friction
    if model.coulomb is None:
        return state._replace(friction=FrictionState(), age=None)
    falls = not pack.spec.fixed_base  # then gravity does not load the joints
    velocity, load = (
        pack.read_qvel(),
        constants.coupling.efforts(pack.passive_force(not falls, True)),
    )
    fresh = refreshed(layout, constants, friction_model.started(velocity, load), pack.read_qpos())
    fresh = friction_model.with_sliding(model, fresh)
    age = np.zeros(pack.size, np.int64)
    if state.age is not None:
        fresh, age = replace_envs(state.friction, fresh, mask), np.where(mask, 0, state.age)
    return state._replace(friction=fresh, age=age)


def with_friction(
    layout: Layout, constants: Constants, state: StepState, pack: EnginePack
) -> StepState:
    """Return ``state`` after a change of the friction of ``pack``; the next sim step updates the
    model's inertia.
    """
    if constants.friction.coulomb is None or state.age is None:
        return reset_friction(layout, constants, state, pack, np.ones(pack.size, bool))
    return state._replace(age=np.full_like(state.age, REFRESH_STEPS))


def with_params(
    layout: Layout,
    constants: Constants,
    state: StepState,
    old: bp.PIDParams,
    new: bp.PIDParams,
    qpos: Float64,
) -> StepState:
    """Return ``state`` for the params ``new`` in place of ``old``, with the integral in the unit of
    the new gains.

    ``constants`` belong to the params that have gains per mass matrix, if one of the two has.
    """
    if layout.control == "custom":
        return state
    law = state.law
    if layout.control == "pid" and old.gain_units != new.gain_units:
        law = convert_integral(law, old, new, mass_matrix(layout, constants, qpos))
    return state._replace(law=law.matched_to(bp.init(new, qpos)), matrix=None)


def reset_guard(constants: Constants, state: StepState, qpos: Float64, mask: Bool) -> StepState:
    """Return ``state`` with the guard of the envs of ``mask`` (M,) at rest at ``qpos``."""
    if constants.guard is None:
        return state
    fresh = guard_model.init(constants.guard, qpos)
    return state._replace(
        guard=fresh if state.guard is None else replace_envs(state.guard, fresh, mask)
    )


def init_motors(
    actuators: bp.Actuators,
    pack: EnginePack,
    qpos: Float64,
    episode: NDArray[np.int64],
    **since: Any,
) -> ActuatorState:
    """Return the state of actuators that start at ``qpos``: :func:`batchpid.motors.init`."""
    envs = np.arange(pack.first_env, pack.first_env + pack.size)
    return bp.motors.init(actuators, qpos, pack.spec.timestep, envs=envs, episode=episode, **since)
