"""MJCF file as a model of MuJoCo, and the robot in it.

Geoms that add neither shape nor mass are not compiled, so their meshes and textures may be missing.
A collision mesh may be missing if the mass of its body does not depend on it.

The bodies and joints of the model get the names of the links and joints that they become.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from batchpid.arrays.array_types import Float64, MjModel, MjSpec
from batchpid.arrays.trees import digest
from batchpid.errors import RobotError
from batchpid.sim.findings import Finding, Notes
from batchpid.sim.robot.tables import unique

PLANE = mujoco.mjtGeom.mjGEOM_PLANE
_PREFIXES = (
    "body_",
    "jnt_",
    "dof_",
    "geom_",
    "pair_",
    "exclude_",
    "eq_",
    "tendon_",
    "hfield_",
    "qpos",
    "key_",
    "site_",
    "wrap_",
    "mesh_vert",
    "flex",
    "plugin_",
)
"""Beginnings of the names of the model's arrays that the simulation depends on."""
_FREE, _BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL

# Without a handler MuJoCo appends warnings to a file in the working folder, too.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(lambda message: print(f"MuJoCo: {message}", file=sys.stderr))


class Compiled(NamedTuple):
    """Model of a file, and the ``mujoco.MjSpec`` that was compiled.

    ``is_whole`` says whether it has the geoms that are only drawn, ``missing`` are the files of
    collision meshes that it is without.
    """

    scene: MjSpec
    model: MjModel
    is_whole: bool
    missing: tuple[str, ...]

    @property
    def content(self) -> str:
        """Digest of the elements that move, collide or act."""
        model = self.model
        names = [name for name in dir(model) if name.startswith(_PREFIXES)]
        arrays = {name: _rounded(np.asarray(getattr(model, name), float)) for name in names}
        return digest(arrays, model.names, str(model.opt))


def _rounded(values: Float64) -> Float64:
    """Return ``values`` to nine digits: the last bits may differ between kinds of processors."""
    # What cancels out leaves a rest of rounding.
    shares, exponents = np.frexp(np.where(np.abs(values) < 1e-12, 0.0, values))
    rounded: Float64 = np.ldexp(np.round(shares, 9), exponents)
    return rounded


def compile_file(path: Path, missing_meshes: str, findings: list[Finding]) -> Compiled:
    """Return the compiled model of a file.

    Raises RobotError if MuJoCo refuses the file, or missing meshes are refused.
    """
    lean = None
    try:
        lean = compile_scene(path, is_whole=False)
        if not lean.missing:
            return lean
        return compile_scene(path, is_whole=True)
    except RobotError:
        # Something may refer to a geom that is only drawn.
        if lean is None:
            return compile_scene(path, is_whole=True)
        if missing_meshes == "error":
            raise
    text = f"collision meshes not found, simulated without: {', '.join(lean.missing)}"
    remedy = "put the files where the MJCF names them"
    findings.append(Finding("missing-mesh", text, remedy))
    return lean


def compile_scene(path: Path, is_whole: bool) -> Compiled:
    """Return the compilation of the whole file, or of its collision shapes and masses.

    Raises RobotError if MuJoCo refuses it.
    """
    missing: tuple[str, ...] = ()
    # MuJoCo takes a file of the same name, size and second for the one that it has read.
    mujoco.mj_clearCache(mujoco.mj_getCache())
    try:
        scene = mujoco.MjSpec.from_file(str(path))
        if not is_whole:
            missing = _strip(scene, path)
        return Compiled(scene, scene.compile(), is_whole, missing)
    except (ValueError, mujoco.FatalError) as error:
        problem = " ".join(str(error).split())
        raise RobotError(
            f"{path}: MuJoCo cannot compile the file: {problem}; correct it, or restore the file"
            " that it names, e.g. by git lfs pull"
        ) from error


def _strip(spec: Any, path: Path) -> tuple[str, ...]:
    """Remove materials, geoms that add neither shape nor mass, and collision shapes of missing
    meshes; return the files of the latter.
    """
    # A <pair> makes geoms collide whatever their masks say.
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    absent = {}
    for mesh in spec.meshes:
        folder = path.parent / (mesh.compiler.meshdir or "")
        file = Path(mesh.file).name if spec.strippath else mesh.file
        if mesh.file and not (folder / file).is_file():
            absent[mesh.name] = mesh.file
    missing: dict[str, None] = {}
    used: set[str] = set()
    for geom in list(spec.geoms):
        # A texture that is missing would stop the compilation.
        geom.material = ""
        is_solid = geom.contype or geom.conaffinity or geom.name in paired
        # A missing mesh that weighs stays, and MuJoCo refuses it.
        if _weighs(spec, geom) or (is_solid and geom.meshname not in absent):
            used.add(geom.meshname)
            continue
        if is_solid:
            missing[absent[geom.meshname]] = None
        for pair in list(spec.pairs):
            if geom.name in (pair.geomname1, pair.geomname2):
                spec.delete(pair)
        spec.delete(geom)
    for site in spec.sites:
        site.material = ""
    unused = [mesh for mesh in spec.meshes if mesh.name not in used]
    for element in [*spec.materials, *spec.textures, *unused]:
        spec.delete(element)
    return tuple(missing)


