"""Layout, constants and state of the control step of a group of envs, from its options, params and
robots; and the functions of the robots' model that it calls.

Mass matrices, passive force and noise of sensors are natively compiled where the engine's steps
are, for every executor alike, since NumPy's results differ in the last bits.
"""

from __future__ import annotations

from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid import motors as actuator_model
from batchpid.arrays.array_types import Array, Bool, Float64, Pytree
from batchpid.arrays.elementwise import TURN, replace_envs
from batchpid.arrays.trees import mapped
from batchpid.law.coefficients import spread
from batchpid.law.computed_torque import convert_integral
from batchpid.motors import ActuatorState, MotorCoefficients, measurement_noise
from batchpid.motors import friction as friction_model
from batchpid.motors import guard as guard_model
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import FrictionState
from batchpid.sim.engine.native_model import NativeRefresh, mass_matrix_of, passive_force_of
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.control_step import REFRESH_STEPS, mass_matrix, refreshed, uses_mass_matrix
from batchpid.sim.loop.custom import OwnController
from batchpid.sim.loop.step_values import (
    Constants,
    Layout,
    Model,
    ModelledFriction,
    PIDLaw,
    StepState,
)
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.robot.mimics import coupling_of
from batchpid.sim.robot.parts import DISSIPATION
from batchpid.sim.robot.robot_options import BAND, known_joints


class Setup(NamedTuple):
    """Control step of the robots of a pack, from which an executor is made."""

    options: RunnerOptions
    pack: EnginePack
    layout: Layout
    constants: Constants
    controller: OwnController | None


def make_setup(
    options: RunnerOptions,
    pack: EnginePack,
    params: bp.PIDParams,
    actuators: bp.Actuators | None,
    motors: ActuatorState | None,
    controller: OwnController | None,
) -> Setup:
    """Return the control step of the robots of ``pack``.

    ``params`` and ``actuators`` include the draws of the randomization. ``actuators`` and
    ``motors``, their state, are None without an effect on efforts or measurements.
    """
    parts = options.compensate.split("+")
    law = PIDLaw.of(params) if options.control == "pid" else None
    layout = Layout(
        control=options.control if isinstance(options.control, str) else "custom",
        law=law,
        implicit=any(part is not None and part.implicit for part in (law, controller)),
        measures=actuators is not None and actuators.measures,
        gravity="gravity" in parts,
        coriolis="coriolis" in parts,
    )
    constants = _constants(options, pack, params)
    if actuators is not None and motors is not None:
        timestep = pack.spec.timestep
        coefficients = actuator_model.discretise(actuators, motors, timestep, pack.size)
        constants = constants._replace(motors=coefficients)
    model = model_functions(pack, layout, constants, controller)
    return Setup(options, pack, layout._replace(model=model), constants, controller)


def moves_drives(layout: Layout, constants: Constants) -> bool:
    """Return whether the targets of the engine's drives move within a tick."""
    moving = constants.driven, constants.guard, constants.turns
    return layout.moves or any(value is not None for value in moving)


def _constants(options: RunnerOptions, pack: EnginePack, params: bp.PIDParams) -> Constants:
    """Return the constants of the envs of ``pack``, without their motors."""
    scene = pack.spec
    timestep = scene.timestep
    coupling = coupling_of(scene.joints)
    gains = acting_gains(params, coupling)
    guard = None
    if options.guard is not None:
        row = pack.first_env - options.first_env
        guard = options.guard.for_envs(slice(row, row + pack.size))
    constants = Constants(
        timestep=timestep,
        limits=(params.effort_min, params.effort_max),
        friction=pack.friction,
        modelled=_modelled_friction(options, pack),
        guard=guard,
        coupling=coupling,
    )
    if options.control == "pid":
        robot = options.robot
        armature = None
        damping = np.array([joint.damping for joint in scene.joints])
        if robot.actuators is not None:
            motors = known_joints(robot)
            armature = motors.armature
            damping = damping + motors.viscous
        # Other laws leave the damping to the engine, and to the integral.
        has_damping = PIDLaw.of(params).uses_mass_matrix and damping.any()
        return constants._replace(
            k=spread(bp.discretise(gains, timestep), pack.size),
            armature=armature,
            damping=damping if has_damping else None,
        )
    if options.control == "drive":
        # With an integral the targets move; the drive itself has P and D only.
        driven = None
        if params.ki is not None and np.any(params.ki > 0):
            driven = bp.discretise(gains._replace(measurement_rate=None), timestep)
        if gains.kd is None:
            damping = np.zeros_like(gains.kp)
        else:
            damping = gains.kd
        return constants._replace(drive=(damping, gains.kp), driven=driven, turns=_turns(pack))
    return constants


