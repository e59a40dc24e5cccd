r"""Table of each physics preset's errors: ``python bench/accuracy.py [--json FILE]`` (two minutes).

The errors are of the engine at the runner's timestep, against references that step 20 times as often. They do not
depend on the machine's speed. measure.py measures the speed of the presets.

Engine and reference are under the same controller at the runner's rate: between two of its efforts the reference makes
20 steps. So the error is the engine's, as it remains under feedback.

In free motion the reference is the equation of motion, in double precision, by a Runge-Kutta method::

    M(q) q'' + C(q, q') q' + B q' + g(q) = u

In contact it is the engine with a twentieth of the timestep. Its two solvers resolve friction differently where links
slide, however fine the steps; so there are two references, and an error against each.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray
from workload import TIMESTEP

import batchpid as bp
from batchpid.checks.validate import choice, integer, number
from batchpid.io.files import write_atomically
from batchpid.motors.friction import Friction
from batchpid.sim.cli.report import table
from batchpid.sim.engine.physics import PHYSICS, Physics
from batchpid.sim.engine.sapien.pack import Pack
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.control_step import STAGES, control_step
from batchpid.sim.loop.pid_law import PIDLaw
from batchpid.sim.loop.step_setup import acting_gains, reset_friction
from batchpid.sim.loop.step_values import Constants, Layout, Measured, Model, Outputs, Step, StepState, Values
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_model import RobotModel
from batchpid.sim.tuning.moves import Moves, draw_moves, random_moves

Float64 = NDArray[np.float64]

REFINEMENT = 20
"""Steps of the reference in one of the engine's."""
REFERENCES: dict[str, dict[str, Physics | None]] = {
    # motion: {name of a reference: its solver, or None for the equation of motion}
    "free": {"equation of motion": None},
    "contact": {"PGS, finer": Physics("PGS", 50), "TGS, finer": Physics("TGS", 10)},
    "limit": {"PGS, finer": Physics("PGS", 50)},
}
"""References of each kind of motion."""
APPROACH, PRESS = 0.2, 0.02
"""Distance before the first touch at which a move into contact begins, and behind it at which it ends [rad or m]."""
BEYOND = 0.1
"""Distance beyond its limit to which a joint is sent [rad]."""
_LINE = 60


class EquationOfMotion:
    """Robots without contact and joint limits, by steps of the Runge-Kutta method of order 4; arrays are (M, dof).

    It has the methods of a :class:`batchpid.sim.engine.sapien.pack.Pack` that a control step takes.
    """

    def __init__(self, dynamics: RobotModel, damping: Float64, qpos: Float64, timestep: float) -> None:
        self._dynamics, self._damping, self._h = dynamics, damping, timestep
        self._qpos, self._qvel = qpos.copy(), np.zeros_like(qpos)
        self._effort = np.zeros_like(qpos)

    def read_qpos(self) -> Float64:
        """Return the joint positions [rad or m]."""
        return self._qpos

    def read_qvel(self) -> Float64:
        """Return the joint velocities [rad/s or m/s]."""
        return self._qvel

    def passive_force(self, gravity: bool, coriolis: bool) -> Float64:
        """Return the joint efforts that cancel gravity and Coriolis and centrifugal forces [N m or N]."""
        still, inverse_dynamics = np.zeros_like(self._qpos), self._dynamics.inverse_dynamics
        bias = inverse_dynamics(self._qpos, self._qvel if coriolis else still, still)
        return bias if gravity else bias - inverse_dynamics(self._qpos, still, still)

    def write_qf(self, effort: Float64) -> None:
        """Apply joint efforts [N m or N] from now on."""
        self._effort = effort

    def step(self) -> None:
        """Make one step."""
        q, v, h = self._qpos, self._qvel, self._h
        a1 = self._acceleration(q, v)
        a2 = self._acceleration(q + h / 2 * v, v + h / 2 * a1)
        a3 = self._acceleration(q + h / 2 * v + h**2 / 4 * a1, v + h / 2 * a2)
        a4 = self._acceleration(q + h * v + h**2 / 2 * a2, v + h * a3)
        self._qpos = q + h * v + h**2 / 6 * (a1 + a2 + a3)
        self._qvel = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    def _acceleration(self, qpos: Float64, qvel: Float64) -> Float64:
        return self._dynamics.forward_dynamics(qpos, qvel, self._effort - self._damping * qvel)


