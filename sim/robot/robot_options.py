"""What a run takes from its robot: scene, actuators and guard, tuned params, and digests."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.arrays.records import frozen
from batchpid.arrays.trees import digest
from batchpid.checks import entries, instance
from batchpid.errors import InvalidArgumentError
from batchpid.motors import DRIVEN, JOINT_SIDE
from batchpid.sim.description.merging import coupling_of
from batchpid.sim.description.tables import Joint
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.findings import Finding

if TYPE_CHECKING:
    from batchpid.sim.robot.robot import Robot

FRICTION_BAND = {"rad": 1e-4, "m": 2e-5}
"""Half width, by the joint's unit, of the band in which the compensation of friction is less than
the friction.
"""
FRICTION_SHARE = 0.8
"""Share of the robot's own actuators' Coulomb friction that is compensated.

Overcompensated friction lets a joint oscillate about its setpoint (C. Canudas de Wit, "Robust
control for servo-mechanisms under inexact friction compensation", Automatica 29, 1993). Friction
identified from a log is inexact; friction in the robot's description is exact, because the joint is
simulated with it.
"""

_NO_LIMIT = {
    "lower": -np.inf,
    "upper": np.inf,
    "rate": np.inf,
    "acceleration": np.inf,
}


def known_joints(robot: Robot) -> dict[str, Float64]:
    """Return the joints as a controller knows them, in addition to the robot's description, from
    the robot's own actuators.

    ``coulomb``: friction to compensate [N m or N]; ``viscous``: damping [N m s/rad or N s/m];
    ``armature``: reflected inertia of the motors [kg m^2 or kg]; each (dof,).
    """
    motors = robot.actuators or bp.Actuators()
    leaves = {}
    for name in ("coulomb", "viscous", "armature"):
        leaf = getattr(motors, name)
        leaves[name] = np.zeros(robot.dof) if leaf is None else leaf[0].astype(float)
    leaves["coulomb"] *= FRICTION_SHARE
    return leaves


def load_robot_actuators(source: bp.Actuators | str | Path, robot: Robot) -> bp.Actuators:
    """Return actuators of ``robot``, given or in a file.

    Raises
    ------
    InvalidArgumentError
        They do not fit the robot, or the file cannot be read.
    FileNotFoundError
        The file does not exist.
    """
    if isinstance(source, str | Path):
        source, _ = bp.load_actuators(source, robot.joint_names)
    return fit_actuators(source, robot, 1, "pid")


def fit_actuators(
    actuators: bp.Actuators,
    robot: Robot,
    num_envs: int,
    control: object,
) -> bp.Actuators:
    """Return ``actuators`` if they fit robot and control, with the robot's continuous joints.

    Followers have no motor: their bias, friction and armature are left out. Raises
    InvalidArgumentError if they do not fit.
    """
    instance("actuators", actuators, bp.Actuators, "build them with make_actuators()")
    actuators.check(num_envs, robot.joint_names)
    if control == "drive" and (
        actuators.measures or actuators.delivers or actuators.load_friction is not None
    ):
        raise InvalidArgumentError(
            "actuators",
            "change efforts or measurements, or use the effort, which the engines' drives bypass",
            remedy=f"use control 'pid', or leave only {', '.join(DRIVEN)}",
        )
    # Ideal ones have no leaf that a joint could change.
    if not actuators.num_joints:
        return actuators
    motors = {name: getattr(actuators, name) for name in ("bias", *JOINT_SIDE)}
    # The leader carries friction and armature of its followers.
    motors = {name: leaf * robot.independent for name, leaf in motors.items() if leaf is not None}
    described = {"coulomb": robot.friction, "static": robot.friction, "viscous": robot.damping}
    for name, least in described.items():
        if name in motors:
            problem = "is less than none, together with the description's"
            remedy = "give at least minus the friction or damping of the robot's file"
            # Of a float32 the sum may be zero but for its rounding.
            good = motors[name] >= -(1 + 1e-6) * least
            entries(
                name,
                motors[name],
                good,
                problem,
                robot.joint_names,
                remedy=remedy,
            )
    return actuators.replace(**motors, continuous=robot.continuous)


def setpoint_guard(
    joints: Sequence[Joint], rate: ArrayLike | None, acceleration: ArrayLike | None
) -> bp.Guard:
    """Return the limits of setpoints of the degrees of freedom ``joints``, of the URDF where they
    are not given.

    Followers have none: their limits are those of their leaders (:func:`couple`).

    Raises InvalidArgumentError if a follower of a continuous joint has position limits.
    """
    for joint in joints:
        if joint.continuous and joint.mimic is None and math.isfinite(joint.lower):
            problem = "turns without end, and cannot hold the position limits of its follower"
            remedy = "make it revolute with limits, or remove those of the follower"
            raise InvalidArgumentError("guard", problem, joint=joint.name, remedy=remedy)
    accelerations = [joint.acceleration_limit for joint in joints]
    guard = bp.make_guard(
        len(joints),
        lower=[max(joint.lower, joint.soft_lower) for joint in joints],
        upper=[min(joint.upper, joint.soft_upper) for joint in joints],
        rate=[joint.velocity_limit for joint in joints] if rate is None else rate,
        acceleration=accelerations if acceleration is None else acceleration,
        continuous=[joint.continuous for joint in joints],
        joint_names=[joint.name for joint in joints],
    )
    leads = coupling_of(tuple(joints)).independent
    leaves = {}
    for name, none in _NO_LIMIT.items():
        if (leaf := getattr(guard, name)) is not None:
            leaves[name] = np.where(leads, leaf, none)
    return guard._replace(**leaves)


def fit_guard(
    guard: object,
    joints: Sequence[Joint],
    num_envs: int,
    control: str,
    sets_positions: bool,
) -> bp.Guard | None:
    """Return the guard for a runner's option ``guard``; None means no guard.

    Raises InvalidArgumentError if it does not fit the robot or the control, or limits a follower.
    """
    if guard is False or guard is None:
        return None
    if not sets_positions:
        problem = "limits positions of joints, which this control does not take"
        remedy = "use control 'pid' or 'drive'"
        raise InvalidArgumentError("guard", problem, value=control, remedy=remedy)
    limits = setpoint_guard(joints, None, None) if guard is True else guard
    limits = instance("guard", limits, bp.Guard, "pass True, or robot.guard(...)")
    joint_names = [joint.name for joint in joints]
    limits.check(num_envs, joint_names)
    leads = coupling_of(tuple(joints)).independent
    for name in _NO_LIMIT:
        if (leaf := getattr(limits, name)) is not None:
            free = leads | np.isinf(leaf)
            remedy = "limit its leader, or use robot.guard(...), which limits leaders alone"
            entries(name, leaf, free, "limits a follower", joint_names, remedy=remedy)
    return frozen(limits)


def scene_of(
    robot: Robot,
    timestep: float,
    physics: object,
    **options: Any,
) -> SceneSpec:
    """Return the description of scenes of ``robot`` for an engine; ``options`` are further fields of
    it.
    """
    return SceneSpec(
        robot.tables,
        robot.self_contact.ignored,
        robot.joints,
        timestep,
        physics,
        dissipation=robot.source.dissipation,
        fixed_base=robot.fixed_base,
        **options,
    )


def engine_findings(robot: Robot, name: str | None, timestep: float) -> Iterator[Finding]:
    """Yield findings of the content of ``robot`` that the engine ``name`` cannot run, or runs
    otherwise than the file says; none without a name.
    """
    if name is None:
        return
    engine = load_engine(name)
    ground = {"ground": robot.has_ground, "mjcf": robot.mjcf}
    scene = scene_of(robot, timestep, engine.physics["accurate"], **ground)
    yield from engine.refusals(scene)
    yield from engine.shortfalls(scene)


def tuned_file(robot: Robot) -> Path | None:
    """Return the file of the tuned params that ship with a robot, None without one."""
    file = robot.path.with_suffix(".tuned.yaml")
    return file if robot.settings is not None and file.is_file() else None


def describe(robot: Robot) -> Document:
    """Return a description of the simulated robot as plain values, equal for robots of equal
    content.

    The tables with the collision meshes, the pairs that do not collide, and the settings of a
    bundled robot are given by digests. The actuators are left out.
    """
    source = robot.source
    return {
        "robot": robot.name,
        "content": content(robot),
        "srdf": digest(source.disabled, source.enabled),
        "settings": digest(robot.settings, source.start, source.gains),
        "mjcf": None if robot.mjcf is None else digest(replace(robot.mjcf, path="")),
        "self_collision": source.self_collision,
        "dissipation": source.dissipation,
        "fixed_base": robot.fixed_base,
        "base_start": source.base_start,
    }


@lru_cache(maxsize=16)
def content(robot: Robot) -> str:
    """Return the digest of bodies, joints and shapes, with the content of mesh files in place of
    their paths.
    """
    shapes = [shape._replace(file="") for shape in robot.tables.shapes]
    return digest(robot.tables.bodies, shapes, robot.joints)
