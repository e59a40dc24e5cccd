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

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
import batchpid.task_space as ts
from batchpid import motors as actuator_model
from batchpid.arrays.array_types import Document, Float64
from batchpid.arrays.elementwise import TURN, namespace
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
from batchpid.sim.loop.pid_law import PIDLaw
from batchpid.sim.loop.step_values import Constants, Layout, Measured, Model, Step, StepState
from batchpid.sim.robot.robot import Robot
from batchpid.task_space import native_rows
from batchpid.task_space.rigid_tree import RigidTree

DIVERGED = 1e4
"""Position beyond which a simulation has diverged [rad or m]."""
MOVING = 0.01
"""Speed from which a joint counts as sliding at the start [rad/s or m/s]."""
PAYLOAD = "payload at the tool"
"""Link at the place of the payload: the center of mass of the tool."""


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
    masses: tuple[tuple[tuple[str, float], ...], ...]
    """Factors of the masses of some links of each candidate, and the mass of its payload [kg] under
    PAYLOAD.
    """

    def repeated(self, times: int) -> PlantCandidates:
        """Return each candidate ``times`` times, one after the other."""
        tables = [{name: np.repeat(rows, times, axis=0) for name, rows in self.law.items()}]
        actuators = mapped(
            lambda leaf: leaf if len(leaf) == 1 else np.repeat(leaf, times, axis=0), self.actuators
        )
        masses = tuple(row for row in self.masses for _ in range(times))
        return PlantCandidates(actuators, tables[0], np.repeat(self.setpoint_delay, times), masses)


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
    feedforward: Float64 | None
    """Efforts that are added to the efforts of the law (past + steps, joints)."""
    step: Any
    """Sim step whose end is at or after each measured row (rows,)."""
    before: Float64
    """Time from the row to that end [s] (rows,)."""

    @property
    def steps(self) -> int:
        """Number of sim steps."""
        return len(self.command) - self.past


class Plant:
    """Logged ``joints`` of ``robot``, with a known ``payload`` at its tool [kg]."""

    def __init__(self, robot: Robot, joints: tuple[int, ...], payload: float = 0.0) -> None:
        coupling, tree = robot.coupling, robot.dynamics(False).tree
        moves = np.isin(coupling.leader, joints)
        number = np.cumsum(moves) - 1
        followers = [
            Follower(
                number[joint],
                number[coupling.leader[joint]],
                coupling.multiplier[joint],
                coupling.offset[joint],
            )
            for joint in np.flatnonzero(moves & ~coupling.independent)
        ]
        self._robot = robot
        self._moves = moves
        self._followers = followers
        self._payload = payload
        self._description = _with_payload(tree, robot.rigid_tree)
        self._trees = dict[Any, RigidTree]()
        self.tree = self.tree_of(())
        """Rigid tree of the logged joints as described, with the payload."""
        columns = number[list(joints)]
        self.columns = None if np.array_equal(columns, np.arange(self.tree.dof)) else columns
        """Joints of the tree that are logged; None for all."""
        free = robot.continuous[list(joints)]
        self.low = np.where(free, -np.inf, robot.lower[list(joints)])[None]
        self.high = np.where(free, np.inf, robot.upper[list(joints)])[None]
        self.turns = free / TURN if free.any() else None

    def tree_of(self, masses: tuple[tuple[str, float], ...]) -> RigidTree:
        """Return the tree with other masses, as in :attr:`PlantCandidates.masses`."""
        if masses not in self._trees:
            tree = self._description
            mass, inertia = np.array(tree.mass), np.array(tree.inertia)
            mass[-1] = self._payload
            for link, value in masses:
                index = tree.index(link)
                mass[index] = value + self._payload if link == PAYLOAD else value * mass[index]
                inertia[index] *= value
            tree = replace(tree, mass=mass, inertia=inertia)
            tree = tree.fixed_at(self._robot.coupling.positions(self._robot.start), self._moves)
            if len(self._trees) > 100:
                self._trees.clear()
            self._trees[masses] = replace(tree, coupling=Coupling.of(tree.dof, self._followers))
        return self._trees[masses]

    @property
    def heavy_links(self) -> list[str]:
        """Moving links with a mass."""
        links = zip(self.tree.links, self.tree.link_bodies, self.tree.mass, strict=True)
        return [link for link, body, mass in links if body >= 0 and mass > 0 and link != PAYLOAD]

    def dynamics(self, masses: Sequence[Any], qpos: Float64, qvel: Float64) -> Dynamics:
        """Return the dynamics of robots at ``qpos`` and ``qvel`` (n, joints), arrays that may
        change.
        """
        return Dynamics(self, masses, qpos, qvel)


