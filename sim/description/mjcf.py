"""Reader of MJCF files: MuJoCo compiles them, and the model becomes tables, motors and a start
pose.

Geoms that are only drawn are not compiled: their textures may be missing, and their meshes in
bodies with ``<inertial>``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from batchpid.arrays.array_types import Float64, MjModel, MjSpec
from batchpid.arrays.elementwise import read_only
from batchpid.arrays.trees import digest
from batchpid.errors import RobotError
from batchpid.motors import make_actuators
from batchpid.sim.description.mjcf_bodies import (
    PLANE,
    RobotInFile,
    can_collide,
    excluded_pairs,
    label,
)
from batchpid.sim.description.mjcf_motors import Couplings, read_couplings, read_motors
from batchpid.sim.description.tables import MjcfFile, Source
from batchpid.sim.findings import Finding
from batchpid.task_space.rigid_tree import GRAVITY

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
_KEYFRAME = "home"
"""Keyframe with the start pose."""
_SWITCHES = (
    "CONTACT",
    "LIMIT",
    "EQUALITY",
    "FRICTIONLOSS",
    "DAMPER",
    "CONSTRAINT",
)
"""Parts of MuJoCo's physics that a file can disable."""
_OF_TENDONS = (
    "stiffness",
    "stiffnesspoly",
    "damping",
    "dampingpoly",
    "frictionloss",
    "armature",
    "limited",
)
"""Effects of a tendon by itself."""

# Without a handler MuJoCo appends warnings to a file in the working folder, too.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(lambda message: print(f"MuJoCo: {message}", file=sys.stderr))


def read_mjcf(
    path: Path,
    name: str,
    findings: list[Finding],
    fixed_base: bool | None,
) -> Source:
    """Return the content of the MJCF file at ``path`` as the robot ``name``, with ``findings`` of
    reading the file.

    For the other arguments see :meth:`batchpid.sim.Robot.load`. Raises RobotError if MuJoCo refuses
    the file, or it has a ball joint or several robots.
    """
    # MuJoCo opens the file by its path, and workers do so again.
    if not path.is_file():
        raise RobotError(f"{path}: an MJCF file is read several times; save it as a file first")
    compiled = compile_scene(path)
    model = compiled.model
    robot = RobotInFile(model, path, findings)
    # A base is free where the file has a free joint, unless the caller fixes it.
    if fixed_base is None:
        fixed_base = not robot.base
    couplings = read_couplings(robot)
    motors = read_motors(robot, couplings)
    tables = robot.read(couplings, motors, is_held=fixed_base)
    _report_ignored(robot)
    # The start pose is that of the keyframe, else the reference pose.
    key = home(model)
    pose = model.qpos0 if key is None else model.key_qpos[key]
    base_start = None
    if robot.base and not fixed_base:
        at = model.jnt_qposadr[model.body_jntadr[robot.base]]
        base_start = tuple(pose[at : at + 7].tolist())
    numbers = {name: joint for joint, name in robot.joints.items()}
    order = [numbers[joint.name] for joint in tables.joints if joint.moves]

    def column(values: Float64) -> Float64:
        return read_only(values[order].astype(np.float64))

    actuators = None
    if order:
        actuators = make_actuators(len(order), armature=column(motors.armature))
    gains = {"kp": column(motors.kp), "kd": column(motors.kd)}
    return Source(
        path,
        name,
        tables,
        tuple(findings),
        fixed_base,
        base_start,
        column(pose[model.jnt_qposadr]),
        # A file of motors alone has no gains to offer.
        gains if (motors.kp + motors.kd).any() else None,
        mjcf=_file(path, compiled, robot, fixed_base, _lost(robot, couplings, len(tables.shapes))),
        disabled=excluded_pairs(model, robot.solid),
        actuators=actuators if actuators is not None and actuators.num_joints else None,
    )


def home(model: MjModel) -> int | None:
    """Return the number of the keyframe with the start pose, None without one."""
    return next((key for key in range(model.nkey) if model.key(key).name == _KEYFRAME), None)


def _file(
    path: Path,
    compiled: Compiled,
    robot: RobotInFile,
    fixed_base: bool,
    lost: str,
) -> MjcfFile:
    """Return the data of the file that the engine MuJoCo needs."""
    model = compiled.model
    # Loops between links, which MuJoCo closes and a tree cannot have.
    loops = []
    for equality in np.flatnonzero(model.eq_active0).tolist():
        at = [model.eq_obj1id[equality], model.eq_obj2id[equality]]
        closes = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
        if int(model.eq_type[equality]) not in closes:
            continue
        if model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
            at = model.site_bodyid[at]
        if all(robot.is_of_robot(body) for body in at):
            loops.append(label(model.equality(equality)))
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE].tolist()
    planes = (model.geom_bodyid == 0) & (model.geom_type == PLANE)
    grounds = np.flatnonzero(planes & can_collide(model)).tolist()
    floats = any(robot.is_of_robot(body) for body in free)
    return MjcfFile(
        path=str(path),
        content=compiled.content,
        bodies=tuple(robot.bodies.values()),
        falling=tuple(robot.bodies[body] for body in free if not robot.is_of_robot(body)),
        loops=tuple(loops),
        lost=lost,
        is_alone=all(robot.is_of_robot(body) for body in model.jnt_bodyid),
        has_floor=bool(grounds) and not (floats and fixed_base),
        friction=float(model.geom_friction[grounds[0], 0]) if grounds else 1.0,
    )


