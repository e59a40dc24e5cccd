"""Simulation of many candidates along stretches of logs: a Runner's stages in closed loop with the
rigid tree of the logged joints (:mod:`batchpid.sim.loop.loop_run`).

A log of efforts is simulated in windows, a log of setpoints as a whole. Unlogged joints rest at the
robot's start pose, followers move with their leaders.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, Float64
from batchpid.arrays.trees import mapped
from batchpid.motors.actuators import JOINT_SIDE, Actuators
from batchpid.motors.coupling import Coupling, Follower
from batchpid.motors.friction import Friction
from batchpid.motors.guard import Guard
from batchpid.sim.engine.scene_spec import added_friction
from batchpid.sim.identification.log import Log
from batchpid.sim.loop.closed_loop import ClosedLoop
from batchpid.sim.loop.loop_run import LoopRun
from batchpid.sim.loop.tree_plant import TreePlant
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_model import link_tree
from batchpid.stages import Control, Stage, Told, Values
from batchpid.task_space.frames import SpatialInertia, spatial_matrix
from batchpid.task_space.tree_quantities import mass_matrix

DIVERGED = 1e4
"""Position beyond which a simulation has diverged [rad or m]."""
TABLE_ROWS = 2**16
"""Robots times sim steps of a table of commands, which stays in the cache."""
WINDOW = 0.3
"""Length of a window of a log of efforts [s]."""
PAST = 0.1
"""Time before a window whose commands may still act in it [s]."""
SETTLE = 0.3
"""Time after the start of a log under the PID law in which the initial state is forgotten [s]: it
is not fitted.
"""
HELD_OUT = 0.25
"""Share of each log, at its end, that is held out."""
MOST_WINDOWS = 500
"""Largest number of windows; if there are more, evenly spaced ones are used."""
MOST_ROWS = 40_000
"""Largest number of rows of all logs; if there are more, evenly spaced ones are used."""
OF_JOINTS = ("powered", "modelled", "band", "turns")
"""Constants (joints,) of a control."""


class Candidates(NamedTuple):
    """Motors, setpoints and robots of n simulations."""

    actuators: Actuators
    """(n, joints), in addition to friction and damping of the description."""
    slew: Any
    """Limits of the setpoints' rate (n, joints), or None."""
    setpoint_delay: Float64
    """Delay of the setpoints (n,) [s]."""
    setpoint_lag: Float64
    """Time constant of their first-order lag (n,) [s]."""
    payload: Mapping[str, Float64]
    """Payloads (n,) at the centers of mass of links [kg]."""
    mass: Mapping[str, Float64]
    """Factors (n,) of mass and inertia of a link and those fixed to it."""


class Stretch(NamedTuple):
    """Stretch of a log to simulate, and the rows that it is compared with."""

    qpos: Float64
    """Position at its start (joints,) [rad or m]."""
    qvel: Float64
    command: Float64
    """Setpoints or efforts (past + steps, joints) at the sim steps, from ``past`` steps before the
    start on.
    """
    past: int
    """Number of steps before the start."""
    step: Any
    """First sim step that ends at or after each row (rows,)."""
    before: Float64
    """Time from the row to that end [s] (rows,)."""
    log: int = 0
    """Number of its log."""
    measured: Any = None
    """Positions (rows, joints)."""
    fitted: Any = None
    """Fitted rows; the others are held out (rows,) bool."""


@dataclass(frozen=True)
class Lag(Stage):
    """r <- r + share (command - r) with the share dt / (dt + T): first-order lag of setpoints."""

    share: Array
    name = "lag"
    after = "setpoint"

    def init(self, values: Values) -> Told:
        """Begin at the first setpoint."""
        return values.command.setpoint, values

    def step(self, state: Array, values: Values) -> Told:
        """Advance by a sim step."""
        state = state + self.share * (values.command.setpoint - state)
        return state, values._replace(command=values.command._replace(setpoint=state))


@dataclass(frozen=True)
class Exact(Stage):
    """qf <- qf + p: the compensation does not pass through the motors."""

    name = "exact"
    after = "friction"

    def step(self, state: tuple[()], values: Values) -> Told:
        """Advance by a sim step."""
        return state, values.told(qf=values.outputs.qf + values.seen.passive)


