"""Closed loop of robots and their control in pure functions, for NumPy and for jit, scan, vmap and
grad of JAX.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Array, Pytree
from batchpid.arrays.elementwise import namespace, replace_envs
from batchpid.checks import check_keywords
from batchpid.errors import InvalidArgumentError
from batchpid.sim.engine.scene_spec import added_friction, own_friction
from batchpid.sim.loop.env_parts import OwnController
from batchpid.sim.loop.group_control import control_of
from batchpid.sim.loop.tree_plant import DYNAMICS, TreePlant
from batchpid.sim.options.options import OPTIONS, RunnerOptions
from batchpid.sim.robot.robot import Robot
from batchpid.stages import Control, stages_of
from batchpid.stages.stage import States, started, stepped
from batchpid.stages.values import Command, Measured, Model, Outputs, Step, Values
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.tree_quantities import bias, evaluated, mass_matrix


class Plant(Protocol):
    """Robots of a closed loop, a user's own for example: three pure functions."""

    def init(self, qpos: Array, qvel: Array) -> Pytree:
        """Return the state of robots at ``qpos`` and ``qvel`` (envs, dof)."""

    def read(self, state: Any) -> tuple[Array, Array]:
        """Return positions [rad or m] and velocities (envs, dof)."""

    def step(self, state: Any, effort: Array) -> Pytree:
        """Return the state after one time step under ``effort`` (envs, dof) [N m or N], friction
        of the joints included.
        """


class LoopState(NamedTuple):
    """State of a closed loop, a tree of arrays (envs, ...)."""

    plant: Pytree
    stages: States
    episode: Array
    """Number of the episode of each env (envs,), on which the noise of sensors depends."""


class LoopObservation(NamedTuple):
    """Robots after a tick, arrays (envs, dof) as in :class:`batchpid.sim.Observation`."""

    qpos: Array
    qvel: Array
    effort: Array
    saturated: Array
    guarded: Array
    """None without guard."""