def _report_ignored(robot: RobotInFile) -> None:
    """Report content that no engine simulates, apart from motors."""
    model, option = robot.model, robot.model.opt
    ignored = [
        f"<flag {name.lower()}>" for name in ("ACTUATION", "GRAVITY") if _is_off(option, name)
    ]
    if tuple(option.gravity) != GRAVITY:
        ignored.append("gravity")
    ignored += [
        f"gravcomp of {robot.bodies[body]!r}"
        for body in np.flatnonzero(model.body_gravcomp).tolist()
        if robot.is_of_robot(body)
    ]
    if ignored:
        text = f"has no effect, gravity is {GRAVITY} m/s^2: {', '.join(ignored)}"
        remedy = "let the controller compensate, or use Randomization(gravity=...)"
        robot.repairs.append(Finding("option", text, remedy))


def _is_off(option: Any, name: str) -> bool:
    return bool(option.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))


def _lost(robot: RobotInFile, couplings: Couplings, shapes: int) -> str:
    """Return the content that is missing in an engine which does not simulate the file, apart from
    the robot's motors, ``couplings`` and ``shapes``.
    """
    model, option = robot.model, robot.model.opt
    joints = list(robot.joints)
    dofs = model.jnt_dofadr[joints]
    # A level plane at height 0 is the ground of the engines.
    poses = np.column_stack([model.geom_pos[:, 2], model.geom_quat[:, 1:3]])
    of_world = model.geom_bodyid == 0
    grounds = of_world & (model.geom_type == PLANE) & ~poses.any(1)
    of_robot = np.array([robot.is_of_robot(body) for body in model.geom_bodyid], bool)
    solid = can_collide(model) & (of_robot | of_world) & ~grounds
    counts: dict[str, Any] = {
        "bodies apart from the robot": len(robot.left_out),
        "equality constraints": model.eq_active0.sum() - len(couplings),
        "tendons": sum(
            any(np.any(getattr(model, f"tendon_{name}")[tendon]) for name in _OF_TENDONS)
            for tendon in range(model.ntendon)
        ),
        "springs": np.c_[model.jnt_stiffness, model.jnt_stiffnesspoly][joints].any(1).sum(),
        "dampers that are not linear": model.dof_dampingpoly[dofs].any(1).sum(),
        "planes, height fields and shapes of the world": solid.sum() - shapes,
        "flexible bodies": model.nflex,
        "plugins of bodies": (model.body_plugin >= 0).sum(),
        "properties of a medium": np.count_nonzero([option.density, option.viscosity]),
        "disabling <flag>s": sum(_is_off(option, name) for name in _SWITCHES),
    }
    return ", ".join(f"{kind} ({count})" for kind, count in counts.items() if count)


class Compiled(NamedTuple):
    """Model of a file, and the ``mujoco.MjSpec`` that was compiled."""

    scene: MjSpec
    model: MjModel

    @property
    def content(self) -> str:
        """Digest of the elements that move, collide or act."""
        model = self.model
        names = [name for name in dir(model) if name.startswith(_PREFIXES)]
        # The last bits may differ between kinds of processors.
        arrays = {name: np.round(np.asarray(getattr(model, name), float), 9) for name in names}
        return digest(arrays, model.names, str(model.opt))


def compile_scene(path: Path) -> Compiled:
    """Return the compilation of a file, without elements that are only drawn.

    Raises RobotError if MuJoCo refuses it.
    """
    # MuJoCo takes a file of the same name, size and second for the one that it has read.
    mujoco.mj_clearCache(mujoco.mj_getCache())
    try:
        scene = mujoco.MjSpec.from_file(str(path))
        scene.compiler.discardvisual = True
        model = scene.compile()
        model.names.decode()  # MuJoCo requires UTF-8, and does not check it
        return Compiled(scene, model)
    except (ValueError, mujoco.FatalError) as error:
        problem = " ".join(str(error).split())
        raise RobotError(
            f"{path}: MuJoCo cannot compile the file: {problem}; correct it, or restore the file"
            " that it names, e.g. by git lfs pull"
        ) from error
