r"""Simulation of many candidates along stretches of logs: the Runner's stages on a rigid tree.

Control, motors and friction are the stages of a sim step (:mod:`batchpid.stages`), as in a Runner.
In place of an engine the rigid tree of the logged joints moves by semi-implicit Euler with steps of
dt, as in SAPIEN and MuJoCo, with mass matrix M, armature A, viscous damping B, gravity and Coriolis
forces h, and the effort u of motors and friction::

    (M + A + dt B) (v+ - v) = dt (u - h),     q+ = q + dt v+

The motion equals the Runner's up to the rounding of its observations. Unlogged joints rest at the
robot's start pose, followers move with their leaders, and joints stop at their limits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
import batchpid.task_space as ts
from batchpid import motors as motor_model
from batchpid.arrays.array_types import Document, Float64
from batchpid.arrays.trees import mapped
from batchpid.motors.actuators import Actuators
from batchpid.motors.coupling import Coupling, Follower
from batchpid.motors.friction import Friction
from batchpid.motors.guard import Guard
from batchpid.native.array_program import obstacle
from batchpid.sim.engine.scene_spec import added_friction
from batchpid.sim.robot.robot import Robot
from batchpid.stages import Control, stages_of
from batchpid.stages.friction import REFRESH_STEPS, Inertia
from batchpid.stages.stage import StageProgram, by_name, running, started, stepped
from batchpid.stages.values import Command, Measured, Model, Values
from batchpid.task_space import native_rows
from batchpid.task_space.rigid_tree import RigidTree

DIVERGED = 1e4
"""Position beyond which a simulation has diverged [rad or m]."""
_NONE = Friction()


class MassChange(NamedTuple):
    """Change of the masses of a robot."""

    link: str
    is_payload: bool
    """True for a payload at the link's center of mass [kg], False for a factor of the mass and the
    inertia of the link and those fixed to it.
    """


class LogControl(NamedTuple):
    """Control of the robot in a log."""

    timestep: float
    """Time step of control and simulation [s]."""
    params: bp.PIDParams | None
    """Params of the PID law, of the logged joints; None for a log of efforts."""
    compensate: str
    """Forces that the robot compensates: "gravity+coriolis", "gravity" or "none"."""
    through: bool = True
    """True if the compensation passes through the motors, as in a Runner; False if it is exact."""
    modelled: Document | None = None
    """Friction that the law compensates: those fields of :class:`batchpid.stages.Control`."""


class PlantCandidates(NamedTuple):
    """Motors, laws and robots of n simulations."""

    actuators: Actuators
    """(n, joints), in addition to friction and damping of the description."""
    law: Mapping[str, Float64]
    """Changes (n, joints) of the law: factors "gain" and "kd", "saturation" (effort limit over kp)
    and "slew" (limit of the setpoints' rate).
    """
    setpoint_delay: Float64
    """Delay of the setpoints (n,) [s]."""
    setpoint_lag: Float64
    """Time constant of their first-order lag (n,) [s]."""
    masses: Mapping[MassChange, Float64]
    """Payloads and factors (n,)."""


class Stretch(NamedTuple):
    """Stretch of a log to simulate."""

    qpos: Float64
    """Position at its start (joints,) [rad or m]."""
    qvel: Float64
    command: Float64
    """Setpoints or efforts (past + steps, joints) at the sim steps, from ``past`` steps before the
    start on.
    """
    past: int
    """Number of steps before the start, equal in all stretches of a simulation."""
    step: Any
    """First sim step that ends at or after each row (rows,)."""
    before: Float64
    """Time from the row to that end [s] (rows,)."""


class Plant:
    """Logged ``joints`` of ``robot``; those that are ``free`` (joints,) have no limits."""

    def __init__(self, robot: Robot, joints: tuple[int, ...], free: Any = False) -> None:
        logged = list(joints)
        coupling = robot.coupling
        moves = np.isin(coupling.leader, joints)
        number = np.cumsum(moves) - 1
        followers = []
        for joint in np.flatnonzero(moves & ~coupling.independent):
            leader = number[coupling.leader[joint]]
            ratio = coupling.multiplier[joint]
            followers.append(Follower(number[joint], leader, ratio, coupling.offset[joint]))
        tree = robot.rigid_tree.fixed_at(coupling.positions(robot.start), moves)
        self.tree = replace(tree, coupling=Coupling.of(tree.dof, followers))
        """Rigid tree of the logged joints and their followers."""
        # A slice is not copied, as it is for indices.
        self.columns: Any = number[logged] if followers else slice(None)
        """Joints of the tree that are logged."""
        rubs = robot.friction[logged]
        drags = robot.damping[logged]
        self.friction = Friction(rubs[None] if rubs.any() else None, drags[None])
        """Friction and damping of the description."""
        free = free | robot.continuous[logged]
        self.low = np.where(free, -np.inf, robot.lower[logged])[None]
        self.high = np.where(free, np.inf, robot.upper[logged])[None]

    @property
    def heavy_links(self) -> list[str]:
        """First link of each moving body with a mass."""
        tree = self.tree
        bodies = dict[int, str]()
        for link, body, mass in zip(tree.links, tree.link_bodies, tree.mass, strict=True):
            if body >= 0 and mass > 0:
                bodies.setdefault(body, link)
        return list(bodies.values())


@lru_cache(maxsize=100)
def _heavier(tree: RigidTree, change: MassChange) -> RigidTree:
    """Return a tree with a payload of 1 kg, or links of double mass."""
    link = tree.index(change.link)
    mass = np.array(tree.mass)
    if change.is_payload:
        mass[link] += 1.0
        return replace(tree, mass=mass)
    bodies = np.array(tree.link_bodies)
    factor = np.where(bodies == bodies[link], 2.0, 1.0)
    return replace(tree, mass=factor * mass, inertia=factor[:, None, None] * tree.inertia)


class _Poses:
    """Mass matrices and forces of equal robots."""

    def __init__(self, tree: RigidTree, rows: int) -> None:
        self.tree = tree
        self.qpos = np.zeros((rows, tree.dof))
        self.qvel = np.zeros_like(self.qpos)
        quantities = "mass_matrix", "bias"
        self._native = native_rows.bound(tree, quantities, self.qpos, self.qvel, 0)

    def at(self, qpos: Float64, qvel: Float64, columns: Any) -> tuple[Float64, Float64]:
        """Return mass matrices (rows, dof, dof) and forces (rows, dof) at ``qpos`` and ``qvel``
        (rows, columns); the next call changes them.
        """
        self.qpos[:, columns] = qpos
        self.qvel[:, columns] = qvel
        if self.tree.coupling.shares:
            self.qpos[...] = self.tree.positions(self.qpos)
            self.qvel[...] = self.tree.rates(self.qvel)
        if self._native is None:
            matrix = ts.mass_matrix(self.tree, self.qpos)
            return matrix, ts.bias(self.tree, self.qpos, self.qvel)
        self._native[0]()
        matrix, force = self._native[1]
        return matrix, force


class Dynamics:
    """Mass matrices (n, joints, joints) and forces (n, joints) of n robots at the poses of two
    arrays (n, joints).

    Both are linear in masses: with those of the description M, and M_i with an i-th change of one
    unit, they are M + sum of m_i (M_i - M).
    """

    def __init__(
        self,
        plant: Plant,
        masses: Mapping[MassChange, Float64],
        qpos: Float64,
        qvel: Float64,
    ) -> None:
        rows = len(qpos)
        self._state = qpos, qvel
        self._columns = plant.columns
        self._described = _Poses(plant.tree, rows)
        self._changed = list[tuple[Any, Float64, _Poses]]()
        for change, value in masses.items():
            amount = value - (not change.is_payload)
            moved = np.flatnonzero(amount)
            if len(moved):
                poses = _Poses(_heavier(plant.tree, change), len(moved))
                # A slice is not copied, as it is for indices.
                place: Any = slice(None) if len(moved) == rows else moved
                self._changed.append((place, amount[moved], poses))
        self.matrix: Float64 = np.empty((*qpos.shape, qpos.shape[1]))
        self.force = np.empty_like(qpos)
        self.update()

    def update(self) -> None:
        """Compute the matrices and forces at the present poses."""
        columns = self._columns
        qpos, qvel = self._state
        described = self._described.at(qpos, qvel, columns)
        matrix, force = described
        if self._changed:
            matrix, force = matrix.copy(), force.copy()
        for rows, amount, poses in self._changed:
            heavier = poses.at(qpos[rows], qvel[rows], columns)
            matrix[rows] += amount[:, None, None] * (heavier[0] - described[0][rows])
            force[rows] += amount[:, None] * (heavier[1] - described[1][rows])
        self.matrix[...] = matrix[:, columns][:, :, columns]
        self.force[...] = force[:, columns]


class SimulatedControl:
    """Control, motors and friction of n robots; a native program where programs are used, with the
    same bits.
    """

    def __init__(
        self,
        drive: LogControl,
        candidates: PlantCandidates,
        dynamics: Dynamics,
        qpos: Float64,
        qvel: Float64,
        efforts: Float64 | None = None,
        described: Friction = _NONE,
    ) -> None:
        """Begin at ``qpos`` and ``qvel`` (n, joints), which the caller changes in place, after the
        commanded ``efforts`` (samples, n, joints), the latest first; the motors' friction adds to
        that ``described``.
        """
        actuators = candidates.actuators
        self.friction = added_friction(described, actuators)
        self.armature = np.zeros_like(qpos)
        if actuators.armature is not None:
            self.armature += actuators.armature
        guard = Guard(rate=candidates.law["slew"]) if "slew" in candidates.law else None
        law = drive.params
        control = Control(
            timestep=drive.timestep,
            envs=len(qpos),
            coupling=Coupling.of(qpos.shape[1]),
            params=bp.PIDParams(kp=None) if law is None else changed_params(law, candidates.law),
            mode="effort" if law is None else "pid",
            actuators=actuators._replace(**dict.fromkeys(motor_model.JOINT_SIDE)),
            guard=guard,
            friction=self.friction,
        )
        control = control._replace(**(drive.modelled or {}))
        # The program is bound to these arrays.
        self.command = np.zeros_like(qpos)
        """Setpoints or efforts of the next step."""
        self.passive = np.zeros_like(qpos)
        """Compensated force of the next step."""
        model = Model(
            joint_mass_matrix=lambda _: (
                dynamics.matrix + self.armature[:, :, None] * np.eye(qpos.shape[1])
            ),
            load=lambda: dynamics.force,
        )
        reading = Measured(qpos, qvel, self.passive)
        command = Command(self.command, feedforward=0.0)
        self._values = Values(command, reading, reading, drive.timestep, model=model)
        stages = stages_of(control)
        start = self._values._replace(measured=reading._replace(passive=None))
        states = by_name(stages, started(stages, start))
        motors = states.get("motors")
        if motors is not None and motors.command is not None and efforts is not None:
            samples = np.minimum(np.arange(motors.command.shape[1]), len(efforts) - 1)
            states["motors"] = motors._replace(command=efforts[samples].swapaxes(0, 1))
        # The simulation refreshes the inertia of the friction model by itself.
        self._inertia = next((stage for stage in stages if isinstance(stage, Inertia)), None)
        if self._inertia is not None:
            gain, memory, _ = states.pop("inertia")
            self._values = self._values._replace(inertia=(np.array(gain), np.array(memory)))
        rest = [stage for stage in stages if stage.name in states]
        self._stages = running(rest)
        remaining = tuple([states[stage.name] for stage in rest])
        self._states = mapped(lambda leaf: np.array(leaf, order="C"), remaining)
        self._program: StageProgram | None = None
        if not obstacle():
            inputs = self._values._replace(model=Model())
            self._program = StageProgram(rest, self._states, inputs, qpos.shape)

    def refresh(self) -> None:
        """Update the inertia of the friction model."""
        if self._inertia is not None:
            fresh = self._inertia.factors(self._values)
            for array, factor in zip(self._values.inertia, fresh, strict=True):
                array[...] = factor

    def advance(self) -> Any:
        """Return the efforts of motors and friction (n, joints), which the next call may reuse, at
        the present command, compensated force, positions and velocities.
        """
        if self._program is None:
            self._states, values = stepped(self._stages, self._states, self._values)
            return values.outputs.qf
        self._program()
        return self._program.values.outputs.qf


def changed_params(params: bp.PIDParams, law: Mapping[str, Float64]) -> bp.PIDParams:
    """Return the params of n candidates."""
    gain = law.get("gain", 1.0)
    factors = {"kp": gain, "ki": gain, "kd": gain * law.get("kd", 1.0)}
    for name, factor in factors.items():
        table = getattr(params, name)
        if table is not None:
            params = params._replace(**{name: table * factor})
    if "saturation" not in law:
        return params
    most = params.kp * law["saturation"]
    return params._replace(effort_min=-most, effort_max=most)


def simulate(
    plant: Plant,
    drive: LogControl,
    robots: PlantCandidates,
    states: Float64,
    stretches: Sequence[Stretch],
) -> list[Float64]:
    """Return the positions (candidates, rows, joints) of all candidates at the rows of each
    stretch.

    ``robots`` and params have each candidate once for each stretch, one after the other. Their
    ``states`` (n, 2, joints) are added to positions and velocities at the starts. Positions are
    inf where a simulation has diverged.
    """
    dt = drive.timestep
    many = len(stretches)
    count = len(states) // many
    past = stretches[0].past
    stretch_of = np.tile(np.arange(many), count)
    starts = np.array([[stretch.qpos, stretch.qvel] for stretch in stretches])
    begin = starts[stretch_of] + states
    offset: Any = robots.actuators.position_offset
    if offset is None:
        offset = 0.0
    q = begin[:, 0] - offset
    v = np.array(begin[:, 1])
    # Shorter stretches hold their last command.
    steps = np.arange(max(len(stretch.command) for stretch in stretches))
    tables = [stretch.command[np.minimum(steps, len(stretch.command) - 1)] for stretch in stretches]
    commands = np.stack(tables, axis=1)
    # State of the robots: dynamics, compensation, control with the efforts before the first step.
    dynamics = Dynamics(plant, robots.masses, q, v)
    measured = np.array(begin[:, 0])
    described = None
    if drive.compensate != "none":
        speed = np.zeros_like(v) if drive.compensate == "gravity" else v
        described = Dynamics(plant, {}, measured, speed)
    efforts = None
    if drive.params is None and past:
        efforts = commands[past - 1 :: -1][:past][:, stretch_of]
        if described is not None and drive.through:
            efforts += described.force
    control = SimulatedControl(drive, robots, dynamics, q, v, efforts, plant.friction)
    # Setpoints of each robot are late by whole steps and a share of a step.
    late = robots.setpoint_delay / dt
    whole = np.floor(late).astype(int)
    share = (late - whole)[:, None]
    # Inertias that are added to the mass matrix: armature, and damping, which is implicit.
    added = control.armature + dt * control.friction.viscous
    # Setpoints follow those of the log with a first-order lag, r += dt / (dt + T) (command - r).
    follow = (dt / (dt + robots.setpoint_lag))[:, None]
    lagged = np.array(commands[past, stretch_of])
    # Positions and velocities are stored at the steps of rows: a long log has many others.
    stored = set(np.concatenate([stretch.step for stretch in stretches]).tolist())
    track = dict[int, Float64]()
    with np.errstate(all="ignore"):
        for step in range(len(commands) - past):
            if step % REFRESH_STEPS == 0:
                control.refresh()
            newest = past + step - whole
            command = commands[np.maximum(newest, 0), stretch_of]
            if share.any():
                command += share * (commands[np.maximum(newest - 1, 0), stretch_of] - command)
            if (follow < 1.0).any():
                lagged += follow * (command - lagged)
                command = lagged
            # What the robot compensates is added to the command, or cancels forces exactly.
            force = dynamics.force
            if described is not None and drive.through:
                control.passive[...] = described.force
            elif described is not None:
                force = force - described.force
            control.command[...] = command
            effort = control.advance() - force
            _move(plant, dt, q, v, dynamics.matrix, effort, added)
            measured[...] = q + offset
            if step in stored:
                track[step] = np.array([measured, v])
            dynamics.update()
            if described is not None:
                described.update()
    positions = []
    for number, stretch in enumerate(stretches):
        # Rows lie before the ends of their steps.
        rows = np.array([track[step][:, number::many] for step in stretch.step.tolist()])
        qpos = rows[:, 0] - stretch.before[:, None, None] * rows[:, 1]
        qpos = np.where(np.abs(qpos) < DIVERGED, qpos, np.inf)
        # Arrays from worker processes are contiguous: the same bits need the same layout here.
        positions.append(np.ascontiguousarray(qpos.swapaxes(0, 1)))
    return positions


def _move(
    plant: Plant,
    dt: float,
    q: Float64,
    v: Float64,
    matrix: Float64,
    effort: Float64,
    added: Float64,
) -> None:
    """Move the robots by one step, in place."""
    native = native_rows.in_use()
    if native is not None:
        native.move(*q.shape, dt, q, v, matrix, effort, added, plant.low, plant.high)
        return
    inertia = matrix + added[:, :, None] * np.eye(q.shape[1])
    v += dt * np.linalg.solve(inertia, effort[..., None])[..., 0]
    q += dt * v
    v[...] = np.where((q < plant.low) | (q > plant.high), 0.0, v)
    np.clip(q, plant.low, plant.high, out=q)
