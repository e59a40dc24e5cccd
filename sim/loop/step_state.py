"""State of the control step: at the start, after resets, and after changes of params and actuators."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64
from batchpid.arrays.elementwise import replace_envs
from batchpid.law.computed_torque import convert_integral
from batchpid.motors import ActuatorState
from batchpid.motors import friction as friction_model
from batchpid.motors import guard as guard_model
from batchpid.motors.friction import FrictionState
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.control_step import REFRESH_STEPS, mass_matrix, refreshed
from batchpid.sim.loop.pid_law import PIDLaw
from batchpid.sim.loop.step_values import Constants, Layout, StepState


def reset_friction(layout: Layout, constants: Constants, state: StepState, pack: EnginePack, mask: Bool) -> StepState:
    """Return ``state`` with the friction model of the envs of ``mask`` (M,) restarted at the robots' present state."""
    model = constants.friction
    if model.coulomb is None:
        return state._replace(friction=FrictionState(), age=None)
    falls = not pack.spec.fixed_base  # then gravity does not load the joints
    velocity, load = pack.read_qvel(), constants.coupling.efforts(pack.passive_force(not falls, True))
    fresh = refreshed(layout, constants, friction_model.started(velocity, load), pack.read_qpos())
    age = np.zeros(pack.size, np.int64)
    if state.age is not None:
        fresh, age = replace_envs(state.friction, fresh, mask), np.where(mask, 0, state.age)
    return state._replace(friction=fresh, age=age)


def with_friction(layout: Layout, constants: Constants, state: StepState, pack: EnginePack) -> StepState:
    """Return ``state`` after a change of the friction of ``pack``; the next sim step updates the model's inertia."""
    if constants.friction.coulomb is None or state.age is None:
        return reset_friction(layout, constants, state, pack, np.ones(pack.size, bool))
    return state._replace(age=np.full_like(state.age, REFRESH_STEPS))


def with_params(
    layout: Layout, constants: Constants, state: StepState, old: bp.PIDParams, new: bp.PIDParams, qpos: Float64
) -> StepState:
    """Return ``state`` for the params ``new`` in place of ``old``, with the integral in the unit of the new gains.

    ``constants`` belong to the params that have gains per mass matrix, if one of the two has.
    """
    if layout.control == "custom":
        return state
    law = state.law
    if layout.control == "pid" and PIDLaw.of(old).whole != PIDLaw.of(new).whole:
        law = convert_integral(law, old, new, mass_matrix(layout, constants, qpos))
    return state._replace(law=law.matched_to(bp.init(new, qpos)), matrix=None)


def reset_guard(constants: Constants, state: StepState, qpos: Float64, mask: Bool) -> StepState:
    """Return ``state`` with the guard of the envs of ``mask`` (M,) at rest at ``qpos``."""
    if constants.guard is None:
        return state
    fresh = guard_model.init(constants.guard, qpos)
    return state._replace(guard=fresh if state.guard is None else replace_envs(state.guard, fresh, mask))


def init_motors(
    actuators: bp.Actuators, pack: EnginePack, qpos: Float64, episode: NDArray[np.int64], **since: Any
) -> ActuatorState:
    """Return the state of actuators that start at ``qpos``: :func:`batchpid.motors.init`."""
    envs = np.arange(pack.first_env, pack.first_env + pack.size)
    return bp.motors.init(actuators, qpos, pack.spec.timestep, envs=envs, episode=episode, **since)
