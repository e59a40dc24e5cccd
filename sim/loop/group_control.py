"""Control of a group of envs: its stages, from options, params and robots; and the functions of the
robots' model that they call.

Mass matrices and passive force are native where the engine's steps are, under every executor, since
NumPy's results differ in the last bits.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Array, Float64
from batchpid.arrays.elementwise import TURN
from batchpid.arrays.trees import leaves, mapped
from batchpid.motors.friction import Friction
from batchpid.native.extensions import MOST_SUMMED
from batchpid.sim.description.merging import coupling_of
from batchpid.sim.engine.native_model import NativeRefresh
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.env_parts import OwnController
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.robot.robot_options import FRICTION_BAND, known_joints
from batchpid.sim.tool_space import OperationalSpace
from batchpid.stages import Control, Stage, stages_of
from batchpid.stages.friction import REFRESH_STEPS
from batchpid.stages.stage import bind_stages
from batchpid.stages.values import Command, Measured, Model, Outputs, Step, Values


class GroupControl(NamedTuple):
    """Control of the robots of a pack, which an executor runs."""

    options: RunnerOptions
    pack: EnginePack
    control: Control
    stages: tuple[Any, ...]
    model: Model

    @classmethod
    def of(
        cls,
        options: RunnerOptions,
        pack: EnginePack,
        params: bp.PIDParams,
        actuators: bp.Actuators | None,
        controller: OwnController | None,
    ) -> GroupControl:
        """Return the control of the robots of ``pack``.

        ``params`` and ``actuators`` include the draws of the randomization.
        """
        first = pack.first_env - options.first_env
        envs = slice(first, first + pack.size)
        control = control_of(
            options,
            params,
            actuators,
            pack.friction,
            envs,
            controller,
        )
        return cls(options, pack, control, stages_of(control), model_functions(pack, control))

    def values(self, episode: Array) -> Values:
        """Return the values in which stages start, at the present state of the robots, in their
        ``episode`` (M,).
        """
        pack, control = self.pack, self.control
        passive = None
        if control.gravity:
            passive = pack.passive_force(True, control.coriolis)
        measured = Measured(pack.read_qpos(), pack.read_qvel(), passive)
        model = self.model._replace(episode=episode)
        return Values(Command(None), measured, measured, control.timestep, model=model)

    def write_drives(self) -> None:
        """Set the engine's drives, if the control has some."""
        control = self.control
        if control.mode == "drive":
            damping, stiffness = control.drive
            limit = control.params.effort_max
            if limit is None:
                limit = np.full_like(stiffness, np.inf)
            self.pack.write_drive(stiffness, damping, limit)

    @property
    def moves_drives(self) -> bool:
        """Whether targets of the engine's drives move within a tick whose setpoints rest."""
        control = self.control
        law = self.stage("law")
        moving = control.guard, control.plan, control.turns, getattr(law, "integral", None)
        return any(part is not None for part in moving) or bool(control.further)

    def stage(self, name: str) -> Any:
        """Return a stage by name; None if it does not apply."""
        return next((stage for stage in self.stages if stage.name == name), None)


def control_of(
    options: RunnerOptions,
    params: bp.PIDParams,
    actuators: bp.Actuators | None,
    friction: Friction,
    envs: slice,
    controller: Any,
) -> Control:
    """Return the control of the envs ``envs`` of a runner. ``friction`` is that of the joints."""
    joints = options.scene.joints
    # With SAPIEN's own dissipation, engine and law do not know the description's friction.
    share = float(options.scene.dissipation == "urdf")
    compensated = options.compensate.split("+")
    described = known_joints(options.robot)
    turns = np.array([joint.continuous / TURN for joint in joints])
    modelled = np.array([joint.friction * share for joint in joints]) + described["coulomb"]
    free = np.array([not joint.has_motor for joint in joints])
    modelled[free] = 0.0
    has_modelled = "friction" in compensated and options.sets_positions and modelled.any()
    armature = None
    damping = np.array([joint.damping for joint in joints])
    if options.robot.actuators is not None:
        armature = described["armature"]
        damping = damping + described["viscous"]
    return Control(
        timestep=options.timestep,
        envs=envs.stop - envs.start,
        coupling=coupling_of(joints),
        params=params,
        mode=options.control if isinstance(options.control, str) else "custom",
        controller=controller,
        actuators=actuators,
        guard=None if options.guard is None else options.guard.for_envs(envs),
        plan=None if options.plan is None else options.plan.for_envs(envs),
        friction=friction,
        gravity="gravity" in compensated,
        coriolis="coriolis" in compensated,
        powered=1.0 - free if free.any() else None,
        modelled=modelled if has_modelled else None,
        band=np.array([FRICTION_BAND[joint.unit] for joint in joints]),
        turns=turns if turns.any() else None,
        armature=armature,
        damping=damping if damping.any() else None,
        further=tuple([_for_envs(stage, options.num_envs, envs) for stage in options.stages]),
    )


