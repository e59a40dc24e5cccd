"""Layout and constants of the control step of a group of envs, from its options, params, actuators and robots."""

from __future__ import annotations

import numpy as np

import batchpid as bp
from batchpid import motors as actuator_model
from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import TURN
from batchpid.motors import ActuatorState
from batchpid.motors.coupling import Coupling
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.pid_law import PIDLaw
from batchpid.sim.loop.step_values import Constants, KnownFriction, Layout
from batchpid.sim.options import RunnerOptions
from batchpid.sim.robot.actuator_checks import BAND, known_joints
from batchpid.sim.robot.mimics import coupling_of
from batchpid.sim.robot.parts import DISSIPATION


def make_layout(options: RunnerOptions, params: bp.PIDParams, actuators: bp.Actuators | None) -> Layout:
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

    ``params`` and ``actuators`` include the draws of the randomization. ``motors`` is the state of actuators that
    change efforts or measurements; None without such actuators.
    """
    scene, robot, guard = pack.spec, options.robot, None
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
        motors=None
        if actuators is None or motors is None
        else actuator_model.discretise(actuators, motors, scene.timestep, pack.size),
    )
    if options.control == "pid":
        return constants._replace(
            k=bp.discretise(acting, scene.timestep),
            armature=None if known is None else known.armature,
            damping=damping if law.whole and damping.any() else None,
        )
    if options.control == "drive":
        kd = np.zeros_like(acting.kp) if acting.kd is None else acting.kd
        integrates = params.ki is not None and bool(np.any(params.ki > 0))
        driven = acting._replace(measurement_rate=None) if integrates else None
        return constants._replace(drive=(kd, acting.kp), driven=driven, turns=_turns(pack))
    return constants


def acting_gains(params: bp.PIDParams, coupling: Coupling) -> bp.PIDParams:
    """Return ``params`` with zero gains for followers, which move with their leaders."""
    gains = {"kp": params.kp, "ki": params.ki, "kd": params.kd}
    own = {name: coupling.of_independent(gain) for name, gain in gains.items() if gain is not None}
    return params._replace(**own)


def _known_friction(options: RunnerOptions, pack: EnginePack) -> KnownFriction | None:
    """Return the friction to compensate, from the description and the robot's own actuators, or None."""
    joints = pack.spec.joints
    modelled = DISSIPATION[pack.spec.dissipation].modelled
    friction = np.array([joint.friction * modelled for joint in joints]) + known_joints(options.robot).coulomb
    if not (friction.any() and "friction" in options.compensate.split("+") and options.sets_positions):
        return None
    return KnownFriction(friction, np.array([BAND[joint.unit] for joint in joints]), _turns(pack))


def _turns(pack: EnginePack) -> Array:
    """Return 1 / (2 pi) for continuous joints and 0 for others (dof,); None without continuous joints."""
    turns = np.array([joint.continuous / TURN for joint in pack.spec.joints])
    return turns if turns.any() else None


def needs_qvel(layout: Layout, constants: Constants, speed_limit: Array) -> bool:
    """Return whether the joint velocities are needed at each sim step."""
    law = layout.law
    takes = law is not None and (law.measures_rate or law.needs_matrix)
    rubs = any(leaf is not None for leaf in constants.friction)
    return takes or rubs or constants.motors is not None or layout.control == "custom" or speed_limit is not None
