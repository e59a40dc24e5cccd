r"""Robots as MuJoCo's models.

Each simulated link of the robot (rigid bodies, with fixed joints merged) is a body in the frame of
its joint. Masses and inertias come from the URDF, in double precision; meshes are convex hulls, as
in SAPIEN. A body whose links collide with another body in part has one body without mass for each
link with shapes, since MuJoCo excludes pairs of bodies.

MuJoCo does not compute damping and Coulomb friction: the loop applies them as efforts, in the same
way for every engine, with the damping's share dt d in the armature, which makes it implicit
(:mod:`batchpid.motors.friction`).

A robot of an MJCF file is the file's model (:mod:`batchpid.sim.engine.mujoco.file_scene`), in which
MuJoCo computes the damping of the file.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations, product
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Array, Document, Float64, MjModel, MjSpec
from batchpid.errors import RobotError
from batchpid.sim.description.tables import CONTACT_FRICTION, Joint, MjcfFile, unique
from batchpid.sim.engine.mujoco.file_scene import REMOVED, BodyFrame, file_scene, set_ground
from batchpid.sim.engine.mujoco.mujoco_sensors import add_link_sensors
from batchpid.sim.engine.scene_spec import MujocoSolver, SceneSpec
from batchpid.sim.geometry.shapes import add_geom
from batchpid.task_space.frames import SpatialInertia

FLOATING = 6
"""Degrees of freedom of a floating base, which come first in MuJoCo's arrays."""
LARGEST_FORCE = 1e10
"""Limit of a drive without a limit [N m or N]."""
_NARROWEST = 1e-9
"""Smallest range of a limited joint [rad or m]: MuJoCo requires a positive one."""
_HARD = (0.99, 0.999, 1e-4, 0.5, 2.0)
"""Impedance of joint limits (MuJoCo's solimp): nearly all of the acceleration that violates a limit
is cancelled.
"""
_NOT_KEPT = (
    mujoco.mjtEnableBit.mjENBL_SLEEP
    | mujoco.mjtEnableBit.mjENBL_ENERGY
    | mujoco.mjtEnableBit.mjENBL_FWDINV
)
"""Parts that a file cannot enable: a snapshot does not hold what sleeps, and nobody reads the
others.
"""
_SPARSE_FROM = 18
"""Number of velocities from which on a sparse Jacobian is faster: measured on robots that stand."""
_INFINITE_LIMIT = 1e10
"""Limit in place of an infinite one on one side [rad or m]."""


@dataclass(frozen=True, eq=False)
class RobotMj:
    """Compiled model of a robot, and the indices of its joints in MuJoCo's arrays."""

    model: MjModel
    """``mujoco.MjModel``; it is shared, so copy it before a change."""
    joints: tuple[Joint, ...]
    qpos: NDArray[np.intp]
    """Index of each joint in MuJoCo's qpos (dof,)."""
    qvel: NDArray[np.intp]
    """Index of each joint in MuJoCo's qvel (dof,)."""
    bodies: dict[str, int]
    """Number of the body of each simulated link."""
    terms: Array = (0.0, 0.0)
    """Armature and damping (2, dof) of the joints in addition to the description and the motors."""
    frames: Mapping[str, BodyFrame] = field(default_factory=dict)
    """Frames of simulated links in their bodies, in an MJCF file; of other links the frames are
    the same.
    """
    base: tuple[int, int] = (0, 0)
    """Index of a floating base in MuJoCo's qpos and qvel."""


@lru_cache(maxsize=8)
def robot_model(spec: SceneSpec) -> RobotMj:
    """Return the model of ``spec``, the same object for equal specs.

    Raises
    ------
    RobotError
        MuJoCo's compiler refuses the description, or a mesh cannot be read.
    """
    if spec.mjcf is not None:
        return _file_model(spec, spec.mjcf)
    scene, names = robot_spec(spec)
    if spec.drives:
        _add_drives(scene, spec)
    try:
        model = scene.compile()
    except ValueError as error:
        raise _refusal(error) from error
    bodies = {link: model.body(name).id for link, name in names.items()}
    for row in spec.simulated.bodies:  # the compiler refuses some inertias that both simulate
        model.body_inertia[bodies[row.name]], _ = row.spatial_inertia.principal
    mujoco.mj_setConst(model, mujoco.MjData(model))
    _choose_solver(model)
    return RobotMj(model, spec.joints, *_places(model, spec), bodies)


def _places(model: MjModel, spec: SceneSpec) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of the joints in MuJoCo's qpos and qvel."""
    joints = [model.joint(joint.name) for joint in spec.joints]
    qpos, qvel = (
        np.array([getattr(joint, name)[0] for joint in joints]) for name in ("qposadr", "dofadr")
    )
    return qpos, qvel