class LogPlant:
    """Logged ``joints`` of ``robot``; those that are ``free`` (joints,) have no limits.

    A control and candidates have the logged joints; arrays of the tree have the followers, too.
    """

    def __init__(self, robot: Robot, joints: tuple[int, ...], free: Any = False) -> None:
        logged = list(joints)
        coupling = robot.coupling
        moves = np.isin(coupling.leader, joints)
        number = np.cumsum(moves) - 1
        follows = moves & ~coupling.independent
        rows = number, number[coupling.leader], coupling.multiplier, coupling.offset
        followers = [Follower(*row) for row in zip(*(part[follows] for part in rows), strict=True)]
        tree = link_tree(robot).fixed_at(coupling.positions(robot.start), moves)
        self.tree = replace(tree, coupling=Coupling.of(tree.dof, followers))
        """Rigid tree of the logged joints and their followers."""
        self.joints = len(logged)
        self.columns = number[logged]
        """Joints of the tree that are logged."""
        self._leaders = [logged.index(joint) for joint in coupling.leader[moves].tolist()]
        self._friction = robot.friction[logged], robot.damping[logged]
        free = free | robot.continuous[logged]
        self.low = self.spread(np.where(free, -np.inf, robot.lower[logged]))
        self.high = self.spread(np.where(free, np.inf, robot.upper[logged]))
        matrix = mass_matrix(self.tree, np.zeros((1, tree.dof)))[0]
        self._weight = np.diagonal(np.linalg.inv(matrix)).copy()

    def spread(self, table: Any) -> Any:
        """Return a table (..., joints) of logged joints as one of the tree (..., dof), with the
        columns of leaders for followers.
        """
        if np.shape(table)[-1:] != (self.joints,):
            return table
        return np.take(table, self._leaders, axis=-1)

    @property
    def heavy_links(self) -> list[str]:
        """First link of each moving body with a mass."""
        tree = self.tree
        bodies = dict[int, str]()
        for link, body, mass in zip(tree.links, tree.link_bodies, tree.mass, strict=True):
            if body >= 0 and mass > 0:
                bodies.setdefault(body, link)
        return list(bodies.values())

    def loop(self, drive: Control, candidates: Candidates) -> ClosedLoop:
        """Return the closed loop of candidates under the control of a log."""
        # The plant and the stages couple joints.
        tree = self.tree.held
        coupling = self.tree.coupling
        envs = len(candidates.setpoint_lag)
        dt = drive.timestep
        actuators = mapped(self.spread, candidates.actuators)
        # One number of all joints.
        actuators = actuators._replace(max_delay=candidates.actuators.max_delay)
        for name in JOINT_SIDE:
            figures = getattr(actuators, name)
            if figures is not None:
                actuators = actuators._replace(**{name: coupling.of_independent(figures)})
        rubs, drags = (coupling.of_independent(self.spread(part))[None] for part in self._friction)
        described = Friction(rubs if rubs.any() else None, drags)
        further = drive.further
        if candidates.setpoint_lag.any():
            share = np.repeat(dt / (dt + candidates.setpoint_lag[:, None]), tree.dof, axis=1)
            further = (*further, Lag(share))
        control = drive._replace(
            envs=envs,
            coupling=coupling,
            params=mapped(self.spread, drive.params),
            actuators=actuators,
            guard=None if candidates.slew is None else Guard(rate=self.spread(candidates.slew)),
            friction=added_friction(described, actuators),
            further=further,
            **{name: self.spread(getattr(drive, name)) for name in OF_JOINTS},
        )
        inertia = np.zeros((envs, tree.dof)) + dt * control.friction.viscous
        if actuators.armature is not None:
            inertia = inertia + actuators.armature
        limits = self.low, self.high, self._weight, dt
        plant = TreePlant(tree, self._bodies(candidates), inertia, coupling, *limits)
        return ClosedLoop(plant, control, tree, np.zeros(tree.dof))

    def _bodies(self, candidates: Candidates) -> Any:
        """Return the bodies of candidates."""
        tree = self.tree
        added = dict[str, Float64]()
        for name, factor in candidates.mass.items():
            body = tree.link_bodies[tree.index(name)]
            for link in np.flatnonzero(np.array(tree.link_bodies) == body).tolist():
                spatial = SpatialInertia(
                    float(tree.mass[link]), tree.center[link], tree.inertia[link]
                )
                added[tree.links[link]] = (factor - 1)[:, None, None] * spatial_matrix(spatial)
        for name, mass in candidates.payload.items():
            point = SpatialInertia(1.0, tree.center[tree.index(name)], np.zeros((3, 3)))
            change = mass[:, None, None] * spatial_matrix(point)
            added[name] = added.get(name, 0.0) + change
        return tree.varied(added) if added else tree.bodies


class Motion(NamedTuple):
    """Smoothed motion of a log on the grid of the sim steps, from its first row on; arrays (steps,
    joints).
    """

    qpos: Float64
    qvel: Float64
    qacc: Float64
    command: Float64


class LogData(NamedTuple):
    """A log, its smoothed motion, and the plant and control that made it."""

    log: Log
    motion: Motion
    plant: LogPlant
    drive: Control


