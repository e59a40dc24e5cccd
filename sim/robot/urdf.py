"""Reading a URDF for headless simulation: parsed safely, visuals dropped, meshes found, joints listed.

SAPIEN's own loader builds render components for every ``<visual>``, which fails on a machine without a render
device, and goes on silently when a collision mesh is missing. Here the text is sanitised once; what the
simulator is given holds no visual, no mimic that it would get wrong without a word, and absolute mesh paths.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lxml import etree

from batchpid.errors import RobotError
from sim.robot.xml import number, numbers, parse_xml

_SIZES = {
    "box": {"size": 3},
    "sphere": {"radius": 1},
    "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1},
}
# Attributes of the collision shapes that SAPIEN knows, and how many numbers each has.

MOVING_TYPES = ("revolute", "continuous", "prismatic")
"""URDF joint types that SAPIEN turns into degrees of freedom."""


@dataclass(frozen=True)
class Mimic:
    """``q = multiplier * q_of_joint + offset``, as the URDF says it."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """One joint of the URDF. Units: rad, N m, rad/s (revolute) or m, N, m/s (prismatic).

    Limits that the URDF leaves out are infinite.
    """

    name: str
    type: str
    parent_link: str
    child_link: str
    lower: float = -math.inf
    upper: float = math.inf
    effort_limit: float = math.inf
    velocity_limit: float = math.inf
    damping: float = 0.0
    friction: float = 0.0
    mimic: Mimic | None = None

    @property
    def moves(self) -> bool:
        """Whether the joint is a degree of freedom."""
        return self.type in MOVING_TYPES

    @property
    def continuous(self) -> bool:
        """Whether positions wrap at a full turn (URDF type ``continuous``)."""
        return self.type == "continuous"

    @property
    def unit(self) -> str:
        """Unit of position: ``"m"`` for a prismatic joint, else ``"rad"``."""
        return "m" if self.type == "prismatic" else "rad"

    @property
    def effort_unit(self) -> str:
        """Unit of effort: ``"N"`` for a prismatic joint, else ``"N m"``."""
        return "N" if self.type == "prismatic" else "N m"


@dataclass(frozen=True)
class Link:
    """One link: its mass [kg] (None without ``<inertial>``) and how many collision shapes it has.

    ``inertial`` is whether SAPIEN takes mass and inertia from the URDF: both are there, and not zero.
    """

    name: str
    mass: float | None
    collisions: int
    inertial: bool


@dataclass(frozen=True)
class Urdf:
    """A URDF, ready for the headless simulator.

    ``joints`` are in the order in which SAPIEN numbers them: breadth first from the root, fixed joints counted,
    joints of one parent in the order of the file. ``text`` is what the simulator parses; ``missing_meshes``
    names the collision meshes that it lacks.
    """

    name: str
    text: str
    joints: tuple[Joint, ...]
    links: tuple[Link, ...]
    missing_meshes: tuple[str, ...] = ()


def read_urdf(path: Path, *, package_dirs: tuple[Path, ...] = (), missing_meshes: str = "error") -> Urdf:
    """Read and sanitise the URDF file at ``path``.

    Parameters
    ----------
    package_dirs
        Where ``package://NAME/...`` is looked up, before the folders above the file.
    missing_meshes
        ``"error"``, or ``"skip"`` to simulate without the shapes whose mesh file cannot be found.

    Raises
    ------
    RobotNotFoundError
        There is no such file.
    RobotError
        Malformed XML, an entity or DTD, a structure that SAPIEN cannot build, a missing mesh.
    """
    root = parse_xml(path)
    if root.tag != "robot":
        raise RobotError(f"{path}: the root element is <{root.tag}>, not <robot>; is this a URDF (not SDF, xacro)?")
    for element in list(root.iter("visual")):
        element.getparent().remove(element)
    missing = _resolve_meshes(root, path, package_dirs)
    if missing and missing_meshes == "error":
        raise RobotError(
            f"{path}: collision mesh not found: {', '.join(missing)}; "
            "pass package_dirs=[...] with the folder that holds the package, or missing_meshes='skip' to "
            "simulate without these shapes"
        )
    joints = [_read_joint(element, path) for element in root.findall("joint")]
    links = [_read_link(element, path) for element in root.findall("link")]
    _keep_working_mimics(root, joints, path)
    _spell_out(root, joints)
    ordered = tuple(_breadth_first(links, joints, path))
    return Urdf(
        name=root.get("name", path.stem),
        text=etree.tostring(root, encoding="unicode"),
        joints=ordered,
        links=tuple(links),
        missing_meshes=tuple(missing),
    )


def _resolve_meshes(root: etree._Element, path: Path, package_dirs: tuple[Path, ...]) -> list[str]:
    """Make mesh paths absolute; drop the shapes whose file is missing and return their names."""
    missing = []
    for collision in list(root.iter("collision")):
        mesh = collision.find("geometry/mesh")
        if mesh is None:
            continue
        name = mesh.get("filename", "")
        found = find_mesh(name, path, package_dirs)
        if found is None:
            missing.append(name)
            collision.getparent().remove(collision)
        else:
            mesh.set("filename", str(found))
    return missing


def find_mesh(name: str, path: Path, package_dirs: tuple[Path, ...]) -> Path | None:
    """The mesh file that the URDF at ``path`` calls ``name``, if it exists."""
    relative = name.removeprefix("package://").removeprefix("file://")
    folders = [path.parent, *package_dirs]
    if name.startswith("package://"):
        folders = [*package_dirs, *path.absolute().parents]
    for folder in folders:
        candidate = (folder / relative).absolute()
        if relative and candidate.is_file():
            return candidate
    return None


def _read_joint(element: etree._Element, path: Path) -> Joint:
    name = element.get("name", "")
    where = f"{path}: joint {name!r}"
    kind = element.get("type", "")
    if kind not in (*MOVING_TYPES, "fixed"):
        raise RobotError(
            f"{where}: type {kind!r} cannot be simulated by SAPIEN's loader; "
            "use revolute, continuous, prismatic or fixed"
        )
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None or not parent.get("link") or not child.get("link"):
        raise RobotError(f"{where}: needs <parent link=...> and <child link=...>; add them")
    _check_origin(element, where)
    axis = element.find("axis")
    if kind != "fixed" and axis is not None and math.hypot(*numbers(axis, "xyz", 3, where)) < 1e-3:
        raise RobotError(f"{where}: <axis xyz={axis.get('xyz')!r}> has no direction; correct the URDF")
    limit, dynamics, mimic = element.find("limit"), element.find("dynamics"), element.find("mimic")
    limits: dict[str, float] = {}
    if limit is not None:
        limits["effort_limit"] = number(limit, "effort", math.inf, where)
        limits["velocity_limit"] = number(limit, "velocity", math.inf, where)
        if kind in ("revolute", "prismatic"):
            limits["lower"] = number(limit, "lower", 0.0, where)
            limits["upper"] = number(limit, "upper", 0.0, where)
    elif kind in ("revolute", "prismatic"):
        raise RobotError(f"{where}: a {kind} joint needs <limit lower= upper= effort= velocity=>; add it")
    if any(math.isnan(value) for value in limits.values()):
        raise RobotError(f"{where}: a limit is NaN ({limits}); give numbers")
    if limits.get("lower", -math.inf) > limits.get("upper", math.inf):
        raise RobotError(
            f"{where}: lower limit {limits['lower']:g} is above upper limit {limits['upper']:g}; swap them"
        )
    if limits.get("effort_limit", 0.0) < 0 or limits.get("velocity_limit", 0.0) < 0:
        raise RobotError(f"{where}: effort and velocity limits must be >= 0 ({limits}); correct the URDF")
    passive: dict[str, float] = {}
    if dynamics is not None:
        passive = {key: number(dynamics, key, 0.0, where) for key in ("damping", "friction")}
        if any(not 0 <= value < math.inf for value in passive.values()):
            raise RobotError(f"{where}: damping and friction must be finite and >= 0 ({passive}); correct the URDF")
    return Joint(
        name=name,
        type=kind,
        parent_link=parent.get("link"),
        child_link=child.get("link"),
        mimic=None
        if mimic is None
        else Mimic(
            mimic.get("joint", ""),
            number(mimic, "multiplier", 1.0, where),
            number(mimic, "offset", 0.0, where),
        ),
        **limits,
        **passive,
    )


def mimic_works(joint: Joint, joints: Sequence[Joint]) -> bool:
    """Whether SAPIEN realises the mimic of ``joint``, which it does by a tendon.

    It has to be ``q = +-q_other``; the other joint a sibling, or the one above with a link above it. Anything
    else SAPIEN gets wrong, or drops, without a word.
    """
    mimic = joint.mimic
    if mimic is None or abs(mimic.multiplier) != 1 or mimic.offset != 0:
        return False
    other = next(other for other in joints if other.name == mimic.joint)
    if not other.moves or other is joint:
        return False
    return joint.parent_link in (other.child_link, other.parent_link)


def _keep_working_mimics(root: etree._Element, joints: Sequence[Joint], path: Path) -> None:
    """Remove the mimics that the simulator would get wrong: those joints move by themselves, and a check says so."""
    for element, joint in zip(root.findall("joint"), joints, strict=True):
        if joint.mimic is None:
            continue
        if joint.mimic.joint not in {other.name for other in joints}:
            raise RobotError(
                f"{path}: joint {joint.name!r} mimics the unknown joint {joint.mimic.joint!r}; correct the name"
            )
        if not mimic_works(joint, joints):
            element.remove(element.find("mimic"))


def _spell_out(root: etree._Element, joints: Sequence[Joint]) -> None:
    """Write out what joints leave to the defaults: SAPIEN takes a missing limit for NaN, and fails without damping."""
    for element, joint in zip(root.findall("joint"), joints, strict=True):
        limit, dynamics = element.find("limit"), element.find("dynamics")
        if limit is not None and joint.moves and not joint.continuous:
            limit.set("lower", repr(joint.lower))
            limit.set("upper", repr(joint.upper))
        if dynamics is not None:
            dynamics.set("damping", repr(joint.damping))
            dynamics.set("friction", repr(joint.friction))


def _read_link(element: etree._Element, path: Path) -> Link:
    name = element.get("name", "")
    where = f"{path}: link {name!r}"
    mass = element.find("inertial/mass")
    value = None if mass is None else number(mass, "value", 0.0, where)
    if value is not None and not 0 <= value < math.inf:
        raise RobotError(f"{where}: mass {value} must be finite and >= 0; correct the URDF")
    inertia = element.find("inertial/inertia")
    inertial = False
    if inertia is not None:
        xx, yy, zz, xy, xz, yz = (
            number(inertia, key, 0.0, where) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        )
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if tensor.any() and (not np.isfinite(tensor).all() or np.linalg.eigvalsh(tensor)[0] <= 0):
            raise RobotError(
                f"{where}: no body has the inertia {dict(inertia.attrib)}, whose principal moments are not all > 0; "
                "correct the URDF"
            )
        inertial = bool(value) and bool(tensor.any())
    for part in element.findall("inertial") + element.findall("collision"):
        _check_origin(part, where)
    for shape in element.iterfind("collision/geometry/*"):
        for key, count in _SIZES.get(shape.tag, {}).items():
            if min(numbers(shape, key, count, where)) <= 0:
                raise RobotError(f"{where}: <{shape.tag} {key}={shape.get(key)!r}> must be > 0; correct the URDF")
    return Link(name, value, len(element.findall("collision")), inertial)


def _check_origin(element: etree._Element, where: str) -> None:
    origin = element.find("origin")
    if origin is not None:
        for key in ("xyz", "rpy"):
            if origin.get(key) is not None:
                numbers(origin, key, 3, where)


def _breadth_first(links: list[Link], joints: list[Joint], path: Path) -> Iterator[Joint]:
    """Joints level by level from the root, siblings in file order; raises unless they form one tree."""
    for kind, names in (("link", [link.name for link in links]), ("joint", [joint.name for joint in joints])):
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise RobotError(f"{path}: {kind} name used twice: {', '.join(sorted(twice))}; names must be unique")
    known = {link.name for link in links}
    for joint in joints:
        for link in (joint.parent_link, joint.child_link):
            if link not in known:
                raise RobotError(f"{path}: joint {joint.name!r} names the unknown link {link!r}; add the link")
    children = [joint.child_link for joint in joints]
    if twice := {name for name in children if children.count(name) > 1}:
        raise RobotError(f"{path}: link with two parents: {', '.join(sorted(twice))}; a robot must be a tree")
    roots = [link.name for link in links if link.name not in set(children)]
    if len(roots) != 1:
        raise RobotError(f"{path}: needs exactly one root link, found {roots or 'a loop'}; a robot must be one tree")
    seen = 0
    level = [roots[0]]
    while level:
        found = [joint for link in level for joint in joints if joint.parent_link == link]
        seen += len(found)
        yield from found
        level = [joint.child_link for joint in found]
    if seen != len(joints):
        raise RobotError(f"{path}: some joints form a loop apart from the root {roots[0]!r}; a robot must be one tree")