class Dynamics:
    """Mass matrices and forces of n robots at the present poses of two arrays."""

    def __init__(self, plant: Plant, masses: Sequence[Any], qpos: Float64, qvel: Float64) -> None:
        self._plant, self.masses, (rows, joints) = plant, masses, qpos.shape
        self.matrix, self.force = np.empty((rows, joints, joints)), np.empty((rows, joints))
        self._parts, first = list[Any](), 0
        for row in range(1, rows + 1):
            if row == rows or masses[row] != masses[first]:
                self._parts.append(
                    self._part(plant.tree_of(masses[first]), qpos, qvel, slice(first, row))
                )
                first = row

    def _part(self, tree: RigidTree, qpos: Float64, qvel: Float64, rows: slice) -> Any:
        """Return a function that updates ``rows`` of the results."""
        q = qpos[rows]
        v = qvel[rows]
        columns = self._plant.columns
        names = ("mass_matrix", "bias")
        if columns is not None:
            q, v = np.zeros((len(q), tree.dof)), np.zeros((len(q), tree.dof))
        native = native_rows.bound(tree, names, q, v, 0)

        def update() -> None:
            if columns is not None:
                q[:, columns], v[:, columns] = qpos[rows], qvel[rows]
                q[...], v[...] = tree.positions(q), tree.rates(v)
            if native is None:
                matrix, force = ts.mass_matrix(tree, q), ts.bias(tree, q, v)
            else:
                native[0]()
                matrix, force = native[1]
            if columns is not None:
                matrix, force = (
                    np.ascontiguousarray(matrix[:, columns[:, None], columns]),
                    force[:, columns],
                )
            if len(self._parts) == 1:
                self.matrix, self.force = matrix, force
            else:
                self.matrix[rows], self.force[rows] = matrix, force

        return update

    def update(self) -> None:
        """Compute the matrices (n, joints, joints) and forces (n, joints) at the present poses."""
        for part in self._parts:
            part()


