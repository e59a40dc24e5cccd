"""Compilation of an MJCF file by MuJoCo, without the geoms that add neither shape nor mass, and
without missing meshes.

MuJoCo refuses a file that names a mesh that is missing or cannot be read. A geom of that mesh can
be left out only if the mass of its body does not depend on it.

The bodies and joints of the model get the names of the links and joints that they become.
"""

from __future__ import annotations

import math
import re
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import mujoco

from batchpid.arrays.array_types import MjModel, MjSpec
from batchpid.errors import RobotError
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.meshes import LFS_PROBLEM
from batchpid.sim.robot.xml import LFS_POINTER, parse_xml

_ERRORS = (ValueError, mujoco.FatalError)
"""Errors of MuJoCo's parser and compiler."""


if (
    mujoco.get_mju_user_warning() is None
):  # else MuJoCo appends warnings to a file in the working folder, too
    mujoco.set_mju_user_warning(lambda message: print(f"MuJoCo: {message}", file=sys.stderr))


class Attempt(NamedTuple):
    """Model of a file, or None with MuJoCo's reason; collision meshes whose geoms are left out,
    with the reason.

    ``scene`` is the ``mujoco.MjSpec`` that was compiled, ``is_whole`` says whether the whole file
    was. ``weighing`` are the bodies whose mass depends on a geom that is left out, each with the
    mesh.
    """

    scene: MjSpec
    model: MjModel
    is_whole: bool
    missing: tuple[str, ...] = ()
    weighing: tuple[tuple[str, str], ...] = ()
    problem: str = ""


def compile_file(
    path: Path, fixed_base: bool, missing_meshes: str, findings: list[Finding]
) -> Attempt:
    """Return the compiled model of a file, with the collision meshes that it is without.

    Raises RobotError if MuJoCo refuses the file, a missing mesh has an unknown mass, or missing
    meshes are refused.
    """
    lean = attempt(
        path, fixed_base, False
    )  # without geoms that are only drawn: their meshes take time to read
    if lean.model is not None and not lean.missing and not lean.weighing:
        return lean
    whole = attempt(
        path, fixed_base, True
    )  # something may refer to a removed geom, and a missing file be elsewhere
    if whole.model is not None:
        return whole
    if lean.weighing:
        listed = ", ".join(f"mesh {mesh} of body {body!r}" for mesh, body in lean.weighing)
        remedy = (
            "restore the file, or give the body an <inertial>, with which the mesh may be missing"
        )
        remedy += ' (unless inertiafromgeom is "true")'
        raise RobotError(
            f"{path}: the mass of a body is unknown without its mesh: {listed}; {remedy}"
        )
    names = ", ".join(lean.missing)
    if names and missing_meshes == "error":
        remedy = "restore the files, or pass missing_meshes='skip' to simulate without"
        raise RobotError(f"{path}: collision mesh not found: {names}; {remedy}")
    if lean.model is None:
        raise RobotError(_refusal(path, whole.problem))
    text = f"collision meshes not found, simulated without: {names}"
    findings.append(
        Finding("warning", "missing-mesh", text, "put the files where the MJCF names them")
    )
    return lean


def attempt(path: Path, fixed_base: bool, is_whole: bool) -> Attempt:
    """Return a compilation of the whole file, or without geoms that are only drawn and geoms of
    missing meshes.
    """
    left_out: tuple[Any, Any] = (), ()
    scene = None
    try:
        scene = mujoco.MjSpec.from_file(str(path))
        if not is_whole:
            left_out = _strip(scene, path, fixed_base)
        return Attempt(scene, scene.compile(), is_whole, *left_out)
    except _ERRORS as error:
        return Attempt(scene, None, is_whole, *left_out, " ".join(str(error).split()))