@dataclass(frozen=True, repr=False)
class ClosedLoop:
    """A plant under the control of a Runner: :func:`closed_loop`.

    ``start`` (dof,) is the start pose of robots, ``tree`` their model that the law knows.
    """

    plant: Plant
    control: Control
    tree: RigidTree
    start: Array

    def changed(
        self,
        params: bp.PIDParams | None = None,
        actuators: bp.Actuators | None = None,
        plant: Plant | None = None,
    ) -> Self:
        """Return this loop with other params, actuators or plant, whose arrays may be traced.

        Friction and armature belong to the plant: those of other actuators have no effect. State
        comes from :meth:`init` of the changed loop, unless the same options and delays are on.
        """
        control = self.control
        if params is not None:
            control = control._replace(params=params)
        if actuators is not None:
            control = control._replace(actuators=actuators)
        return replace(self, control=control, plant=plant or self.plant)

    def init(
        self,
        qpos: Array = None,
        qvel: Array = None,
        episode: Array = None,
    ) -> LoopState:
        """Return the state of robots that start at ``qpos`` and ``qvel`` (dof,) or (envs, dof); by
        default at rest at the robot's start pose, in NumPy's arrays. For a loop in JAX, give one
        of JAX. ``episode`` (envs,) numbers the episodes of the sensors' noise, by default 0.
        """
        start = self.start if qpos is None else qpos
        rest = np.zeros(1) if qvel is None else qvel
        xp = namespace(start, rest)
        control = self.control
        shape = control.envs, control.coupling.leader.shape[0]
        place, rate = (xp.broadcast_to(xp.asarray(rows, float), shape) for rows in (start, rest))
        plant = self.plant.init(place, rate)
        if episode is None:
            episode = xp.zeros(control.envs, int)
        values = self.values(plant, Command(None), Step(0, 1), episode)
        return LoopState(plant, started(stages_of(control), values), episode)

    def reset(
        self, state: LoopState, qpos: Array = None, qvel: Array = None, mask: Array = None
    ) -> LoopState:
        """Return ``state`` with the envs of ``mask`` (envs,) bool restarted as by :meth:`init`; by
        default all. Raises InvalidArgumentError for another mask.
        """
        xp = namespace(*self.plant.read(state.plant))
        mask = xp.ones(self.control.envs, bool) if mask is None else xp.asarray(mask)
        if mask.dtype != bool or mask.shape != (self.control.envs,):
            problem = f"is {mask.dtype} {mask.shape}, not bool ({self.control.envs},)"
            raise InvalidArgumentError("mask", problem, remedy="give one bool per env")
        start = xp.asarray(self.start if qpos is None else qpos)
        return replace_envs(state, self.init(start, qvel, state.episode + 1), mask)

    def step(
        self,
        state: LoopState,
        setpoint: Array,
        setpoint_rate: Array = None,
        setpoint_acceleration: Array = None,
        feedforward: Array = None,
        substeps: int = 1,
    ) -> tuple[LoopState, LoopObservation]:
        """Advance by a tick of ``substeps`` sim steps; return the state and the observation.

        The command is that of :meth:`batchpid.sim.Runner.step`, (dof,) or (envs, dof). ``substeps``
        cannot be traced.
        """
        qpos, _ = self.plant.read(state.plant)
        xp = namespace(qpos)
        if setpoint_rate is None:
            setpoint_acceleration = None
        elif setpoint_acceleration is None:
            setpoint_acceleration = 0.0

        def rows(part: Array) -> Array:
            if part is None:
                return None
            part = xp.asarray(part, qpos.dtype)
            width = part.shape[-1] if part.ndim else qpos.shape[1]
            return xp.broadcast_to(part, (len(qpos), width))

        rates = setpoint_rate, setpoint_acceleration
        inputs = Command(setpoint, *rates, 0.0 if feedforward is None else feedforward)
        command = Command(*map(rows, inputs))
        stages = stages_of(self.control)
        episode = state.episode

        def sim_step(carry: Any, index: Array) -> tuple[Any, Outputs]:
            plant, states = carry
            step = Step(index, substeps, self.control.left(index, substeps))
            # The law and the robots have the same dynamics, computed once.
            shared = evaluated(self.tree, DYNAMICS, *self.plant.read(plant))
            values = self.values(plant, command, step, episode, shared["bias"])
            states, values = stepped(stages, states, values)
            if isinstance(self.plant, TreePlant):
                plant = self.plant.step(plant, values.outputs.qf, shared)
            else:
                plant = self.plant.step(plant, values.outputs.qf)
            return (plant, states), values.outputs

        carry = state.plant, state.stages
        if xp is np:
            for index in range(substeps):
                carry, outputs = sim_step(carry, index)
        else:
            import jax

            carry, outputs = jax.lax.scan(sim_step, carry, xp.arange(substeps))
            outputs = jax.tree.map(itemgetter(-1), outputs)
        qpos, qvel = self.plant.read(carry[0])
        return LoopState(*carry, episode), LoopObservation(qpos, qvel, **outputs.shown)

    def values(
        self,
        plant: Pytree,
        command: Command,
        step: Step,
        episode: Array,
        load: Array = None,
    ) -> Values:
        """Return the values of a sim step before its stages; ``load`` is the bias at the state, if it
        is known.
        """
        control, tree = self.control, self.tree
        qpos, qvel = self.plant.read(plant)
        xp = namespace(qpos)

        def passive(qpos: Array, qvel: Array) -> Array:
            if not control.gravity:
                return 0.0 * qpos
            return bias(tree, qpos, qvel if control.coriolis else 0.0 * qvel)

        # The joints show the masses of the plant.
        bodies = getattr(self.plant, "bodies", None)

        def joint_matrix(qpos: Array) -> Array:
            matrix = mass_matrix(tree, qpos, bodies)
            motors = control.actuators
            if motors is None or motors.armature is None:
                return matrix
            eye = xp.eye(matrix.shape[-1], dtype=matrix.dtype)
            return matrix + motors.armature[..., None] * eye

        model = Model(
            mass_matrix=lambda qpos: mass_matrix(tree, qpos),
            joint_mass_matrix=joint_matrix,
            passive_force=passive,
            load=lambda: bias(tree, qpos, qvel),
            envs=np.arange(control.envs),
            episode=episode,
        )
        if xp is not np:
            model = model._replace(when=_when)
        if load is None or not (control.gravity and control.coriolis):
            load = passive(qpos, qvel)
        measured = Measured(qpos, qvel, load)
        return Values(
            command,
            measured,
            measured,
            control.timestep,
            step,
            model,
        )


