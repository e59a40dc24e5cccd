"""Reader of MJCF files: MuJoCo compiles them, and the model becomes tables, motors and a start
pose.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
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
_ELSEWHERE = "expect another motion in SAPIEN"
"""Remedy for content that only the engine MuJoCo simulates."""


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
    # A file of motors alone has no gains to offer.
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
    # Loops between links, which MuJoCo closes and a tree cannot have.
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
    # The list grows while it is read: included models include others.
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


def _disabled(model: MjModel, flags: Sequence[str]) -> str:
    """Return the parts of MuJoCo's physics among ``flags`` that a file disables."""
    bits = {flag: getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}", 0) for flag in flags}
    return ", ".join(flag.lower() for flag, bit in bits.items() if model.opt.disableflags & bit)


def _in_radians(model: MjModel, names: Names) -> Iterator[Finding]:
    """Yield a finding if all limited hinges have ranges within 3.2 degrees, as if radians were read
    as degrees.
    """
    # Slides are in metres in either case.
    hinges = [joint for joint in names.joints if not names.is_slide(joint)]
    ranges = model.jnt_range[[joint for joint in hinges if model.jnt_limited[joint]]]
    if ranges.size and np.abs(ranges).max() <= np.deg2rad(3.2):
        text = "the ranges of all hinges are tiny: angles are in degrees unless the file says otherwise"
        remedy = 'add <compiler angle="radian"/> if the file is in radians'
        yield Finding("warning", "limits", text, remedy)


def _unused(model: MjModel, names: Names, key: int | None) -> Iterator[Finding]:
    """Yield findings of content that is not simulated, apart from motors, couplings, shapes and
    keyframe ``key``.
    """
    keyframes = model.nkey - (key is not None)
    counts = {"sites": model.nsite, "sensors": model.nsensor, "keyframes": keyframes}
    left_out = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    if left_out:
        text = f"elements that the simulation does not use are left out: {left_out}"
        yield Finding("note", "unknown-element", text, "expect no effect")
    option = model.opt
    ours, others = _disabled(model, _OURS), _disabled(model, _OTHERS)
    is_other_gravity = tuple(option.gravity) != GRAVITY
    has_medium = option.density or option.viscosity
    # Every row: whether the file has it, what is simulated, and the remedy.
    for is_there, text, remedy in (
        (is_other_gravity, f"gravity is {GRAVITY} m/s^2, not the file's", "expect other loads"),
        (ours, f"<flag> of the file is not used, which disables {ours}", "expect these to act"),
        (others, f"{ALONE} the absence of {others}, which <flag> disables", _ELSEWHERE),
        (has_medium, f"{ALONE} the medium (<option density= viscosity=>)", _ELSEWHERE),
        (model.nflex, f"{ALONE} flexible bodies", _ELSEWHERE),
    ):
        if is_there:
            yield Finding("warning", "option", text, remedy)
    for joint, name in names.joints.items():
        if model.jnt_stiffness[joint]:
            text = f"{ALONE} the spring of the joint"
            detail = f"{model.jnt_stiffness[joint]:g} in units of N, m and rad"
            yield Finding("warning", "spring", text, _ELSEWHERE, name, detail=detail)
    for body in np.flatnonzero(model.body_gravcomp):
        if names.is_of_robot(body):
            text = "gravity compensation of this body (gravcomp) is not simulated"
            remedy = "let the controller compensate"
            yield Finding("note", "gravcomp", text, remedy, link=names.bodies[int(body)])