class Accuracy(NamedTuple):
    """Errors of one solver on one kind of motion, over revolute joints, envs and sim steps."""

    largest: float
    """[rad]"""
    rms: float
    """[rad]"""


def measure_errors(
    robot: Robot, motion: str, physics: dict[str, Physics] = PHYSICS, count: int = 8, seconds: float = 1.0
) -> dict[tuple[str, str], Accuracy]:
    """Return the errors of each solver of ``physics`` under the robot's tuned gains, by (solver, reference).

    ``motion`` is "free": to random poses, touching nothing; "contact": until a link presses on the ground or on
    another; or "limit": a joint against its limit. ``count`` moves are run at once. Raises InvalidArgumentError where
    an argument is out of range, or the robot has no tuned gains or no room for such moves.
    """
    references = REFERENCES[choice("motion", motion, REFERENCES)]
    steps = round(number("seconds", seconds, TIMESTEP, 1e3, "seconds") / TIMESTEP)
    moves = _MOVES[motion](robot, integer("count", count, 1, 10_000))
    revolute = np.array([joint.type != "prismatic" for joint in robot.joints])
    turn = 2 * np.pi * robot.continuous[revolute]
    runs = {name: _simulate(robot, moves, steps, solver) for name, solver in physics.items()}
    result = {}
    for other, solver in references.items():
        reference = _simulate(robot, moves, steps, solver, REFINEMENT)
        for name, run in runs.items():
            error = (run - reference)[..., revolute]
            error -= turn * np.round(error / (2 * np.pi))
            result[name, other] = Accuracy(float(np.abs(error).max()), float(np.sqrt((error**2).mean())))
    return result


def _simulate(robot: Robot, moves: Moves, steps: int, solver: Physics | None, refinement: int = 1) -> Float64:
    """Return the positions (steps, moves, dof) after each period of the controller, from rest at the moves' starts.

    ``solver`` None is the equation of motion. ``refinement`` sim steps are made in each period.
    """
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, TIMESTEP, solver or PHYSICS["accurate"])
    finer = replace(spec, timestep=TIMESTEP / refinement)
    plant: Pack | EquationOfMotion
    if solver is None:
        plant = EquationOfMotion(robot.dynamics(), robot.damping, moves.start, finer.timestep)
    else:
        plant = Pack(finer, len(moves.start))
        plant.write_state(range(plant.size), moves.start, np.zeros_like(moves.start))
    params = robot.tuned()
    law, damping = PIDLaw.of(params), robot.damping if robot.damping.any() else None
    model = Model(robot.dynamics().mass_matrix, plant.joint_mass_matrix if isinstance(plant, Pack) else None)
    layout = Layout("pid", law, model=model)
    k = bp.discretise(acting_gains(params, robot.coupling), TIMESTEP, len(moves.start))
    limits = params.effort_min, params.effort_max
    control = Constants(TIMESTEP, limits, robot.coupling, k, damping=damping if law.whole else None)
    joints = Constants(
        finer.timestep, limits, robot.coupling, friction=plant.friction if isinstance(plant, Pack) else Friction()
    )
    state, command = StepState(bp.init(params, moves.start)), Command(moves.target)
    if isinstance(plant, Pack):
        state = reset_friction(layout, joints, state, plant, np.ones(plant.size, bool))
    table = np.empty((steps, *moves.start.shape))
    for index in range(steps):
        measured = Measured(plant.read_qpos(), plant.read_qvel(), plant.passive_force(True, True))
        state, outputs = control_step(layout, control, state, command, measured, Step(index, steps))
        for _ in range(refinement):
            measured = measured._replace(qpos=plant.read_qpos(), qvel=plant.read_qvel())
            step, effort = Step(index, steps), Outputs(outputs.motor)
            values = Values(state, command, measured, step, measured, outputs=effort)
            for stage in STAGES:
                if stage.function is not None and stage.name in ("inertia", "friction"):
                    values = stage.function(layout, joints, values)
            state = values.state
            plant.write_qf(values.outputs.qf)
            plant.step()
        table[index] = plant.read_qpos()
    return table