def _file_model(spec: SceneSpec, file: MjcfFile) -> RobotMj:
    """Return the model of a file, with the damping of the robot's joints, and without their
    friction and motors.
    """
    scene, names, frames, root, terms = file_scene(spec, file)
    off = mujoco.mjtDisableBit
    option = scene.option
    option.disableflags &= ~(
        off.mjDSBL_GRAVITY | off.mjDSBL_ACTUATION | off.mjDSBL_CLAMPCTRL | off.mjDSBL_SENSOR
    )
    option.enableflags &= ~_NOT_KEPT
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    _set_options(scene, spec)
    if not spec.collisions:
        option.disableflags |= off.mjDSBL_CONTACT
    set_ground(scene, spec.ground)
    add_link_sensors(scene, spec, names, frames)
    if spec.drives:
        _add_drives(scene, spec)
    try:
        model = scene.compile()
    except ValueError as error:
        problem = f"MuJoCo cannot compile the scene: {' '.join(str(error).split())}"
        remedy = f"correct it; nothing may refer to {', '.join(REMOVED)}, which are left out"
        raise RobotError(f"{file.path}: {problem}; {remedy}") from error
    qpos, qvel = _places(model, spec)
    armature, damping = terms
    model.dof_armature[qvel] = np.maximum(armature, 0.0)
    model.dof_frictionloss[qvel] = 0.0
    model.dof_damping[qvel] = np.maximum(damping + [joint.damping for joint in spec.joints], 0.0)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    base = 0, 0
    if root:
        joint = model.joint(model.body(root).jntadr[0])
        base = int(joint.qposadr[0]), int(joint.dofadr[0])
    bodies = {link: model.body(name).id for link, name in names.items()}
    return RobotMj(
        model,
        spec.joints,
        qpos,
        qvel,
        bodies,
        terms,
        frames,
        base,
    )


def robot_spec(spec: SceneSpec) -> tuple[MjSpec, dict[str, str]]:
    """Return the ``mujoco.MjSpec`` of ``spec``, and the name of the body of each simulated link.

    The inertia tensors of the bodies are placeholders.

    Raises RobotError if MuJoCo refuses a part of the robot.
    """
    scene = mujoco.MjSpec()
    off = mujoco.mjtDisableBit
    _set_options(scene, spec)
    scene.option.disableflags |= off.mjDSBL_SPRING | off.mjDSBL_DAMPER
    scene.compiler.fusestatic = False
    scene.compiler.degree = False
    try:
        names = _add_links(scene, spec)
        if spec.collisions:
            _add_shapes(scene, spec, names)
        add_link_sensors(scene, spec, names, {})
    except ValueError as error:
        raise _refusal(error) from error
    return scene, names


def _refusal(error: ValueError) -> RobotError:
    return RobotError(
        f"MuJoCo cannot build the robot: {' '.join(str(error).split())}; correct the URDF"
    )


def principal_inertia(inertia: SpatialInertia) -> tuple[Float64, Float64]:
    """Return principal moments (3,) [kg m^2] and the rotation of the principal axes (4,), in the
    axes of the body.
    """
    moments, axes = inertia.principal
    wxyz = np.empty(4)
    mujoco.mju_mat2Quat(wxyz, axes.ravel())
    return moments, wxyz


def _set_options(scene: MjSpec, spec: SceneSpec) -> None:
    solver: MujocoSolver = spec.physics
    option, off = scene.option, mujoco.mjtDisableBit
    option.timestep = spec.timestep
    option.gravity = spec.gravity
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.iterations = solver.iterations
    option.tolerance = solver.tolerance
    cones = mujoco.mjtCone
    option.cone = cones.mjCONE_ELLIPTIC if solver.elliptic else cones.mjCONE_PYRAMIDAL
    # A diverged env must stay visible: the loop suspends or resets it, and reports it.
    option.disableflags |= off.mjDSBL_AUTORESET | off.mjDSBL_ACTUATION


def _choose_solver(model: MjModel) -> None:
    """Choose the fastest form of MuJoCo's solver for one robot, which changes its motion by
    rounding alone.

    MuJoCo updates a factor of the Hessian for each contact and iteration. By default it is sparse
    from 60 velocities on.
    """
    if model.nv >= _SPARSE_FROM:
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    # The contacts of one robot form one island, so the search for islands only takes time.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND


