r"""Simulation of many candidates along stretches of logs: the Runner's control step on a rigid
tree.

Control, motors and friction are :func:`batchpid.sim.loop.control_step.control_step` at every sim
step, as in a Runner. In place of an engine the rigid tree of the logged joints moves by
semi-implicit Euler with steps of dt, as in SAPIEN and MuJoCo, with mass matrix M, armature A,
viscous damping B, gravity and Coriolis forces h, and the effort u of motors and friction::

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
from batchpid.arrays.array_types import Float64
from batchpid.arrays.trees import leaves, mapped, structure
from batchpid.motors import friction as friction_model
from batchpid.motors import guard as guard_model
from batchpid.motors.actuators import Actuators
from batchpid.motors.coupling import Coupling, Follower
from batchpid.motors.friction import Friction
from batchpid.motors.guard import Guard
from batchpid.native.array_program import ArrayProgram
from batchpid.native.availability import obstacle
from batchpid.native.tracing import Trace, trace_trees
from batchpid.sim.engine.scene_spec import added_friction
from batchpid.sim.loop.control_step import REFRESH_STEPS, control_step
from batchpid.sim.loop.step_values import (
    Constants,
    Layout,
    Measured,
    Model,
    ModelledFriction,
    PIDLaw,
    Step,
    StepState,
)
from batchpid.sim.robot.robot import Robot
from batchpid.task_space import native_rows
from batchpid.task_space.rigid_tree import RigidTree

DIVERGED = 1e4
"""Position beyond which a simulation has diverged [rad or m]."""
PAYLOAD = ""
"""Name of the payload among masses of links: no link has it."""
Masses = tuple[tuple[str, float], ...]
"""Factors of the masses of some links, and the mass of the payload [kg] under PAYLOAD."""


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
    modelled: ModelledFriction | None = None
    """Friction that the law compensates."""


class PlantCandidates(NamedTuple):
    """Motors, laws and robots of n candidates."""

    actuators: Actuators
    """(n, joints), friction and damping of the description included."""
    law: Mapping[str, Float64]
    """Changes (n, joints) of the law: factors "gain" and "kd", "saturation" (effort limit over kp)
    and "slew" (limit of the setpoints' rate).
    """
    setpoint_delay: Float64
    """Delay of the setpoints (n,) [s]."""
    masses: Sequence[Masses]

    def repeated(self, times: int) -> PlantCandidates:
        """Return each candidate ``times`` times, one after the other."""

        def rows(leaf: Float64) -> Float64:
            return leaf if len(leaf) == 1 else np.repeat(leaf, times, axis=0)

        return PlantCandidates(
            mapped(rows, self.actuators),
            {name: np.repeat(table, times, axis=0) for name, table in self.law.items()},
            np.repeat(self.setpoint_delay, times),
            [masses for masses in self.masses for _ in range(times)],
        )


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
        self._tool = robot.rigid_tree.tool
        self._description = replace(tree, coupling=Coupling.of(tree.dof, followers))
        self._trees = dict[Masses, RigidTree]()
        self.columns = number[logged] if followers else None
        """Joints of the tree that are logged; None for all."""
        free = free | robot.continuous[logged]
        self.low = np.where(free, -np.inf, robot.lower[logged])[None]
        self.high = np.where(free, np.inf, robot.upper[logged])[None]

    def tree_of(self, masses: Masses) -> RigidTree:
        """Return the rigid tree of the logged joints with other masses.

        A factor holds for all links of a body. The payload is at the tool's center of mass.
        """
        if masses in self._trees:
            return self._trees[masses]
        tree = self._description
        bodies = np.array(tree.link_bodies)
        mass = np.array(tree.mass)
        inertia = np.array(tree.inertia)
        for link, value in masses:
            if link == PAYLOAD:
                mass[tree.index(self._tool)] += value
            else:
                members = bodies == bodies[tree.index(link)]
                mass[members] *= value
                inertia[members] *= value
        # An evaluation has some tens of robots; the next one has others.
        if len(self._trees) > 100:
            self._trees.clear()
        self._trees[masses] = replace(tree, mass=mass, inertia=inertia)
        return self._trees[masses]

    @property
    def heavy_links(self) -> list[str]:
        """First link of each moving body with a mass."""
        tree = self._description
        bodies = dict[int, str]()
        for link, body, mass in zip(tree.links, tree.link_bodies, tree.mass, strict=True):
            if body >= 0 and mass > 0:
                bodies.setdefault(body, link)
        return list(bodies.values())


class Dynamics:
    """Mass matrices and forces of n robots at the present poses of two arrays (n, joints)."""

    def __init__(
        self, plant: Plant, masses: Sequence[Masses], qpos: Float64, qvel: Float64
    ) -> None:
        rows, joints = qpos.shape
        self.matrix = np.empty((rows, joints, joints))
        self.force = np.empty((rows, joints))
        self._columns = plant.columns
        self._parts = list[Any]()
        # Robots of equal masses follow one another: one part for each kind.
        starts = [row for row in range(rows) if not row or masses[row] != masses[row - 1]]
        for first, last in zip(starts, [*starts[1:], rows], strict=True):
            tree = plant.tree_of(masses[first])
            q = qpos[first:last]
            v = qvel[first:last]
            if plant.columns is not None:
                q = np.zeros((last - first, tree.dof))
                v = np.zeros_like(q)
            native = native_rows.bound(tree, ("mass_matrix", "bias"), q, v, 0)
            self._parts.append((slice(first, last), tree, q, v, native))
        self._state = qpos, qvel

    def update(self) -> None:
        """Compute the matrices (n, joints, joints) and forces (n, joints) at the present poses."""
        for rows, tree, q, v, native in self._parts:
            if self._columns is not None:
                q[:, self._columns] = self._state[0][rows]
                v[:, self._columns] = self._state[1][rows]
                q[...] = tree.positions(q)
                v[...] = tree.rates(v)
            if native is None:
                matrix, force = ts.mass_matrix(tree, q), ts.bias(tree, q, v)
            else:
                native[0]()
                matrix, force = native[1]
            if self._columns is not None:
                matrix = matrix[:, self._columns[:, None], self._columns]
                force = force[:, self._columns]
            self.matrix[rows] = matrix
            self.force[rows] = force


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
    ) -> None:
        """Begin at ``qpos`` and ``qvel`` (n, joints), after the commanded ``efforts`` (samples, n,
        joints), the latest first.
        """
        dt = drive.timestep
        count = len(qpos)
        actuators = candidates.actuators
        k = law = guard = motors = None
        state = StepState(None)
        if drive.params is not None:
            law = PIDLaw.of(drive.params)
            # The law of the layout decides on rates that are measured, not the params.
            params = changed_params(_repeated(drive.params, count), candidates.law)
            params = params._replace(measurement_rate=None)
            k = bp.discretise(params, dt, count)
            offset = 0.0 if actuators.position_offset is None else actuators.position_offset
            state = StepState(bp.init(params, qpos + offset))
        if "slew" in candidates.law:
            guard = Guard(rate=candidates.law["slew"])
            state = state._replace(guard=guard_model.init(guard, qpos))
        if not actuators._replace(**dict.fromkeys(motor_model.JOINT_SIDE)).is_ideal:
            history = motor_model.init(actuators, qpos, dt, qvel=qvel)
            if history.command is not None and efforts is not None:
                samples = np.minimum(np.arange(history.command.shape[1]), len(efforts) - 1)
                history = history._replace(command=efforts[samples].swapaxes(0, 1))
            motors = motor_model.discretise(actuators, history, dt, count)
            state = state._replace(motors=history)
        self.friction = added_friction(Friction(), actuators)
        self.armature = np.zeros_like(qpos)
        if actuators.armature is not None:
            self.armature += actuators.armature
        if self.friction.coulomb is not None:
            begin = (qvel, dynamics.force, self._inertia(dynamics.matrix), dt)
            state = state._replace(
                friction=friction_model.init(self.friction, *begin), age=np.ones_like(qpos)
            )
        self._layout = Layout("effort" if law is None else "pid", law, actuators.measures, _MODEL)
        self._constants = Constants(
            dt,
            (None, None),
            Coupling.of(qpos.shape[1]),
            k,
            friction=self.friction,
            modelled=None if law is None else drive.modelled,
            guard=guard,
            motors=motors,
        )
        self.state = mapped(lambda leaf: np.array(leaf, order="C"), state)
        self._program: Any = None

    def _inertia(self, matrix: Float64) -> Float64:
        return matrix + self.armature[:, :, None] * np.eye(matrix.shape[1])

    def refresh(self, matrix: Float64) -> None:
        """Update the inertia of the friction model."""
        if self.friction.coulomb is None:
            return
        dt = self._constants.timestep
        state = self.state.friction
        fresh = friction_model.refresh(self.friction, state, self._inertia(matrix), dt)
        # In place: the program is bound to these arrays.
        state.gain[...] = fresh.gain
        state.memory[...] = fresh.memory

    def advance(self, command: Float64, qpos: Float64, qvel: Float64, passive: Float64) -> Any:
        """Return the efforts of motors and friction (n, joints), which the next call may reuse.

        ``command`` are setpoints or efforts, ``passive`` the compensated force.
        """
        inputs = command, qpos, qvel, passive
        if obstacle():
            self.state, effort = _step(self._layout, self._constants, self.state, inputs)
            return effort
        if self._program is None:
            self._program = self._compiled(inputs)
        program, state, results = self._program
        program(*state, *inputs, out=results)
        return results[-1]

    def _compiled(self, inputs: Any) -> Any:
        """Return the program, the arrays of its state, and of its results: state and efforts."""
        constants = mapped(lambda leaf: tuple(leaf) if leaf.ndim == 3 else leaf, self._constants)
        trace = _trace(self._layout, *map(structure, (constants, self.state, inputs)))
        effort = np.zeros_like(inputs[1])
        state = leaves(self.state)
        count = len(state) + len(leaves(inputs))
        program = ArrayProgram(trace, leaves(constants), count, effort.shape)
        return program, state, (*leaves(_returned(self.state)), effort)


_MODEL = Model(when=lambda due, function, otherwise: otherwise)
"""The simulation refreshes the friction model by itself."""


def _step(layout: Layout, constants: Constants, state: StepState, inputs: Any) -> Any:
    """Return state and efforts of a control step."""
    command, *reading = inputs
    measured = Measured(*reading)
    new, outputs = control_step(layout, constants, state, command, measured, Step(0, 1))
    return new, outputs.qf


@lru_cache(maxsize=64)
def _trace(layout: Layout, *structures: Any) -> Trace:
    def function(*parts: Any) -> list[Any]:
        new, effort = _step(layout, *parts)
        return [*leaves(_returned(new)), effort]

    return trace_trees(function, *structures)


def _returned(state: StepState) -> StepState:
    """Return the leaves of a state that a program returns: without histories, which it changes in
    place.
    """
    if state.motors is None:
        return state
    return state._replace(motors=state.motors._replace(command=None, sensor=None))


def _repeated(params: bp.PIDParams, count: int) -> bp.PIDParams:
    """Return ``params`` of some envs for ``count`` envs, one set after the other."""
    times = count // len(params.kp)
    tiled: bp.PIDParams = mapped(
        lambda leaf: np.tile(leaf, (times, 1)) if leaf.ndim == 2 else leaf, params
    )
    return tiled


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
    candidates: PlantCandidates,
    states: Float64,
    stretches: Sequence[Stretch],
) -> list[Float64]:
    """Return the positions (candidates, rows, joints) of all candidates at the rows of each
    stretch.

    ``states`` (candidates, 2, joints) are added to positions and velocities at the starts.
    Positions are inf where a simulation has diverged.
    """
    dt = drive.timestep
    many = len(stretches)
    count = len(states)
    past = stretches[0].past
    robots = candidates.repeated(many)
    offset: Any = robots.actuators.position_offset
    if offset is None:
        offset = 0.0
    starts = np.array([[stretch.qpos, stretch.qvel] for stretch in stretches])
    q = np.concatenate(starts[:, 0] + states[:, None, 0]) - offset
    v = np.concatenate(starts[:, 1] + states[:, None, 1])
    commands = _padded([stretch.command for stretch in stretches])
    # State of the robots: dynamics, compensation, control with the efforts before the first step.
    dynamics = Dynamics(plant, robots.masses, q, v)
    dynamics.update()
    measured = np.array(q + offset)
    described = None
    if drive.compensate != "none":
        speed = np.zeros_like(v) if drive.compensate == "gravity" else v
        described = Dynamics(plant, [()] * len(q), measured, speed)
        described.update()
    efforts = None
    if drive.params is None and past:
        efforts = np.tile(commands[past - 1 :: -1][:past], (1, count, 1))
        if described is not None and drive.through:
            efforts += described.force
    control = SimulatedControl(drive, robots, dynamics, q, v, efforts)
    # Setpoints of each robot are late by whole steps and a share of a step.
    late = robots.setpoint_delay / dt
    whole = np.floor(late).astype(int)
    share = (late - whole)[:, None]
    stretch_of = np.tile(np.arange(many), count)
    # Inertias that are added to the mass matrix: armature, and damping, which is implicit.
    added = np.array(control.armature)
    if control.friction.viscous is not None:
        added += dt * control.friction.viscous
    zero = np.zeros_like(q)
    # Positions and velocities are stored at the steps of rows: a long log has many others.
    stored = np.unique(np.concatenate([stretch.step for stretch in stretches]))
    track = np.empty((len(stored), 2, *q.shape))
    place = 0
    with np.errstate(all="ignore"):
        for step in range(len(commands) - past):
            if step:
                dynamics.update()
            if step % REFRESH_STEPS == 0:
                control.refresh(dynamics.matrix)
            newest = past + step - whole
            command = commands[np.maximum(newest, 0), stretch_of]
            if share.any():
                command += share * (commands[np.maximum(newest - 1, 0), stretch_of] - command)
            # What the robot compensates is added to the command, or cancels forces exactly.
            force = dynamics.force
            passive = zero
            if described is not None:
                measured[...] = q + offset
                described.update()
                if drive.through:
                    passive = described.force
                else:
                    force = force - described.force
            effort = control.advance(command, q, v, passive) - force
            _move(plant, dt, q, v, dynamics.matrix, effort, added)
            if place < len(stored) and step == stored[place]:
                track[place, 0] = q + offset
                track[place, 1] = v
                place += 1
    track = track.reshape(len(track), 2, count, many, q.shape[1])
    positions = []
    for number, stretch in enumerate(stretches):
        rows = np.searchsorted(stored, stretch.step)
        qpos, qvel = track[rows, :, :, number].swapaxes(0, 1)
        qpos = qpos - stretch.before[:, None, None] * qvel
        qpos = np.where(np.abs(qpos) < DIVERGED, qpos, np.inf)
        positions.append(qpos.swapaxes(0, 1))
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


def _padded(tables: Sequence[Float64]) -> Float64:
    """Return tables (steps, joints) as one (most steps, tables, joints), each with its last row
    repeated.
    """
    steps = np.arange(max(map(len, tables)))
    return np.stack([table[np.minimum(steps, len(table) - 1)] for table in tables], axis=1)
