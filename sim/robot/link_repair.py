"""Inertia tensors that a body can have, and repair of a URDF's links: mass, inertia and collision
shapes.

The principal moments a <= b <= c of a body are positive and satisfy the triangle inequality c <= a
+ b. This says that the density-weighted covariance tr(I)/2 - I has no negative eigenvalue: P. M.
Wensing, S. Kim, J.-J. E. Slotine, "Linear matrix inequalities for physically consistent inertial
parameter identification", IEEE Robotics and Automation Letters 3 (2018).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from lxml import etree

from batchpid.arrays.array_types import Float64
from batchpid.sim.robot.findings import Finding, finding_of
from batchpid.sim.robot.xml import fault, readable

# smallest principal moment over the largest of a tensor that had to be replaced; PhysX divides by
# it
SLENDER = 1e-3
DENSITY = 1000.0  # [kg/m^3] of water, with which SAPIEN computes the mass of shapes


def from_entries(entries: Sequence[float]) -> Float64:
    """Return the tensor (3, 3) of its entries xx, xy, xz, yy, yz, zz."""
    tensor = np.zeros((3, 3))
    tensor[np.triu_indices(3)] = entries
    return tensor + np.triu(tensor, 1).T


def nearest_physical(tensor: Float64) -> Float64:
    """Return the physically possible inertia tensor (3, 3) nearest to a symmetric one in the
    Frobenius norm.

    The nearest has the same principal axes, so the moments are projected on the cone of the
    triangle inequalities: on its face c = a + b or, if a would be negative there, on its edge (0,
    m, m). Then a is raised to SLENDER times c. The result is zero if no moment is positive.
    """
    (a, b, c), axes = np.linalg.eigh(tensor)
    excess = max(c - a - b, 0.0) / 3
    a = a + excess
    b = b + excess
    c = c - excess
    if a < 0:
        a, b, c = 0.0, (b + c) / 2, (b + c) / 2
    moments = np.maximum([a, b, c], 0.0)
    moments[0] = max(moments[0], SLENDER * moments[2])
    return (axes * moments) @ axes.T


def possible_inertia(mass: float, tensor: Float64) -> tuple[Float64, tuple[str, str] | None]:
    """Return an inertia tensor (3, 3) if PhysX can simulate it, else the nearest that a body of
    that mass has, with the problem and its figures.
    """
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] >= max(SMALLEST, SMALLEST_RATIO * moments[2]):
        return tensor, None
    if moments[2] >= SMALLEST:
        changed = nearest_physical(tensor)
    else:
        changed = np.zeros((3, 3))
    done = "the nearest that a body has is used"
    if changed.max() < SMALLEST:
        changed = ball(mass)
        done = f"that of a ball of its mass at {DENSITY:g} kg/m^3 is used"
    before, after = (
        " ".join(f"{moment:.3g}" for moment in row)
        for row in (moments, np.linalg.eigvalsh(changed))
    )
    text = f"no body has such an inertia tensor: {done}"
    return changed, (text, f"moments {before} kg m^2, used {after}")


def triangle_excess(tensor: Float64) -> float:
    """Return (c - a - b) / c of the principal moments of a tensor (3, 3): positive if the tensor is
    impossible.
    """
    a, b, c = np.linalg.eigvalsh(tensor)
    return float((c - a - b) / c)


def ball(mass: float) -> Float64:
    """Return the inertia tensor (3, 3) [kg m^2] of a ball of ``mass`` [kg] at DENSITY: 2/5 m
    r^2.
    """
    radius = (3 * mass / (4 * np.pi * DENSITY)) ** (1 / 3)
    return 0.4 * mass * radius**2 * np.eye(3)


# mass [kg] and principal moment [kg m^2] with a reciprocal that single precision can hold
SMALLEST = 1e-30
SMALLEST_RATIO = 1e-9  # of principal moments that SAPIEN's eigenvalues and single precision resolve
SMALLEST_SIZE, LARGEST_SIZE = (
    1e-6,
    1e6,
)  # of shapes [m] and scales of meshes, by PhysX's limits of the latter
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
SHAPES = {  # that SAPIEN knows: their attributes, each with as many numbers as it has
    "box": {"size": "0 0 0"},
    "sphere": {"radius": "0"},
    "cylinder": {"radius": "0", "length": "0"},
    "capsule": {"radius": "0", "length": "0"},
    "mesh": {"scale": "1 1 1"},
}


def repair(link: etree._Element) -> Iterator[Finding]:
    """Repair a link."""
    yield from _inertial(link)
    yield from _collisions(link)


def _inertial(link: etree._Element) -> Iterator[Finding]:
    """Replace inertia tensors that no body has; remove masses that none has."""
    if (inertial := link.find("inertial")) is None:
        return
    origin, mass, inertia = map(inertial.find, ("origin", "mass", "inertia"))
    if problem := _misplaced(origin):
        text = f"{problem}: the centre of mass is taken at the origin of the link"
        yield finding_of(link, "warning", "inertia", text, "correct <inertial><origin>")
        inertial.remove(origin)
    value = readable(mass, "value", "0")
    if value is None or value[0] < 0 or 0 < value[0] < SMALLEST:
        problem = (
            fault(mass, "value", "0")
            or f"<mass value={mass.get('value')!r}> is a mass that PhysX cannot hold"
        )
        text = f"{problem}: it counts as not given"
        yield finding_of(link, "warning", "inertia", text, "give a mass > 0 [kg]")
        value = None
    if not value or not value[0]:
        link.remove(inertial)  # SAPIEN does not use it
        return
    # Every entry is named, since each may be wrong by itself.
    for problem in filter(None, (fault(inertia, key, "0") for key in MOMENTS)):
        text = f"{problem}: the inertia tensor counts as not given"
        yield finding_of(link, "warning", "inertia", text, "correct <inertia>")
    # One unreadable entry makes the whole tensor unknown.
    parts = [readable(inertia, key, "0") for key in MOMENTS]
    if None in parts:
        tensor = np.zeros((3, 3))
    else:
        tensor = from_entries([part[0] for part in parts if part])
    changed, problem_and_detail = possible_inertia(value[0], tensor)
    if problem_and_detail is not None:
        text, detail = problem_and_detail
        yield finding_of(link, "warning", "inertia", text, "correct <inertia>", detail)
    if inertia is None:
        inertia = etree.SubElement(inertial, "inertia")
    for key, moment in zip(MOMENTS, changed[np.triu_indices(3)].tolist(), strict=True):
        if changed is not tensor or key not in inertia.attrib:
            inertia.set(key, repr(moment))


def _collisions(link: etree._Element) -> Iterator[Finding]:
    """Leave out collision shapes that PhysX cannot hold."""
    for collision in link.findall("collision"):
        shapes = collision.findall("geometry/*")
        problem = _misplaced(collision.find("origin"))
        if not shapes:
            problem = f"it has none of {', '.join(SHAPES)}"
        for shape in shapes:
            for key, default in SHAPES[shape.tag].items():
                text = shape.get(key, default)
                if key == "scale" and len(text.split()) == 1:
                    shape.set(key, " ".join([text] * 3))  # one factor for all axes
                sizes = readable(shape, key, default)
                # A negative scale mirrors the mesh.
                smallest = min(abs(size) if key == "scale" else size for size in sizes or (0.0,))
                if not sizes or smallest < SMALLEST_SIZE or max(sizes) > LARGEST_SIZE:
                    problem = (
                        f"<{shape.tag} {key}={text!r}> is not from {SMALLEST_SIZE:g} to"
                        f" {LARGEST_SIZE:g}"
                    )
        if problem is not None:
            text = f"a collision shape is left out: {problem}"
            yield finding_of(link, "warning", "collision", text, "correct <collision>")
            link.remove(collision)


def _misplaced(origin: etree._Element | None) -> str | None:
    """Return the fault of an ``<origin>`` that cannot be read, or None."""
    return fault(origin, "xyz", "0 0 0") or fault(origin, "rpy", "0 0 0")
