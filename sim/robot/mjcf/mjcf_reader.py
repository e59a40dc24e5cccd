"""Reader of MJCF files: MuJoCo compiles them, and the model becomes tables, motors and a start
pose.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from batchpid.arrays.array_types import Float64, MjModel
from batchpid.arrays.digest import digest
from batchpid.arrays.read_only import read_only
from batchpid.motors import make_actuators
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.mjcf.mjcf_actuators import read_couplings, read_motors
from batchpid.sim.robot.mjcf.mjcf_compiler import ALONE, Attempt, Names, compile_file, label
from batchpid.sim.robot.mjcf.mjcf_tables import (
    PLANE,
    TableReader,
    can_collide,
    excluded_pairs,
    find_base,
)
from batchpid.sim.robot.parts import FileDefaults, MjcfFile
from batchpid.sim.robot.urdf import Source
from batchpid.sim.robot.xml import parse_xml
from batchpid.task_space.rigid_tree import GRAVITY

_EQ = mujoco.mjtEq
_KEYFRAME = "home"
"""Keyframe with the start pose."""
_FOLDERS = ("meshdir", "texturedir", "assetdir")
"""Attributes of ``<compiler>`` with folders of other files."""
_OURS = ("GRAVITY", "ACTUATION", "CLAMPCTRL")
"""Parts of MuJoCo's physics that a file cannot disable in either engine."""
_OTHERS = ("CONTACT", "LIMIT", "EQUALITY", "FRICTIONLOSS", "DAMPER", "CONSTRAINT")
"""Parts that it can disable in MuJoCo."""


def read_mjcf(path: Path, name: str, fixed_base: bool | None, missing_meshes: str) -> Source:
    """Return the content of the MJCF file at ``path`` as the robot ``name``.

    For the other arguments see :meth:`batchpid.sim.Robot.load`. Raises RobotError if MuJoCo refuses
    the file, it has a ball joint or several robots, a missing mesh has an unknown mass, or missing
    meshes are refused.
    """
    findings: list[Finding] = []
    compiled = compile_file(path, fixed_base is not False, missing_meshes, findings)
    model = compiled.model
    names = Names(model)
    base = find_base(model, names, path, findings)
    # A base is free where the file has a free joint, unless the caller fixes it.
    if fixed_base is None:
        fixed_base = not (base and model.body_jntnum[base])
    couplings = read_couplings(model, names, findings)
    motors = read_motors(model, names, couplings, findings)
    reader = TableReader(model, names, base, findings, motors)
    tables = reader.read(couplings, is_held=fixed_base)
    key = home(model)
    findings += [*_in_radians(model, names), *_unused(model, names, key)]
    # The start pose is that of the keyframe, else the reference pose.
    pose = model.qpos0 if key is None else model.key_qpos[key]
    base_start = None
    if base and not fixed_base:
        at = model.jnt_qposadr[model.body_jntadr[base]]
        base_start = tuple(pose[at : at + 7].tolist())
    start = {name: pose[model.jnt_qposadr[joint]] for joint, name in names.joints.items()}
    joints = [joint.name for joint in tables.joints if joint.moves]

    def column(values: Mapping[str, float]) -> Float64:
        return read_only(np.array([values.get(joint, 0.0) for joint in joints], np.float64))

    defaults = FileDefaults(column(start))
    if any((*motors.kp.values(), *motors.kv.values())):
        defaults = replace(defaults, kp=column(motors.kp), kv=column(motors.kv))
    armature = column(motors.armature)
    return Source(
        name,
        tables,
        tuple(findings),
        fixed_base,
        base_start,
        mjcf=_file(path, compiled, names, fixed_base),
        pairs=excluded_pairs(model, reader.solid),
        defaults=defaults,
        actuators=make_actuators(len(joints), armature=armature) if armature.any() else None,
    )


def home(model: MjModel) -> int | None:
    """Return the number of the keyframe with the start pose, None without one."""
    return next((key for key in range(model.nkey) if model.key(key).name == _KEYFRAME), None)


def _file(path: Path, compiled: Attempt, names: Names, fixed_base: bool) -> MjcfFile:
    """Return the data of the file that the engine MuJoCo needs."""
    model = compiled.model
    loops = []
    for equality in np.flatnonzero(model.eq_active0):
        at = [model.eq_obj1id[equality], model.eq_obj2id[equality]]
        if int(model.eq_type[equality]) not in (_EQ.mjEQ_CONNECT, _EQ.mjEQ_WELD):
            continue
        if model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
            at = model.site_bodyid[at]
        if all(names.is_of_robot(body) for body in at):
            loops.append(label(model.equality(int(equality))))
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    floats = any(names.is_of_robot(body) for body in free)
    planes = np.flatnonzero((model.geom_bodyid == 0) & (model.geom_type == PLANE))
    grounds = [int(plane) for plane in planes if can_collide(model, int(plane))]
    return MjcfFile(
        path=str(path),
        is_whole=compiled.is_whole,
        content=content_of(path),
        bodies=tuple(names.bodies.values()),
        falling=tuple(names.bodies[int(body)] for body in free if not names.is_of_robot(body)),
        loops=tuple(loops),
        is_alone=all(names.is_of_robot(body) for body in model.jnt_bodyid),
        has_floor=bool(grounds) and not (floats and fixed_base),
        friction=float(model.geom_friction[grounds[0], 0]) if grounds else 1.0,
    )