def simulate(
    plant: LogPlant,
    drive: Control,
    candidates: Candidates,
    states: Float64,
    stretches: Sequence[Stretch],
) -> list[Float64]:
    """Return the positions (candidates, rows, joints) of all candidates at the rows of each
    stretch; all stretches have the same length.

    ``candidates`` has each candidate once for each stretch, one after the other. Their
    ``states`` (n, 2, joints) are added to positions and velocities at the starts. Positions are
    inf where a simulation has diverged.
    """
    many = len(stretches)
    stretch_of = np.tile(np.arange(many), len(states) // many)
    past = stretches[0].past
    starts = np.array([[stretch.qpos, stretch.qvel] for stretch in stretches])
    begin = starts[stretch_of] + states
    offset: Any = candidates.actuators.position_offset
    if offset is None:
        offset = 0.0
    commands = np.stack([stretch.command for stretch in stretches], axis=1)
    # Setpoints of each candidate are late by whole steps and a share of a step.
    late = candidates.setpoint_delay / drive.timestep
    whole = np.floor(late).astype(int)
    share = (late - whole)[:, None]
    total = len(commands) - past
    most = int(np.clip(TABLE_ROWS // len(states), 16, total))
    first = commands[past, stretch_of]
    qpos, qvel, setpoint = map(plant.spread, (begin[:, 0] - offset, begin[:, 1], first))
    run = LoopRun(plant.loop(drive, candidates), qpos, qvel, setpoint, most)
    motors = run.states.get("motors")
    if drive.mode == "effort" and past and motors is not None and motors.command is not None:
        # Efforts that were commanded before the start are on their way, the latest first.
        samples = np.clip(past - 1 - np.arange(motors.command.shape[1]), 0, None)
        efforts = plant.spread(commands[samples][:, stretch_of])
        if not drive.further:
            efforts = efforts + run.measured.passive
        motors.command[...] = efforts.swapaxes(0, 1)
    # Rows of all stretches, one after the other.
    steps = np.concatenate([stretch.step for stretch in stretches])
    before = np.concatenate([stretch.before for stretch in stretches])
    sizes = [len(stretch.step) for stretch in stretches]
    owner = np.repeat(np.arange(many), sizes)
    positions = np.empty((len(steps), len(states) // many, plant.joints))
    for begun in range(0, total, most):
        size = min(most, total - begun)
        newest = past + begun + np.arange(size)[:, None] - whole
        rows = commands[np.maximum(newest, 0), stretch_of]
        if share.any():
            rows += share * (commands[np.maximum(newest - 1, 0), stretch_of] - rows)
        run.setpoints[:size] = plant.spread(rows)
        run.run(size)
        at = np.flatnonzero((steps >= begun) & (steps < begun + size))
        qpos, qvel = (
            table.reshape(most, -1, many, table.shape[2])[steps[at] - begun, :, owner[at]]
            for table in (run.qpos + plant.spread(offset), run.qvel)
        )
        # Rows lie before the ends of their steps.
        positions[at] = (qpos - before[at, None, None] * qvel)[..., plant.columns]
    positions[~(np.abs(positions) < DIVERGED)] = np.inf
    parts = np.split(positions, np.cumsum(sizes)[:-1])
    return [np.ascontiguousarray(part.swapaxes(0, 1)) for part in parts]


def windows_of(data: Sequence[LogData]) -> list[Stretch]:
    """Return the windows of logs, one for each log of setpoints. A window begins where the held-out
    part begins.
    """
    windows = list[Stretch]()
    every = 1 + sum(len(part.log.time) for part in data) // MOST_ROWS
    for number, part in enumerate(data):
        dt = part.drive.timestep
        total = len(part.motion.qpos) - 1
        share = {None: 1 - HELD_OUT, False: 1.0, True: 0.0}[part.log.held_out]
        split = round(share * total)
        length = total
        starts = [0]
        if part.drive.mode == "effort":
            # Windows of the fitted part, then of the held-out part; the filter begins at the edge.
            edge = round(0.05 / dt)
            first = max(split + 1, edge)
            length = min(round(WINDOW / dt), max(total - first, split - edge))
            starts = [*range(edge, split - length + 1, length)]
            starts += range(first, total - length + 1, length)
        for start in starts:
            windows.append(
                _window(
                    number,
                    part,
                    start,
                    start + length,
                    split,
                    every,
                )
            )
    return windows[:: 1 + len(windows) // MOST_WINDOWS]


def _window(
    number: int,
    data: LogData,
    first: int,
    last: int,
    split: int,
    every: int,
) -> Stretch:
    """Return the window between two sim steps of a log's grid, of one row of ``every``; rows are
    held out from the step ``split`` on.
    """
    log, motion, _, drive = data
    dt = drive.timestep
    settle = 0.0
    if drive.mode == "pid":
        settle = min(SETTLE, 0.2 * log.seconds) / dt
    place = (log.time - log.time[0]) / dt
    rows = np.flatnonzero((place > first + settle + 1e-6) & (place <= last + 1e-6))[::every]
    place = place[rows]
    # Rows lie before the ends of their sim steps.
    step = np.maximum(np.ceil(place - 1e-6).astype(int), first + 1)
    before = np.maximum(step - place, 0.0) * dt
    past = round(PAST / dt)
    command = motion.command[np.maximum(np.arange(first - past, last), 0)]
    return Stretch(
        motion.qpos[first],
        motion.qvel[first],
        command,
        past,
        step - first - 1,
        before,
        number,
        log.qpos[rows],
        place <= split + 1e-6,
    )