def acting_gains(params: bp.PIDParams, coupling: Coupling) -> bp.PIDParams:
    """Return ``params`` with zero gains for followers, which move with their leaders."""
    gains = {"kp": params.kp, "ki": params.ki, "kd": params.kd}
    leaders = {
        name: coupling.of_independent(gain) for name, gain in gains.items() if gain is not None
    }
    return params._replace(**leaders)


def _modelled_friction(options: RunnerOptions, pack: EnginePack) -> ModelledFriction | None:
    """Return the friction to compensate, from the description and the robot's own actuators, or
    None.
    """
    joints = pack.spec.joints
    share = DISSIPATION[pack.spec.dissipation].modelled
    friction = np.array([joint.friction * share for joint in joints])
    friction = friction + known_joints(options.robot).coulomb
    is_compensated = "friction" in options.compensate.split("+") and options.sets_positions
    if not (is_compensated and friction.any()):
        return None
    band = np.array([BAND[joint.unit] for joint in joints])
    return ModelledFriction(friction, band, _turns(pack))


def _turns(pack: EnginePack) -> Array:
    """Return 1 / (2 pi) for continuous joints and 0 for others (dof,); None without continuous
    joints.
    """
    turns = np.array([joint.continuous / TURN for joint in pack.spec.joints])
    if turns.any():
        return turns
    return None


def empty_state(
    options: RunnerOptions,
    law: Pytree,
    actuators: bp.Actuators | None,
    stiction: bool,
    envs: int,
) -> StepState:
    """Return the control state of ``envs`` envs: the law's state ``law``, and zeros for
    ``actuators`` (unless None), guard, and Coulomb friction if ``stiction``.
    """
    rows = np.zeros((envs, options.robot.dof))
    state = StepState(law)
    if actuators is not None:
        state = state._replace(motors=bp.motors.init(actuators, rows, options.timestep))
    if stiction:
        friction = FrictionState(*[rows] * len(FrictionState._fields))
        state = state._replace(friction=friction, age=np.zeros(envs, np.int64))
    if options.guard is not None:
        state = state._replace(guard=guard_model.init(options.guard, rows))
    return state


def reset_friction(setup: Setup, state: StepState, mask: Bool) -> StepState:
    """Return ``state`` with the friction model of the envs of ``mask`` (M,) restarted at the
    robots' present state.
    """
    _, pack, layout, constants, _ = setup
    model = constants.friction
    if model.coulomb is None:
        return state._replace(friction=FrictionState(), age=None)
    falls = not pack.spec.fixed_base  # then gravity does not load the joints
    load = constants.coupling.efforts(pack.passive_force(not falls, True))
    fresh = friction_model.started(pack.read_qvel(), load)
    fresh = refreshed(layout, constants, fresh, pack.read_qpos())
    fresh = friction_model.with_sliding(model, fresh)
    if state.age is None:
        return state._replace(friction=fresh, age=np.zeros(pack.size, np.int64))
    age = np.where(mask, 0, state.age)
    return state._replace(friction=replace_envs(state.friction, fresh, mask), age=age)


def with_friction(setup: Setup, state: StepState) -> StepState:
    """Return ``state`` after a change of the friction of the robots; the next sim step updates the
    model's inertia.
    """
    if setup.constants.friction.coulomb is None or state.age is None:
        return reset_friction(setup, state, np.ones(setup.pack.size, bool))
    return state._replace(age=np.full_like(state.age, REFRESH_STEPS))


def with_matrix(setup: Setup, state: StepState) -> StepState:
    """Return ``state`` with room for the mass matrix of the law, if it uses one."""
    pack, matrix = setup.pack, None
    if uses_mass_matrix(setup.layout, setup.constants):
        matrix = np.zeros((pack.size, pack.dof, pack.dof))
    return state._replace(matrix=matrix)