def content_of(path: Path) -> str:
    """Return the digest of an MJCF file and of all files that it names: included models, meshes,
    height fields, ...

    MuJoCo looks for a file in the folder of the file that names it, or in a folder of its
    ``<compiler>``. A missing file is left out: if MuJoCo needs it, the compilation fails.
    """
    names = set[str]()
    folders = set[Path]()
    models = [path]
    for model in models:
        folders.add(model.parent)
        for element in parse_xml(model).iter():
            folders |= {model.parent / folder for key, folder in element.items() if key in _FOLDERS}
            for key, name in element.items():
                if (key == "value" or key.startswith("file")) and name not in names:
                    names |= {name, Path(name).name}
                    if element.tag in ("include", "model"):
                        included = [model.parent / name, path.parent / name]
                    else:
                        included = []
                    models += [file for file in included if file.is_file() and file not in models]
    files = {
        (name, file)
        for name in names
        for folder in folders
        if os.path.isfile(file := folder / name)
    }
    return digest(
        path.read_bytes(), sorted((name, digest(file.read_bytes())) for name, file in files)
    )


def _in_radians(model: MjModel, names: Names) -> list[Finding]:
    """Return a finding if all limited hinges have ranges within 3.2 degrees, as if radians were
    read as degrees.
    """
    hinges = [
        joint for joint in names.joints if model.jnt_limited[joint] and not names.is_slide(joint)
    ]
    if not hinges or np.abs(model.jnt_range[hinges]).max() > np.deg2rad(3.2):
        return []
    text = (
        "the ranges of all hinges are tiny: angles of an MJCF file are in degrees unless it says"
        " otherwise"
    )
    return [
        Finding(
            "warning", "limits", text, 'add <compiler angle="radian"/> if the file is in radians'
        )
    ]


def _unused(model: MjModel, names: Names, key: int | None) -> list[Finding]:
    """Return findings for content that is not simulated, apart from motors, couplings, shapes and
    keyframe ``key``.
    """
    found = []
    counts = {
        "site": model.nsite,
        "sensor": model.nsensor,
        "camera": model.ncam,
        "skin": model.nskin,
    }
    counts["keyframe"] = model.nkey - (key is not None)
    if listed := [f"{count} {kind}{'s' * (count > 1)}" for kind, count in counts.items() if count]:
        text = f"elements that the simulation does not use are left out: {', '.join(listed)}"
        found.append(Finding("note", "unknown-element", text, "expect no effect"))
    option = model.opt
    if tuple(option.gravity) != GRAVITY:
        text = (
            f"gravity {tuple(option.gravity.tolist())} of the file is not used: {GRAVITY} m/s^2 is"
        )
        found.append(Finding("warning", "option", text, "expect other loads"))
    ours, others = (
        [
            name.lower()
            for name in flags
            if option.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}", 0)
        ]
        for flags in (_OURS, _OTHERS)
    )
    if ours:
        text = f"<flag> of the file is not used, which disables: {', '.join(ours)}"
        found.append(
            Finding(
                "warning", "option", text, "expect all of these to act; remove them from the file"
            )
        )
    if option.enableflags & int(getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)):
        found.append(
            Finding(
                "note", "option", "no body falls asleep, as the file has it", "expect slower steps"
            )
        )
    special = {
        f"the absence of what <flag> disables: {', '.join(others)}": others,
        "drag of the medium (<option density= viscosity=>)": option.density or option.viscosity,
        "flexible bodies": model.nflex,
    }
    remedy = "expect another motion in SAPIEN"
    found += [
        Finding("warning", "option", f"{ALONE} {text}", remedy)
        for text, there in special.items()
        if there
    ]
    for joint, name in names.joints.items():
        if model.jnt_stiffness[joint] or np.any(
            getattr(model, "jnt_stiffnesspoly", np.zeros((model.njnt, 1)))[joint]
        ):
            text = f"{ALONE} the spring of the joint"
            remedy = "in SAPIEN add its effort in a controller"
            detail = (
                f"{model.jnt_stiffness[joint]:g} {'N/m' if names.is_slide(joint) else 'N m/rad'}"
            )
            found.append(Finding("warning", "spring", text, remedy, name, detail=detail))
        if np.any(
            getattr(model, "dof_dampingpoly", np.zeros((model.nv, 1)))[model.jnt_dofadr[joint]]
        ):
            text = f"{ALONE} damping that grows with the speed, SAPIEN its linear part"
            found.append(
                Finding(
                    "warning", "dynamics", text, "give the damping at the speeds of interest", name
                )
            )
    for body in np.flatnonzero(model.body_gravcomp):
        text = "gravity compensation of this body (gravcomp) is not simulated"
        remedy = "let the controller compensate"
        if names.is_of_robot(body):
            found.append(Finding("note", "gravcomp", text, remedy, link=names.bodies[int(body)]))
    for body in np.flatnonzero(model.body_plugin >= 0):
        text = f"{ALONE} the plugin of the body"
        remedy = "in SAPIEN expect the body to be rigid and to move freely"
        found.append(
            Finding("warning", "unknown-element", text, remedy, link=names.bodies[int(body)])
        )
    return found