class Control:
    """Control, motors and friction of n robots; a native program where programs are used, with the
    same bits.
    """

    def __init__(
        self,
        drive: LogControl,
        candidates: PlantCandidates,
        qpos: Float64,
        qvel: Float64,
        asked: Any,
        turns: Float64 | None,
    ) -> None:
        """Begin at ``qpos`` and ``qvel`` (n, joints).

        ``asked`` are the efforts asked for so far, the latest first (samples, n, joints), or None.
        """
        dt = drive.timestep
        count = len(qpos)
        actuators = candidates.actuators
        self.friction = added_friction(Friction(), actuators)
        k = law = None
        state = StepState(None)
        if drive.params is not None:
            law = PIDLaw.of(drive.params)
            times = count // len(drive.params.kp)
            params = mapped(
                lambda leaf: np.tile(leaf, (times, 1)) if leaf.ndim == 2 else leaf, drive.params
            )
            params = changed_params(params, candidates.law)
            params = params._replace(
                measurement_rate=None
            )  # the law of the layout decides, not the params
            offset = 0.0 if actuators.position_offset is None else actuators.position_offset
            k, state = bp.discretise(params, dt, count), StepState(bp.init(params, qpos + offset))
        guard = None
        if "slew" in candidates.law:
            guard = Guard(rate=candidates.law["slew"], turns=turns)
            state = state._replace(guard=guard_model.init(guard, qpos))
        motors = None
        ideal = dict.fromkeys(actuator_model.JOINT_SIDE)
        if not actuators._replace(**ideal).is_ideal:
            history = actuator_model.init(
                actuators, qpos, dt, qvel=qvel, effort=None if asked is None else asked[0]
            )
            if history.command is not None and asked is not None:
                samples = np.minimum(np.arange(history.command.shape[1]), len(asked) - 1)
                history = history._replace(command=asked[samples].swapaxes(0, 1))
            motors, state = (
                actuator_model.discretise(actuators, history, dt, count),
                state._replace(motors=history),
            )
        if self.friction.coulomb is not None:
            started = friction_model.started(qvel, np.zeros_like(qpos))
            sliding = (np.abs(qvel) > MOVING).astype(float)
            state = state._replace(
                friction=started._replace(sliding=sliding), age=np.ones_like(qpos)
            )
        self._layout = Layout("effort" if law is None else "pid", law, actuators.measures, _MODEL)
        self._constants = Constants(
            dt,
            (None, None),
            Coupling.of(qpos.shape[1]),
            k,
            friction=self.friction,
            guard=guard,
            motors=motors,
        )
        self.state = mapped(lambda leaf: np.array(leaf, order="C"), state)
        self._program: Any = None

    def refresh(self, matrix: Float64) -> None:
        """Update the inertia of the friction model."""
        if self.friction.coulomb is not None:
            fresh = friction_model.refresh(
                self.friction, self.state.friction, matrix, self._constants.timestep
            )
            for name in ("gain", "memory"):
                getattr(self.state.friction, name)[...] = getattr(fresh, name)

    def advance(
        self, command: Float64, qpos: Float64, qvel: Float64, passive: Float64 | None
    ) -> Float64:
        """Return the efforts of motors and friction (n, joints), which the next call may reuse.

        ``command`` are setpoints or efforts, ``passive`` the compensated force and the feedforward.
        """
        inputs = command, qpos, qvel, passive
        if self._program is None:
            self._program = self._compiled(inputs) or ()
        if not self._program:
            self.state, effort = _step(self._layout, self._constants, self.state, inputs)
            return effort
        run, state, results, effort = self._program
        run(*state, *[table for table in inputs if table is not None], out=results)
        return effort

    def _compiled(self, inputs: Any) -> Any:
        """Return the program, the arrays of its state, of its results, and of the efforts; None for
        NumPy.
        """
        if obstacle():
            return None
        constants = mapped(lambda leaf: tuple(leaf) if leaf.ndim == 3 else leaf, self._constants)
        trace = _trace(self._layout, *map(structure, (constants, self.state, inputs)))
        effort, state = np.zeros_like(inputs[1]), leaves(self.state)
        program = ArrayProgram(
            trace, leaves(constants), len(state) + len(leaves(inputs)), effort.shape
        )
        return program, state, (*leaves(_returned(self.state)), effort), effort