def _when(due: Any, function: Callable[[], Any], otherwise: Any) -> Any:
    """The conditional :func:`batchpid.stages.values.when` in JAX."""
    from jax import lax

    return lax.cond(due.any() if hasattr(due, "any") else due, function, lambda: otherwise)


def closed_loop(
    robot: Robot,
    num_envs: int,
    *,
    plant: Plant | None = None,
    **options: Any,
) -> ClosedLoop:
    """Return the closed loop of ``num_envs`` robots as pure functions, ``init``, ``step`` and
    ``reset``, for programs of JAX and for NumPy.

    The control is that of a Runner with these ``options``, stage by stage; those of engines and
    workers have no effect. Arrays have JAX's default precision; under ``jax.enable_x64`` motions
    equal a Runner's in MuJoCo without contact.

    Parameters
    ----------
    plant
        The robots: three pure functions (:class:`.Plant`). Default: the robot's rigid tree with
        joint limits, damping, friction and coupling as MuJoCo has them, without contact.

    Raises
    ------
    InvalidArgumentError
        An option is out of range, control is "drive", which an engine has, a randomization is
        given, which is a ``jax.vmap`` of :meth:`ClosedLoop.changed` here, or the base floats.
    """
    check_keywords("closed_loop", options, OPTIONS)
    for argument, is_there in (
        ("control", options.get("control") == "drive"),
        ("randomization", options.get("randomization") is not None),
        ("robot", not robot.fixed_base),
    ):
        if is_there:
            problem = "is for a Runner: a closed loop has no drives, draws and floating bases"
            raise InvalidArgumentError(argument, problem, remedy="use a Runner")
    checked = RunnerOptions(robot, num_envs, **{"engine": "mujoco", "collisions": False, **options})
    scene = checked.scene
    actuators = checked.actuators
    friction = added_friction(own_friction(scene), actuators)
    controller = None if isinstance(checked.control, str) else OwnController(checked)
    control = control_of(
        checked,
        checked.params,
        actuators,
        friction,
        slice(0, num_envs),
        controller,
    )
    tree = robot.kinematic_tree(armature=np.zeros(robot.dof)).held
    if plant is None:
        plant = _tree_plant(checked, tree, control)
    return ClosedLoop(plant, control, tree, robot.start)


def _tree_plant(options: RunnerOptions, tree: RigidTree, control: Control) -> TreePlant:
    joints = options.scene.joints
    inertia = np.zeros((1, tree.dof))
    if control.friction.viscous is not None:
        inertia = inertia + control.timestep * control.friction.viscous
    if control.actuators is not None and control.actuators.armature is not None:
        inertia = inertia + control.actuators.armature
    is_limited = [not joint.continuous for joint in joints]
    ends = np.array([[joint.lower, joint.upper] for joint in joints])
    low, high = np.where(is_limited, ends.T, [[-np.inf], [np.inf]])
    matrix = mass_matrix(tree, np.zeros((1, tree.dof)))[0] + np.diag(inertia[0])
    return TreePlant(
        tree,
        tree.bodies,
        inertia,
        control.coupling,
        low,
        high,
        np.diag(np.linalg.inv(matrix)).copy(),
        control.timestep,
    )