def _add_links(scene: MjSpec, spec: SceneSpec) -> dict[str, str]:
    """Add the simulated bodies of ``spec``; return MuJoCo's name of each."""
    rows = spec.simulated.bodies
    names = {row.name: row.name for row in rows}
    if "world" in names:
        names["world"] = unique("world_link", {*names})
    for row in rows:
        parent = scene.worldbody
        if row.joint is not None:
            parent = scene.body(names[row.joint.parent_link])
        moments, axes = principal_inertia(row.spatial_inertia)
        body = parent.add_body(
            name=names[row.name],
            pos=row.position,
            quat=row.wxyz,
            mass=row.mass,
            ipos=row.center,
            iquat=axes,
            inertia=np.full(3, max(moments.max(), 1e-12)),  # replaced after compilation
            explicitinertial=True,
        )
        if row.joint is None and not spec.fixed_base:
            body.add_freejoint()
        elif row.joint is not None and row.joint.moves:
            joint = next(joint for joint in spec.joints if joint.name == row.joint.name)
            _add_joint(body, joint, spec)
    return names


def _add_joint(body: Any, joint: Joint, spec: SceneSpec) -> None:
    """Add a degree of freedom to a body."""
    ends = np.array([joint.lower, joint.upper])
    lower, upper = np.clip(ends, -_INFINITE_LIMIT, _INFINITE_LIMIT)
    body.add_joint(
        name=joint.name,
        type=getattr(mujoco.mjtJoint, f"mjJNT_{'SLIDE' if joint.unit == 'm' else 'HINGE'}"),
        axis=np.array(joint.axis) / np.linalg.norm(joint.axis),
        limited=not joint.continuous and bool(np.isfinite(ends).any()),
        range=[lower, max(upper, lower + _NARROWEST)],
        solref_limit=[2 * spec.timestep, 1.0],  # the hardest that MuJoCo simulates
        solimp_limit=_HARD,
        armature=spec.timestep * joint.damping,
    )


def _add_shapes(scene: MjSpec, spec: SceneSpec, names: dict[str, str]) -> None:
    """Add the collision shapes, the pairs of bodies that do not collide, and the ground."""
    owners: dict[str, list[str]] = defaultdict(list)
    for shape in spec.simulated.shapes:
        if shape.owner not in owners[shape.body]:
            owners[shape.body].append(shape.owner)
    ignored = {frozenset(pair) for pair in spec.ignored}
    solid = [*owners]
    split = set[str]()
    for first, second in combinations(solid, 2):
        pairs = [frozenset(pair) in ignored for pair in product(owners[first], owners[second])]
        if any(pairs) and not all(pairs):
            # MuJoCo excludes whole bodies, so these get one for each link with shapes.
            split |= {first, second}
    bodies = {owner: names[link] for link in solid for owner in owners[link]}
    taken = {"world", *names.values()}
    for link in split:
        for owner in owners[link]:
            bodies[owner] = unique(f"{owner} (shapes)", taken)
            scene.body(names[link]).add_body(name=bodies[owner])
    pairs_of_bodies = {
        frozenset(bodies[owner] for owner in pair) for pair in ignored if pair <= set(bodies)
    }
    for first, second in sorted(sorted(pair) for pair in pairs_of_bodies if len(pair) == 2):
        scene.add_exclude(bodyname1=first, bodyname2=second)
    for shape in spec.simulated.shapes:
        add_geom(scene, scene.body(bodies[shape.owner]), shape, mass=0.0, **_contact(spec))
    if spec.ground:
        scene.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 1],
            **_contact(spec),
        )


def _add_drives(scene: MjSpec, spec: SceneSpec) -> None:
    """Add an actuator for each joint, in their order: effort = ctrl + bias (1, q, q'), between its
    limits.
    """
    scene.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    scene.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for joint in spec.joints:
        actuator = scene.add_actuator(
            name=joint.name,
            target=joint.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
        )
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        # The limit of the drive replaces this one later.
        actuator.forcelimited = True
        actuator.forcerange = [-LARGEST_FORCE, LARGEST_FORCE]


def _contact(spec: SceneSpec) -> Document:
    return {
        "friction": [CONTACT_FRICTION, 0.005, 0.0001],
        "solref": [spec.physics.contact_time, 1.0],
    }


def set_inertia(
    model: MjModel,
    robot: RobotMj,
    link: str,
    inertia: SpatialInertia,
) -> None:
    """Give a simulated link in a ``mujoco.MjModel`` this inertia, in the link's frame;
    ``mj_setConst`` comes next.
    """
    body = robot.bodies[link]
    welded = tuple[int, ...]()
    if link in robot.frames:
        position, turn, welded = robot.frames[link]
        inertia = inertia.moved(position, turn)
    moments, wxyz = principal_inertia(inertia)
    model.body_mass[body] = inertia.mass
    model.body_ipos[body] = inertia.center
    model.body_iquat[body] = wxyz
    model.body_inertia[body] = moments
    model.body_mass[[*welded]] = 0.0
    model.body_inertia[[*welded]] = 0.0
    # Without the compiler's shortcuts for centers of mass at the body's origin, and bodies that are
    # moved by one joint.
    model.body_sameframe[body] = 0
    model.body_simple[body] = 0
    model.dof_simplenum[:] = 0
