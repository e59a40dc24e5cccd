"""Preflight: oddities of a robot, its gains and its setpoint, reported before the first step.

``Robot.load`` raises an error if no engine can run the file. A :class:`batchpid.sim.Finding`
reports a robot that runs, but differently than the file or the user intends: :data:`ODDITIES`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.checks import array, choice, instance, number, within
from batchpid.errors import InvalidArgumentError
from batchpid.sim.diagnosis.loop_stability import NEAR_BOUND, stability_report
from batchpid.sim.findings import LIMIT_TOLERANCE, SEVERITIES, Finding, Findings
from batchpid.sim.geometry.shapes import (
    LEAST_MASS,
    extent,
    hull_share,
    inertia_of,
    triangle_excess,
)

if TYPE_CHECKING:
    from batchpid.sim.robot.robot import Robot

HELD_POSES = 50
"""Poses in which joints should hold themselves."""
LEAST_EXCESS = 0.01
"""Excess over the triangle inequality of principal moments from which it is reported; less is
rounding.
"""
LARGEST_SHAPES, SMALLEST_SHAPES = 20.0, 1 / 200
"""Bounds of the ratio of the shapes' size to the length of the longest chain of joints. The most
extreme ratios of the bundled robots and of example-robot-data 6.0.0 are 3.2 and 1/5.
"""
SHORTEST_CHAIN = 0.3
"""Least length of the chain [m] that is assumed, e.g. for robots with all joints at one point."""
LARGEST_HULL = 1.2
"""Volume of a mesh's hull over that of the mesh, from which it is reported."""
MOST_RADIANS, PLACEHOLDER = 4 * np.pi, 1000.0
"""Bounds between which limits of a hinge are taken for degrees [rad]; larger ones mean "no
limit".
"""