def _for_envs(stage: Stage, num_envs: int, envs: slice) -> Stage:
    """Return a stage of the caller's with the rows ``envs`` of constants that have one for each of
    ``num_envs`` envs.
    """

    def rows(leaf: Array) -> Array:
        has_rows = leaf.ndim >= 2 and leaf.shape[0] == num_envs
        return leaf[envs] if has_rows else leaf

    part: Stage = mapped(rows, stage)
    return part


@lru_cache(maxsize=8)
def untraceable(options: RunnerOptions) -> str:
    """Return which of the caller's stages cannot run in native code, and why; "" if all can. No
    robots are made.
    """
    rows = np.zeros((options.num_envs, options.robot.dof))
    measured = Measured(rows, rows, rows)
    values = Values(
        command=Command(*[rows] * 4),
        measured=measured,
        seen=measured,
        timestep=options.timestep,
        step=Step(0, 1, np.zeros(())),
        last=Outputs(rows, rows),
        forward=rows,
        limits=(rows, rows),
        outputs=Outputs(*[rows] * 4),
    )
    model = Model(
        joint_mass_matrix=lambda qpos: np.eye(qpos.shape[1]) + 0.0 * qpos[:, :, None],
        load=lambda: rows,
    )
    for stage in options.stages:
        state, _ = stage.init(values._replace(model=model))
        if any(leaf.shape != rows.shape for leaf in leaves(state)):
            return f"the state of stage {stage.name!r} is not (envs, joints)"
        try:
            bind_stages([stage], (state,), values, rows.shape)
        except (AttributeError, AssertionError, TypeError, ValueError) as error:
            return f"stage {stage.name!r}: {error}"
    return ""


def native_obstacle(options: RunnerOptions) -> str:
    """Return why the sim steps of a tick cannot be one native call; "" if they can."""
    if options.backend == "jax":
        return "the control is compiled by JAX"
    control = options.control
    if isinstance(control, OperationalSpace):
        if type(control) is not OperationalSpace:
            return "a subclass of OperationalSpace runs in Python"
    elif not isinstance(control, str):
        return "the controller runs in Python"
    if options.robot.dof > MOST_SUMMED:
        return f"more than {MOST_SUMMED} joints"
    return untraceable(options) if options.stages else ""


def describe(options: RunnerOptions) -> str:
    """Describe the library of the law, and the calls into the engine, with the reason if one of them
    is not native.
    """
    engine = options.load_engine()
    lack = engine.native_obstacle()
    reason = lack or native_obstacle(options)
    law = "in NumPy" if reason else "as a native program"
    if options.backend == "jax":
        law = "in JAX"
    if options.control == "drive":
        law = f"in {engine.title} (control 'drive')"
    calls = "Python" if lack else "native"
    text = f"law {law}, {calls} calls into {engine.title}"
    return f"{text} ({reason})" if reason else text


# -- functions of the model
# --------------------------------------------------------------------------------------------------


def model_functions(pack: EnginePack, control: Control) -> Model:
    """Return the functions for NumPy arrays of the robots of ``pack``."""
    native = pack.steps_natively
    falls = not pack.spec.fixed_base  # then gravity does not load the joints

    def joint_mass_matrix(qpos: Float64) -> Float64:
        matrix: Float64 = pack.joint_model.mass_matrix(qpos)
        if pack.armature.any():
            return matrix + pack.armature[:, None] * np.eye(pack.dof)
        return matrix

    model = Model(
        mass_matrix=lambda qpos: pack.force_model.mass_matrix(qpos),
        joint_mass_matrix=joint_mass_matrix,
        load=lambda: pack.passive_force(not falls, True),
        envs=np.arange(pack.first_env, pack.first_env + pack.size),
    )
    if control.gravity:
        parts = control.gravity, control.coriolis
        model = model._replace(
            passive_force=lambda qpos, qvel: pack.force_model.passive_force(
                qpos, qvel, *parts, pack.read_base_motion()
            )
        )
    if native and control.friction.coulomb is not None:
        inputs = control.friction, control.drive, control.coupling, control.timestep
        refresh = NativeRefresh(pack.joint_model, pack.size, pack.armature, *inputs, REFRESH_STEPS)
        model = model._replace(refresh=refresh)
    return model