def simulate(
    plant: Plant,
    drive: LogControl,
    candidates: PlantCandidates,
    states: Float64,
    stretches: Sequence[Stretch],
) -> list[Float64]:
    """Return the positions (candidates, rows, joints) of all candidates at the rows of each
    stretch.

    ``states`` (candidates, 2, joints) are added to positions and velocities at the starts. A
    simulation that diverges ends at inf.
    """
    many = len(stretches)
    count = len(states)
    dt = drive.timestep
    rows, offset = candidates.repeated(many), candidates.actuators.position_offset
    starts = np.array([[stretch.qpos, stretch.qvel] for stretch in stretches])
    q, v = (np.concatenate(starts[:, side] + states[:, None, side]) for side in (0, 1))
    if rows.actuators.position_offset is not None:
        q -= rows.actuators.position_offset
    # State of the robots: dynamics, compensation, the efforts before the first row, control.
    dynamics = plant.dynamics(rows.masses, q, v)
    dynamics.update()
    compensation = _Compensation(plant, drive, dynamics, q, v, rows.actuators.position_offset)
    efforts = None
    past = min(stretch.past for stretch in stretches)
    if drive.params is None and past:
        held = compensation.now() if drive.through else None
        earlier = np.stack(
            [stretch.command[stretch.past - 1 :: -1][:past] for stretch in stretches], axis=1
        )
        efforts = np.tile(earlier, (1, count, 1)) + (0.0 if held is None else held)
    control = Control(drive, rows, q, v, efforts, plant.turns)
    if control.friction.coulomb is not None:
        control.state.friction.effort[...] = dynamics.force
    # Inputs of each step.
    commands = _Commands(drive, rows, stretches)
    forwards = None
    if any(stretch.feedforward is not None for stretch in stretches):
        tables = [
            np.zeros_like(s.command) if s.feedforward is None else s.feedforward for s in stretches
        ]
        forwards = _padded([table[s.past :] for table, s in zip(tables, stretches, strict=True)])
    # Inertias that are added to the mass matrix; damping is implicit.
    armature = 0.0 if rows.actuators.armature is None else rows.actuators.armature
    viscous = 0.0 if control.friction.viscous is None else control.friction.viscous
    armature = np.zeros_like(q) + armature
    added = armature + dt * viscous
    native, steps = native_rows.in_use(), max(stretch.steps for stretch in stretches)
    eye, shape = np.eye(q.shape[1]), (count, many, q.shape[1])
    places, speeds = q.reshape(shape), v.reshape(shape)
    out = [np.empty((count, len(stretch.step), q.shape[1])) for stretch in stretches]
    # Rows of the logs that follow each step.
    events = defaultdict[int, list[tuple[int, int]]](list)
    for number, stretch in enumerate(stretches):
        for row, step in enumerate(stretch.step):
            events[int(step)].append((number, row))
    diverged = np.zeros(len(q), bool)
    with np.errstate(all="ignore"):
        for step in range(steps):
            if step:
                dynamics.update()
            if step % REFRESH_STEPS == 0:
                bad = ~(np.abs(q) < DIVERGED).all(1)
                diverged |= bad
                q[bad] = v[bad] = 0.0
                control.refresh(dynamics.matrix + armature[:, :, None] * eye)
            passive, force = compensation.now(), dynamics.force
            if passive is not None and not drive.through:
                force, passive = force - passive, None
            if forwards is not None:
                forward = np.tile(forwards[step], (count, 1))
                passive = forward if passive is None else passive + forward
            effort = control.advance(commands.at(step), q, v, passive)
            if native is not None:
                native.move(
                    *q.shape,
                    dt,
                    q,
                    v,
                    dynamics.matrix,
                    effort - force,
                    added,
                    plant.low,
                    plant.high,
                )
            else:
                inertia = dynamics.matrix + added[:, :, None] * eye
                v += dt * np.linalg.solve(inertia, (effort - force)[..., None])[..., 0]
                q += dt * v
                v[...] = np.where((q < plant.low) | (q > plant.high), 0.0, v)
                np.clip(q, plant.low, plant.high, out=q)
            for number, row in events.get(step, ()):
                late = stretches[number].before[row]
                out[number][:, row] = places[:, number] - late * speeds[:, number]
    # Joints that diverged end at inf; the others are measured with their offset.
    diverged |= ~(np.abs(q) < DIVERGED).all(1)
    for number, table in enumerate(out):
        table += 0.0 if offset is None else offset[:, None]
        table[diverged.reshape(count, many)[:, number]] = np.inf
    return out


class _Compensation:
    """Forces that the robot compensates by its description, at the present measured poses."""

    def __init__(
        self,
        plant: Plant,
        drive: LogControl,
        dynamics: Dynamics,
        qpos: Float64,
        qvel: Float64,
        offset: Float64 | None,
    ) -> None:
        self._dynamics: Dynamics | None = None
        self._qpos = qpos
        self._measured = qpos
        self._offset = offset
        self._updates = (
            offset is not None or drive.compensate != "gravity+coriolis" or any(dynamics.masses)
        )
        if drive.compensate == "none":
            return
        if offset is not None:
            self._measured = qpos + offset
        speed = np.zeros_like(qvel) if drive.compensate == "gravity" else qvel
        self._dynamics = (
            plant.dynamics([()] * len(qpos), self._measured, speed) if self._updates else dynamics
        )

    def now(self) -> Float64 | None:
        """Return the forces (n, joints); None without compensation."""
        if self._dynamics is None:
            return None
        if self._offset is not None:
            self._measured[...] = self._qpos + self._offset
        if self._updates:
            self._dynamics.update()
        return self._dynamics.force