def with_params(
    before: Setup,
    setup: Setup,
    state: StepState,
    old: bp.PIDParams,
    new: bp.PIDParams,
) -> StepState:
    """Return ``state`` for the params ``new`` of ``setup``, with the integral in the unit of the
    new gains; ``old`` are the params of the setup ``before``.
    """
    layout = setup.layout
    if layout.control == "custom":
        return state
    law = state.law
    qpos = setup.pack.read_qpos()
    if layout.control == "pid" and old.gain_units != new.gain_units:
        constants = setup.constants
        if uses_mass_matrix(before.layout, before.constants):
            constants = before.constants  # of the params that have gains per mass matrix
        law = convert_integral(law, old, new, mass_matrix(layout, constants, qpos))
    return state._replace(law=law.matched_to(bp.init(new, qpos)))


def reset_guard(
    setup: Setup,
    state: StepState,
    qpos: Float64,
    mask: Bool,
) -> StepState:
    """Return ``state`` with the guard of the envs of ``mask`` (M,) at rest at ``qpos``."""
    guard = setup.constants.guard
    if guard is None:
        return state
    fresh = guard_model.init(guard, qpos)
    if state.guard is not None:
        fresh = replace_envs(state.guard, fresh, mask)
    return state._replace(guard=fresh)


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


# -- functions of the model
# --------------------------------------------------------------------------------------------------


def model_functions(
    pack: EnginePack,
    layout: Layout,
    constants: Constants,
    controller: OwnController | None,
) -> Model:
    """Return the functions for NumPy arrays of the robots of ``pack``."""
    native = pack.steps_natively
    model = Model(
        mass_matrix=mass_matrix_of(pack, native),
        joint_mass_matrix=partial(_joint_mass_matrix, pack),
        controller=controller,
        noise=NoiseBlocks(),
    )
    if layout.gravity:
        force = passive_force_of(pack, native)
        parts = layout.gravity, layout.coriolis
        model = model._replace(
            passive_force=lambda qpos, qvel: force(qpos, qvel, *parts, pack.read_base_motion())
        )
    if native and constants.friction.coulomb is not None:
        inputs = constants.friction, constants.drive, constants.coupling, constants.timestep
        refresh = NativeRefresh(pack.joint_model, pack.size, pack.armature, *inputs, REFRESH_STEPS)
        model = model._replace(refresh=refresh)
    return model


def _joint_mass_matrix(pack: EnginePack, qpos: Float64) -> Float64:
    """Return the effective mass matrix of the joints, armature of the motors included."""
    matrix = pack.joint_mass_matrix(qpos)
    if pack.armature.any():
        return matrix + pack.armature[:, None] * np.eye(pack.dof)
    return matrix


BLOCK = 64
"""Sim steps of a block."""


class NoiseBlocks:
    """:func:`batchpid.motors.measurement_noise` at the step of a state, from blocks of consecutive
    steps.
    """

    def __init__(self) -> None:
        self._key: Any = None
        self._first = 0
        self._block: tuple[Array, Array] = (None, None)

    def __call__(
        self, k: MotorCoefficients, state: ActuatorState, like: Float64
    ) -> tuple[Array, Array]:
        """Return the noise of positions and velocities; None for a sensor without noise."""
        noise: tuple[Array, Array] = mapped(itemgetter(0), self.from_step(k, state, like))
        return noise

    def from_step(
        self, k: MotorCoefficients, state: ActuatorState, like: Float64
    ) -> tuple[Array, Array]:
        """Return the noise of the step of a state and the next ones (steps, M, dof), as far as it
        has been drawn.

        A reset replaces the key. While the key is the same, all envs advance by the same number of
        steps.
        """
        if state.key is None:
            return None, None
        step = int(state.step[0])
        if state.key is not self._key or not 0 <= step - self._first < BLOCK:
            steps = state.step + np.arange(BLOCK, dtype=np.uint32)[:, None]
            self._block = measurement_noise(k, state.key, steps, np.zeros_like(like), np)
            self._key = state.key
            self._first = step
        rest: tuple[Array, Array] = mapped(itemgetter(slice(step - self._first, None)), self._block)
        return rest