def _weighs(spec: Any, geom: Any) -> bool:
    """Return whether the mass of a geom's body depends on the geom."""
    body = geom.parent
    always = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    if body.explicitinertial and spec.compiler.inertiafromgeom != always:
        return False
    if geom.mass == 0 or (math.isnan(geom.mass) and geom.density == 0):
        return False
    low, high = spec.compiler.inertiagrouprange
    return bool(low <= geom.group <= high) and body.parent is not None


def label(element: Any) -> str:
    """Return the quoted name of an element of a model, or its number if it has none."""
    return repr(element.name or f"number {element.id}")


def can_collide(model: MjModel, geom: int) -> bool:
    """Return whether a geom collides with anything, by its masks or in a ``<pair>``."""
    paired = geom in model.pair_geom1 or geom in model.pair_geom2
    return bool(model.geom_contype[geom] | model.geom_conaffinity[geom]) or paired


class RobotInFile:
    """Robot of a compiled file: names of its parts, by their numbers in the model.

    ``bodies`` has all bodies of the file, ``joints`` the hinges and slides of the robot, ``base``
    is the body of the root, 0 for the world. ``link_names`` and ``joint_names`` are all names in
    use.

    Raises RobotError for a ball joint, and for several robots.
    """

    def __init__(self, model: MjModel, path: Path, notes: Notes) -> None:
        names = [model.body(body).name for body in range(1, model.nbody)]
        self.link_names = {"world", *names}
        self.joint_names = {model.joint(joint).name for joint in range(model.njnt)}
        self.bodies = {0: "world"}
        for body, name in enumerate(names, start=1):
            self.bodies[body] = name or unique(f"body{body}", self.link_names)
        self._roots = model.body_rootid
        self._left_out: set[int] = set()
        joints = {
            joint: model.joint(joint).name or unique(f"joint{joint}", self.joint_names)
            for joint in range(model.njnt)
            if int(model.jnt_type[joint]) not in (_FREE, _BALL)
        }
        self.base = self._find_base(model, joints, path, notes)
        self.joints = {
            joint: name
            for joint, name in joints.items()
            if self.is_of_robot(model.jnt_bodyid[joint])
        }

    def is_of_robot(self, body: int) -> bool:
        """Return whether a body, or the world, is of the robot."""
        return int(self._roots[body]) not in self._left_out

    def _find_base(
        self,
        model: MjModel,
        joints: dict[int, str],
        path: Path,
        notes: Notes,
    ) -> int:
        """Return the base, after the bodies that are not of the robot are left out."""
        # Every child of the world is the root of an object; some of them are the robot.
        tops = {body for body in range(1, model.nbody) if model.body_parentid[body] == 0}
        roots = model.body_rootid[model.jnt_bodyid]
        free = {int(root) for root in roots[model.jnt_type == _FREE]}
        balls = {int(root) for root in roots[model.jnt_type == _BALL]}
        moving = {int(roots[joint]) for joint in joints}
        # A flexible body has three slides for each vertex.
        soft = {int(body) for body in model.flex_vertbodyid if not model.body_geomnum[body]} & tops
        moving -= soft
        if driven := moving & _roots_of_actuators(model):
            moving -= (moving & free) - driven
        floating = moving & free
        if len(floating) > 1 or (floating and moving - free):
            listed = ", ".join(repr(self.bodies[body]) for body in sorted(moving))
            raise RobotError(
                f"{path}: holds several robots, {listed}; leave one of them in the file"
            )
        mocaps = {body for body in tops if model.body_mocapid[body] >= 0}
        self._left_out = mocaps | soft | (free - moving)
        if moving:
            self._left_out |= balls - moving
        # A robot on a free joint is one object; all others are scenery.
        if floating:
            self._left_out |= tops - floating
        for joint in np.flatnonzero(model.jnt_type == _BALL).tolist():
            body = int(model.jnt_bodyid[joint])
            if self.is_of_robot(body):
                where = f"{path}: body {self.bodies[body]!r}"
                problem = f"the ball joint {label(model.joint(joint))} has no single position"
                raise RobotError(f"{where}: {problem} to control; replace it by three hinges")
        for body in sorted(self._left_out - soft):
            text = "is apart from the robot: left out"
            notes.lose(text, link=self.bodies[body])
        if floating:
            return floating.pop()
        # The only body, if it is held at the origin, is the root in place of the world.
        only, *others = sorted(tops - self._left_out) or [0]
        pose = [*model.body_pos[only], *model.body_quat[only]]
        if others or model.body_jntnum[only] or pose != [0, 0, 0, 1, 0, 0, 0]:
            return 0
        for geom in np.flatnonzero(model.geom_bodyid == 0).tolist():
            if model.geom_type[geom] != PLANE and can_collide(model, geom):
                return 0
        return only


def _roots_of_actuators(model: MjModel) -> set[int]:
    """Return the children of the world that actuators move, themselves or bodies below them."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    dofs = data.moment_colind[: data.moment_rownnz.sum()]
    return {int(body) for body in model.body_rootid[model.dof_bodyid[dofs]]}