_BLOCK = 64
_MODEL = Model(when=lambda due, function, otherwise: otherwise)
"""The simulation refreshes the friction model by itself."""


def _step(
    layout: Layout, constants: Constants, state: StepState, inputs: tuple[Any, ...]
) -> tuple[StepState, Any]:
    """Return state and efforts of a control step."""
    command, qpos, qvel, passive = inputs
    step = Step(0, 1)
    if passive is None:
        passive = namespace(qpos).zeros_like(qpos)
    measured = Measured(qpos, qvel, passive)
    new, outputs = control_step(layout, constants, state, command, measured, step)
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
    motors = None if state.motors is None else state.motors._replace(command=None, sensor=None)
    return state._replace(motors=motors)


def changed_params(params: bp.PIDParams, law: Mapping[str, Float64]) -> bp.PIDParams:
    """Return the params of n candidates."""
    gain = law.get("gain", 1.0)
    factors = {"kp": gain, "ki": gain, "kd": gain * law.get("kd", 1.0)}
    gains = {name: getattr(params, name) for name in factors}
    changed = {name: table * factors[name] for name, table in gains.items() if table is not None}
    params = params._replace(**changed)
    if "saturation" in law:
        most = params.kp * law["saturation"]
        params = params._replace(effort_min=-most, effort_max=most)
    return params


def _padded(tables: Sequence[Float64]) -> Float64:
    """Return tables (steps, joints) as one (most steps, tables, joints), each with its last row
    repeated.
    """
    most = max(map(len, tables))
    return np.stack(
        [table[np.minimum(np.arange(most), len(table) - 1)] for table in tables], axis=1
    )


class _Commands:
    """Commands of n robots at the sim steps, late by their delay of setpoints, computed in blocks
    of steps.
    """

    def __init__(
        self, drive: LogControl, rows: PlantCandidates, stretches: Sequence[Stretch]
    ) -> None:
        self._table = _padded([stretch.command[stretch.past :] for stretch in stretches])
        times = len(rows.setpoint_delay) // len(stretches)
        self._stretch = np.tile(np.arange(len(stretches)), times)
        late = rows.setpoint_delay / drive.timestep
        self._whole = np.floor(late).astype(int)
        self._share = (late - self._whole)[:, None]

    def at(self, step: int) -> Float64:
        """Return the commands (n, joints) of a step; steps come in order."""
        place = step % _BLOCK
        if place == 0:
            steps = np.arange(step, min(step + _BLOCK, len(self._table)))[:, None] - self._whole
            self._block = self._table[np.maximum(steps, 0), self._stretch]
            if self._share.any():
                older = self._table[np.maximum(steps - 1, 0), self._stretch]
                self._block += self._share * (older - self._block)
        return self._block[place]


def _with_payload(tree: RigidTree, named: RigidTree) -> RigidTree:
    """Return ``tree`` with a link without mass for the payload, at the center of mass of the tool
    of ``named``.
    """
    tool = named.index(named.tool)
    frame = named.bodies.link_frames[tool]
    place = frame[:, :3] @ named.center[tool] + frame[:, 3]
    carrier = tree.link_bodies.index(named.link_bodies[tool])
    frame = tree.bodies.link_frames[carrier]
    more: Document = {
        "position": frame[:, :3].T @ (place - frame[:, 3]),
        "wxyz": [1, 0, 0, 0],
        "axis": [1, 0, 0],
    }
    more |= {"parent": carrier, "mass": 0, "center": np.zeros(3), "inertia": np.zeros((3, 3))}
    tables: Document = {
        name: np.concatenate([getattr(tree, name), np.array([row])]) for name, row in more.items()
    }
    links, types = (*tree.links, PAYLOAD), (*tree.joint_types, "fixed")
    return replace(tree, links=links, joint_types=types, **tables)