def check(
    robot: Robot,
    params: bp.PIDParams | None,
    qpos: ArrayLike | None,
    setpoint: ArrayLike | None,
    timestep: float,
    control: str,
    of_engine: Iterable[Finding],
) -> Findings:
    """Return the findings, most severe first, those of an engine included;
    :meth:`batchpid.sim.Robot.check` describes the other arguments.
    """
    timestep = number("timestep", timestep, 1e-6, 0.1, "seconds")
    choice("control", control, ("pid", "drive", "effort"))
    names = robot.joint_names
    start = robot.start
    if qpos is not None:
        start = within("qpos", array("qpos", qpos, (1, robot.dof), names), 1e6, names)[0]
    goal = None
    if setpoint is not None:
        goal = array("setpoint", setpoint, (1, robot.dof), names)[0]
    if params is not None:
        instance("params", params, bp.PIDParams, "use robot.params()")
        if params.num_joints != robot.dof:
            problem = f"must have {robot.dof} joints"
            remedy = "build them with robot.params()"
            raise InvalidArgumentError("params", problem, value=params.num_joints, remedy=remedy)
        # Gains of a drive are not sampled, and its errors do not wrap.
        params = params if control == "pid" else None
    plan = _Plan(robot, start, goal, params, timestep)
    findings = list(robot.repairs)
    for oddities in ODDITIES:
        findings += oddities(plan)
    findings += of_engine
    return Findings(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


@dataclass(frozen=True, eq=False)
class _Plan:
    """Robot, and what it is to do."""

    robot: Robot
    start: Float64
    goal: Float64 | None
    params: bp.PIDParams | None
    timestep: float


def touching_links(
    robot: Robot,
    qpos: Float64,
    ground: bool,
    distance: float,
) -> dict[str, float]:
    """Return pairs of links, or of a link and the ground, that are nearer than ``distance`` [m] at
    ``qpos`` (dof,), with their distances, the nearest last.
    """
    near = robot.dynamics(ground).contacts.near(qpos, distance)
    # Of two links with several shapes the nearest, which is last.
    pairs = sorted(near, key=itemgetter(2), reverse=True)
    return {f"{link} on {other or 'the ground'}": gap for link, other, gap in pairs}


def _odd_sizes(plan: _Plan) -> Iterator[Finding]:
    """Yield links whose shapes are larger than the robot, or the robot if all are tiny."""
    tables = plan.robot.tables
    # Length [m] of the longest chain of joints, slides extended; parents come first.
    length: dict[str, float] = defaultdict(float)
    for joint, link in zip(tables.joints, tables.bodies[1:], strict=True):
        ends = (joint.lower, joint.upper) if joint.type == "prismatic" else ()
        travel = max((abs(end) for end in ends if np.isfinite(end)), default=0.0)
        offset = float(np.linalg.norm(link.position)) + travel
        length[joint.child_link] = length[joint.parent_link] + offset
    chain = max(length.values(), default=0.0)
    sizes: dict[str, float] = defaultdict(float)
    for shape in tables.shapes:
        sizes[shape.owner] = max(sizes[shape.owner], extent(shape))
    of_chain = f"the robot's chain of joints is {chain:.3g} m long"
    for name, size in sizes.items():
        if size > LARGEST_SHAPES * max(chain, SHORTEST_CHAIN):
            yield Finding.of("units", link=name, detail=f"shapes of {size:.3g} m; {of_chain}")
    # A single small link is common, such as a sensor.
    largest = max(sizes.values(), default=math.inf)
    if largest < SMALLEST_SHAPES * chain:
        yield Finding.of("units", detail=f"shapes of at most {largest:.2g} m; {of_chain}")


def _odd_angles(plan: _Plan) -> Iterator[Finding]:
    """Yield hinges with limits or mimic offsets of many turns."""
    for joint in plan.robot.tables.joints:
        offset = 0.0 if joint.mimic is None else joint.mimic.offset
        angles = {"lower": joint.lower, "upper": joint.upper, "mimic offset": offset}
        large = [
            f"{name} {angle:g} rad"
            for name, angle in angles.items()
            if MOST_RADIANS < abs(angle) <= PLACEHOLDER
        ]
        if large and joint.unit == "rad":
            yield Finding.of("units", joint=joint.name, detail=", ".join(large))


def _odd_inertia(plan: _Plan) -> Iterator[Finding]:
    """Yield links with a principal moment above the sum of the others."""
    for link in plan.robot.tables.bodies:
        excess = triangle_excess(link.inertia) if link.mass else 0.0
        if excess > LEAST_EXCESS:
            yield Finding.of(
                "inertia",
                text="no body has such an inertia tensor, a moment above the sum of the others:"
                " simulated as given",
                remedy="correct <inertia>",
                link=link.name,
                detail=f"by {100 * excess:.0f} %",
            )


def _massless(plan: _Plan) -> Iterator[Finding]:
    """Yield links whose mass is that of their shapes, and bodies that carry no mass at all."""
    robot = plan.robot
    bodies = {name: place.link for name, place in robot.bodies.items()}
    root = bodies[robot.tables.joints[0].parent_link]
    masses = {link.name: link.mass for link in robot.tables.bodies}
    shaped = dict[str, float]()
    for name, mass in masses.items():
        if not mass and (shapes := robot.tables.shapes_of(name)):
            shaped[name] = inertia_of(shapes).mass
    masses |= shaped
    loaded = {bodies[name] for name, mass in masses.items() if mass > LEAST_MASS}
    # Bodies with mass in them, or in the links that they carry.
    for joint in reversed(robot.tables.joints):
        if bodies[joint.child_link] in loaded:
            loaded.add(bodies[joint.parent_link])
    for name in masses:
        if robot.fixed_base and bodies[name] == root:
            continue
        if name in shaped:
            yield Finding.of("no-inertia", link=name, detail=f"{shaped[name]:.3g} kg")
        elif name == bodies[name] and name not in loaded:
            yield Finding.of("no-inertia", link=name, detail="1e-6 kg")


def _changed_meshes(plan: _Plan) -> Iterator[Finding]:
    """Yield links with a mesh that is much smaller than the hull that collides in its place."""
    for shape in plan.robot.tables.shapes:
        if (share := hull_share(shape)) > LARGEST_HULL:
            yield Finding.of(
                "collision",
                text="a collision mesh is not convex, and collides as its convex hull",
                remedy="divide the mesh into convex parts",
                link=shape.owner,
                detail=f"{share:.3g} times its volume",
            )


def _touching(plan: _Plan) -> Iterator[Finding]:
    """Yield the robot if links touch at the start pose or at the setpoint."""
    robot = plan.robot
    # A floating base starts on its ground, which is no fault.
    ground = robot.fixed_base and robot.has_ground
    goal = robot.target if plan.goal is None else robot.coupling.positions(plan.goal)
    for name, qpos in (("start pose", plan.start), ("setpoint", goal)):
        pairs = touching_links(robot, qpos, ground, 0.0)
        if pairs:
            *_, nearest = pairs
            yield Finding.of("touching", detail=f"{name}: {nearest}")


def _outside(plan: _Plan) -> Iterator[Finding]:
    """Yield joints whose start position or setpoint is outside the limits."""
    for name, qpos in (("start pose", plan.start), ("setpoint", plan.goal)):
        if qpos is not None:
            for joint, value in zip(plan.robot.joints, qpos.tolist(), strict=True):
                if joint.lower - LIMIT_TOLERANCE <= value <= joint.upper + LIMIT_TOLERANCE:
                    continue
                yield Finding.of(
                    "out-of-limits",
                    joint=joint.name,
                    detail=f"{name} {value:g} {joint.unit}, limits [{joint.lower:g},"
                    f" {joint.upper:g}]",
                )


def _weak(plan: _Plan) -> Iterator[Finding]:
    """Yield joints that cannot be held, or not be moved, in some poses."""
    robot = plan.robot
    limits = robot.effort_limit
    load = np.abs(robot.dynamics().holding_efforts(robot.sample(HELD_POSES, seed=0)))
    share = (load + robot.friction >= limits).mean(0)
    for index in np.flatnonzero((share > 0) & (limits > 0)):
        joint = robot.joints[index]
        yield Finding.of(
            "effort-limit",
            joint=joint.name,
            detail=f"{joint.effort_limit:g} {joint.effort_unit}, gravity up to"
            f" {load[:, index].max():.3g}, friction {joint.friction:g},"
            f" {100 * share[index]:.0f} % of poses",
        )


def _without_effort_limit(plan: _Plan) -> Iterator[Finding]:
    """Yield joints without an effort limit, with the one of their designed gains."""
    robot = plan.robot
    for joint, limit in zip(robot.joints, robot.design_effort_limit, strict=True):
        if math.isinf(joint.effort_limit) and joint.mimic is None:
            yield Finding.of(
                "no-effort-limit", joint=joint.name, detail=f"{limit:.3g} {joint.effort_unit}"
            )


def _unstable(plan: _Plan) -> Iterator[Finding]:
    """Yield the joint that is the first to become unstable."""
    if plan.params is None:
        return
    robot = plan.robot
    report = stability_report(robot, plan.params, plan.start, plan.timestep, robot.actuators)
    ratio, participation, _, motion, remedy = report
    if ratio < NEAR_BOUND:
        return
    effect = "it may diverge in other poses"
    if plan.params.discretization is not None:
        effect = f"it diverges if the robot has {1 / ratio:.3g} times the model's inertia, or less"
    elif ratio >= 1:
        effect = motion
    joint = robot.joint_names[int(np.argmax(participation))]
    detail = f"{ratio:.3g} times the bound at the start pose: {effect}"
    yield Finding.of("unstable", joint=joint, detail=detail, remedy=remedy)


ODDITIES: tuple[Callable[[_Plan], Iterator[Finding]], ...] = (
    _odd_sizes,
    _odd_angles,
    _odd_inertia,
    _massless,
    _changed_meshes,
    _touching,
    _outside,
    _weak,
    _without_effort_limit,
    _unstable,
)
"""Every oddity, in the order in which they are listed."""
