"""Implausible figures of a robot: meshes in millimetres, masses in grams, inertia tensors in kg
mm^2, ...

Every figure is compared with the reach of the robot: the length L [m] of its longest chain of
joints. The reach itself is seldom wrong, because the robot would be drawn in pieces. The limits are
far from the figures of sound robots. In brackets are the most extreme figures of the 66 robots of
example-robot-data 6.0.0 and of the bundled ones:

- the shapes of a link are larger than 20 L (3.2 L), or all are smaller than L/200 (L/5);
- the mass of a link, if given by ``<inertial>``, over its cubed size is below 0.1 (2.6) or above
  30,000 (1030) kg/m^3; the size is the diagonal of its shapes, or the distance to the next joint if
  that is longer;
- its radius of gyration exceeds twice L and twice its size (0.6);
- a limit or mimic offset of a hinge is from 4 pi to 1000 rad (10 rad), as if degrees were read as
  radians.

Mass and inertia are not checked for a fixed base and for links with less than a hundredth of the
total mass: sensors, frames and stands often have arbitrary figures.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from batchpid.sim.robot.collision_shapes import hull_share
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.findings import Finding

LARGEST, SMALLEST = 20.0, 1 / 200
"""Bounds of the ratio of the shapes' size to the reach."""
SPARSEST, DENSEST = 0.1, 30_000.0
"""Bounds of the mass of a link per cubic size [kg/m^3]."""
GYRATION = 2.0
"""Bound of a radius of gyration over the reach, and over the size of the link."""
SHORT = 0.3
"""Least reach [m] that is assumed, e.g. for robots with all joints at one point."""
JUDGED = 0.01
"""Share of the total mass from which the mass and inertia of a link are checked."""

HULL = 1.2
"""Volume of a mesh's hull over that of the mesh, from which it is reported."""

FARTHEST, PLACEHOLDER = 4 * np.pi, 1000.0
"""Bounds between which limits of a hinge are taken for degrees [rad]; larger ones mean "no
limit".
"""

_UNITS = "give sizes in metres, meshes in millimetres with <mesh scale='0.001 0.001 0.001'>"


def implausible_figures(robot: RobotDescription) -> Iterator[Finding]:
    """Yield a finding for each implausible size, mass, inertia and angle."""
    masses = robot.link_masses
    (reach, next_joint) = _distances(robot)
    length = max(reach, SHORT)
    total = sum(mass.mass for mass in masses.values())
    of_reach = f"the robot's chain of joints is {reach:.3g} m long"
    sizes = {name: mass.size for name, mass in masses.items() if mass.size > 0}
    for name, size in sizes.items():
        if size > LARGEST * length:
            text = f"no robot has such large collision shapes: {of_reach}"
            yield Finding("warning", "scale", text, _UNITS, link=name, detail=f"{size:.3g} m")
    # A single small link is common, such as a sensor.
    largest = max(sizes.values(), default=math.inf)
    if largest < SMALLEST * reach:
        text = f"no robot has such small collision shapes, at most {largest:.2g} m: {of_reach}"
        remedy = "correct <mesh scale=>; the meshes may be in metres already"
        yield Finding("warning", "scale", text, remedy)
    root = robot.bodies[robot.all_joints[0].parent_link].link
    for name, mass in masses.items():
        at_rest = robot.fixed_base and robot.bodies[name].link == root
        if mass.source in ("shapes", "none") or mass.mass < JUDGED * total or at_rest:
            continue
        # A link may be longer than its shapes.
        size = max(mass.size, next_joint[name])
        if mass.size > 0 and not SPARSEST <= mass.mass / size**3 <= DENSEST:
            text = "no link of such a size has such a mass"
            remedy = "give <mass> in kg and <collision> in metres"
            detail = f"{mass.mass:.3g} kg over {size:.3g} m"
            yield Finding("warning", "mass", text, remedy, link=name, detail=detail)
        if mass.gyration > GYRATION * max(length, size):
            text = (
                "no link has so much inertia for its mass: its radius of gyration exceeds the"
                f" robot, {of_reach}"
            )
            remedy = "give <inertia> in kg m^2, about the centre of mass"
            detail = f"{mass.gyration:.3g} m"
            yield Finding("warning", "inertia", text, remedy, link=name, detail=detail)
    yield from _degrees(robot)


def changed_shapes(robot: RobotDescription) -> Iterator[Finding]:
    """Yield a finding for each mesh of a URDF that collides as a much larger hull."""
    for shape in robot.tables.shapes:
        if shape.file and (share := hull_share(shape)) > HULL:
            text = "a collision mesh is not convex: its convex hull collides, which is larger"
            remedy = "divide it into convex parts"
            detail = f"{share:.3g} times its volume"
            yield Finding("note", "hull", text, remedy, link=shape.owner, detail=detail)


def _degrees(robot: RobotDescription) -> Iterator[Finding]:
    """Yield a finding for limits and mimic offsets of a hinge that look like degrees."""
    for joint in robot.all_joints:
        offset = 0.0 if joint.mimic is None else joint.mimic.offset
        angles = {"lower": joint.lower, "upper": joint.upper, "mimic offset": offset}
        large = [
            f"{name} {angle:g} rad"
            for name, angle in angles.items()
            if FARTHEST < abs(angle) <= PLACEHOLDER
        ]
        if large and joint.unit == "rad":
            text = "angles of many turns, as if degrees were read as radians"
            remedy = "give radians, and velocities in rad/s"
            yield Finding("warning", "degrees", text, remedy, joint.name, detail=", ".join(large))


def _distances(robot: RobotDescription) -> tuple[float, dict[str, float]]:
    """Return the length [m] of the longest chain of joints, slides extended, and of each link the
    distance [m] to its farthest joint.
    """
    depth: dict[str, float] = defaultdict(float)
    farthest: dict[str, float] = defaultdict(float)
    for joint, body in zip(robot.all_joints, robot.links[1:], strict=True):  # parents first
        offset = float(np.linalg.norm(body.position))
        ends = (joint.lower, joint.upper) if joint.type == "prismatic" else ()
        travel = max((abs(end) for end in ends if np.isfinite(end)), default=0.0)
        depth[joint.child_link] = depth[joint.parent_link] + offset + travel
        farthest[joint.parent_link] = max(farthest[joint.parent_link], offset)
    return max(depth.values(), default=0.0), farthest