def contact_moves(robot: Robot, count: int, seed: int = 0) -> Moves:
    """Return ``count`` seeded moves from free poses until some link presses gently on the ground or on another."""
    rng, dynamics, line = np.random.default_rng(seed), robot.dynamics(), np.linspace(0, 1, _LINE)[:, None]

    def draw(_: int) -> list[tuple[Float64, Float64, str]]:
        here, there = robot.sample(2, seed=int(rng.integers(2**31)))
        touches = dynamics.in_contact(here + line * (there - here))
        touch = here + line[np.argmax(touches)] * (there - here)
        if touches[0] or not touches.any() or np.abs(touch - here).max() < APPROACH:
            return []
        direction = (there - here) / np.abs(there - here).max()
        target = np.clip(touch + PRESS * direction, robot.lower, robot.upper)
        return [(touch - APPROACH * direction, target, "contact")]

    return draw_moves(robot, count, draw)


def limit_moves(robot: Robot, count: int, seed: int = 0) -> Moves:
    """Return ``count`` seeded moves, each of one revolute joint to beyond one of its limits, touching nothing."""
    rng, dynamics, line = np.random.default_rng(seed), robot.dynamics(), np.linspace(0, 1, _LINE)[:, None]
    bounded = np.isfinite(robot.lower) & np.isfinite(robot.upper)
    joints = [j for j, joint in enumerate(robot.joints) if joint.type != "prismatic" and bounded[j]]

    def draw(_: int) -> list[tuple[Float64, Float64, str]]:
        if not joints:
            return []
        start = robot.sample(1, seed=int(rng.integers(2**31)))[0]
        joint = rng.choice(joints)
        limit, sign = (robot.upper[joint], 1) if rng.integers(2) else (robot.lower[joint], -1)
        start[joint] = limit - sign * APPROACH
        target = start.copy()
        target[joint] = limit + sign * BEYOND
        return [] if dynamics.in_contact(start + line * (target - start)).any() else [(start, target, "limit")]

    return draw_moves(robot, count, draw)


_MOVES = {"free": random_moves, "contact": contact_moves, "limit": limit_moves}


@dataclass(frozen=True)
class Options:
    """Errors of the physics presets against references 20 times finer, under the robots' tuned gains."""

    count: int = 8
    """Number of moves of each kind."""
    seconds: float = 1.0
    """Length of a move."""
    json: Path | None = None
    """File for the figures."""


def main(options: Options) -> None:
    """Print the table and write the figures."""
    figures: list[dict[str, Any]] = []
    for name in [each for each in Robot.bundled() if Robot.load(each).has_tuned]:
        for motion in REFERENCES:
            errors = measure_errors(Robot.load(name), motion, count=options.count, seconds=options.seconds)
            for (physics, reference), error in errors.items():
                figures.append(
                    {
                        "robot": name,
                        "motion": motion,
                        "physics": physics,
                        "reference": reference,
                        "max": error.largest,
                        "rms": error.rms,
                    }
                )
    labels = ("robot", "motion", "physics", "reference")
    rows = [[str(row[label]) for label in labels] + [f"{row['max']:.1e}", f"{row['rms']:.1e}"] for row in figures]
    print(table(rows, [*labels, "max [rad]", "RMS [rad]"], "llllrr"))
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(options.json, json.dumps({"accuracy": figures}) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