def _strip(
    spec: Any, path: Path, fixed_base: bool
) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Remove textures, geoms that add neither shape nor mass, and those of missing meshes; return
    the latter.
    """
    # A <pair> makes geoms collide whatever their masks say.
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    absent = {}
    for mesh in spec.meshes:
        folder = path.parent / (getattr(mesh, "compiler", spec).meshdir or "")
        if spec.strippath:
            file = Path(mesh.file).name
        else:
            file = mesh.file
        if mesh.file and (problem := _missing(folder / file)):
            absent[mesh.name] = f"{mesh.file} ({problem})"
    missing: dict[str, None] = {}
    weighing: dict[tuple[str, str], None] = {}
    used: set[str] = set()
    for geom in list(spec.geoms):
        # A texture that is missing would stop the compilation.
        geom.material = ""
        drawn_only = not (geom.contype | geom.conaffinity) and geom.name not in paired
        weighs = _weighs(spec, geom)
        if geom.meshname in absent and weighs and (not fixed_base or _moves(geom.parent)):
            weighing[absent[geom.meshname], geom.parent.name] = None
        elif geom.meshname in absent and not drawn_only:
            missing[absent[geom.meshname]] = None
        if drawn_only and not weighs:
            spec.delete(geom)
        elif geom.meshname in absent:  # something may refer to it
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
            geom.size = [1e-3, 0, 0]
            geom.meshname = ""
            geom.contype = 0
            geom.conaffinity = 0
            geom.mass = 0.0
            for pair in [
                element
                for element in spec.pairs
                if geom.name in (element.geomname1, element.geomname2) and geom.name
            ]:
                spec.delete(pair)
        elif geom.meshname:
            used.add(geom.meshname)
    for site in spec.sites:
        site.material = ""
    for element in [
        *spec.materials,
        *spec.textures,
        *(mesh for mesh in spec.meshes if mesh.name not in used),
    ]:
        spec.delete(element)
    return tuple(missing), tuple(weighing)


def _weighs(spec: Any, geom: Any) -> bool:
    """Return whether the mass of a geom's body depends on the geom."""
    inferred = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    low, high = spec.compiler.inertiagrouprange
    # A geom adds no mass by its own mass, by its density, or by its group.
    weightless = (
        geom.mass == 0
        or (math.isnan(geom.mass) and geom.density == 0)
        or not low <= geom.group <= high
    )
    return (
        (inferred or not geom.parent.explicitinertial)
        and not weightless
        and geom.parent.parent is not None
    )


def _moves(body: Any) -> bool:
    """Return whether a joint moves the body."""
    while body is not None and not len(body.joints):
        body = body.parent
    return body is not None


def _missing(path: Path) -> str | None:
    """Return the reason for which no program can read a mesh; None for other meshes."""
    try:
        with open(path, "rb") as file:
            if file.read(len(LFS_POINTER)) == LFS_POINTER:
                return LFS_PROBLEM
            return None
    except OSError as error:
        if isinstance(error, FileNotFoundError):
            return "not found"
        return f"cannot be read: {error.strerror}"


def _refusal(path: Path, problem: str) -> str:
    """Return the message for a file that MuJoCo refuses."""
    included = [element.get("file", "") for element in parse_xml(path).iter("{*}include")]
    for name in (*re.findall(r"'([^']+)'", problem), *included):
        with suppress(OSError, ValueError):
            if _missing(path.parent / name) == LFS_PROBLEM:
                return f"{path}: {name} is a git-lfs pointer instead of the file; run git lfs pull"
    if "opening file" in problem:
        remedy = "restore the file"
    else:
        remedy = "correct it"
    return f"{path}: MuJoCo cannot compile the file: {problem}; {remedy}"


ALONE = "engine 'mujoco' alone simulates"
"""First words of the findings for elements without equivalent in a URDF."""
MOVING = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
"""Types of joints with one degree of freedom."""


def label(element: Any) -> str:
    """Return the quoted name of an element of a model, or its number if it has none."""
    return repr(element.name or f"number {element.id}")


class Names:
    """Names of the ``bodies`` and of the hinges and slides among the ``joints``, by their numbers
    in the model.

    A body or joint without a name gets one of its number. :meth:`leave_out` removes the joints of
    other objects.
    """

    def __init__(self, model: MjModel) -> None:
        self._types = model.jnt_type
        self._bodies = model.jnt_bodyid
        self._roots = model.body_rootid
        self._left_out: set[int] = set()
        names = [model.body(body).name for body in range(1, model.nbody)]
        self._links, self._joints = (
            {"world", *names},
            {model.joint(joint).name for joint in range(model.njnt)},
        )
        self.bodies = {0: "world"}
        self.bodies |= {
            body: name or self.new_link(f"body{body}") for body, name in enumerate(names, start=1)
        }
        self.joints = {
            joint: model.joint(joint).name or self.new_joint(f"joint{joint}")
            for joint in range(model.njnt)
            if int(model.jnt_type[joint]) in MOVING
        }

    def is_slide(self, joint: int) -> bool:
        """Return whether a joint is a slide, not a hinge."""
        return bool(self._types[joint] == mujoco.mjtJoint.mjJNT_SLIDE)

    def leave_out(self, bodies: set[int]) -> None:
        """Remove the joints of ``bodies``, children of the world, and of the bodies below them."""
        self._left_out = bodies
        self.joints = {
            joint: name
            for joint, name in self.joints.items()
            if self.is_of_robot(self._bodies[joint])
        }

    def is_of_robot(self, body: Any) -> bool:
        """Return whether a body, or the world, was kept: neither left out nor below a body that was
        left out.
        """
        return int(self._roots[body]) not in self._left_out

    def new_link(self, name: str) -> str:
        """Return ``name``, with a number if a link has it."""
        return _new(name, self._links)

    def new_joint(self, name: str) -> str:
        """Return ``name``, with a number if a joint has it."""
        return _new(name, self._joints)


def _new(name: str, taken: set[str]) -> str:
    new, number = name, 2
    while new in taken:
        new = f"{name}_{number}"
        number = number + 1
    taken.add(new)
    return new
