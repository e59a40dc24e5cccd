"""Reader of MJCF files: MuJoCo compiles them, and the model becomes tables, motors and a start
pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from batchpid.arrays.array_types import Float64, MjModel
from batchpid.arrays.elementwise import read_only
from batchpid.motors import make_actuators
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.mjcf_actuators import read_couplings, read_motors
from batchpid.sim.robot.mjcf_model import (
    ALONE,
    PLANE,
    Compiled,
    RobotInFile,
    can_collide,
    compile_file,
    label,
)
from batchpid.sim.robot.mjcf_tables import TableReader, excluded_pairs
from batchpid.sim.robot.parts import FileDefaults, MjcfFile
from batchpid.sim.robot.tables import Source
from batchpid.task_space.rigid_tree import GRAVITY

_KEYFRAME = "home"
"""Keyframe with the start pose."""
_SWITCHES = (
    "GRAVITY",
    "ACTUATION",
    "CONTACT",
    "LIMIT",
    "EQUALITY",
    "FRICTIONLOSS",
    "DAMPER",
    "CONSTRAINT",
)
"""Parts of MuJoCo's physics that a file can disable; of the first two neither engine takes note."""
_ELSEWHERE = "expect another motion in SAPIEN"
"""Remedy for content that only the engine MuJoCo simulates."""


def read_mjcf(
    path: Path,
    name: str,
    fixed_base: bool | None,
    missing_meshes: str,
) -> Source:
    """Return the content of the MJCF file at ``path`` as the robot ``name``.

    For the other arguments see :meth:`batchpid.sim.Robot.load`. Raises RobotError if MuJoCo refuses
    the file, it has a ball joint or several robots, or missing meshes are refused.
    """
    findings: list[Finding] = []
    compiled = compile_file(path, missing_meshes, findings)
    model = compiled.model
    robot = RobotInFile(model, path, findings)
    # A base is free where the file has a free joint, unless the caller fixes it.
    if fixed_base is None:
        fixed_base = not (robot.base and model.body_jntnum[robot.base])
    couplings = read_couplings(model, robot, findings)
    motors = read_motors(model, robot, couplings, findings)
    reader = TableReader(model, robot, findings, motors)
    tables = reader.read(couplings, is_held=fixed_base)
    findings += _unused(model, robot)
    # The start pose is that of the keyframe, else the reference pose.
    key = home(model)
    pose = model.qpos0 if key is None else model.key_qpos[key]
    base_start = None
    if robot.base and not fixed_base:
        at = model.jnt_qposadr[model.body_jntadr[robot.base]]
        base_start = tuple(pose[at : at + 7].tolist())
    start = {name: pose[model.jnt_qposadr[joint]] for joint, name in robot.joints.items()}
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
        mjcf=_file(path, compiled, robot, fixed_base),
        pairs=excluded_pairs(model, reader.solid),
        defaults=defaults,
        actuators=make_actuators(len(joints), armature=armature) if armature.any() else None,
    )


def home(model: MjModel) -> int | None:
    """Return the number of the keyframe with the start pose, None without one."""
    return next((key for key in range(model.nkey) if model.key(key).name == _KEYFRAME), None)


def _file(
    path: Path,
    compiled: Compiled,
    robot: RobotInFile,
    fixed_base: bool,
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
    planes = np.flatnonzero((model.geom_bodyid == 0) & (model.geom_type == PLANE)).tolist()
    grounds = [plane for plane in planes if can_collide(model, plane)]
    floats = any(robot.is_of_robot(body) for body in free)
    return MjcfFile(
        path=str(path),
        is_whole=compiled.is_whole,
        content=compiled.content,
        bodies=tuple(robot.bodies.values()),
        falling=tuple(robot.bodies[body] for body in free if not robot.is_of_robot(body)),
        loops=tuple(loops),
        is_alone=all(robot.is_of_robot(body) for body in model.jnt_bodyid),
        has_floor=bool(grounds) and not (floats and fixed_base),
        friction=float(model.geom_friction[grounds[0], 0]) if grounds else 1.0,
    )


def _unused(model: MjModel, robot: RobotInFile) -> Iterator[Finding]:
    """Yield findings of content that is not simulated, apart from motors, couplings and shapes."""
    keyframes = model.nkey - (home(model) is not None)
    counts = {"sites": model.nsite, "sensors": model.nsensor, "keyframes": keyframes}
    left_out = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    if left_out:
        text = f"elements that the simulation does not use are left out: {left_out}"
        yield Finding("unknown-element", text, "expect no effect")
    option = model.opt
    disabled = ", ".join(
        switch.lower()
        for switch in _SWITCHES
        if option.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{switch}")
    )
    # Every row: whether the file has it, the code, and what is simulated.
    for is_there, code, text in (
        (tuple(option.gravity) != GRAVITY, "option", f"gravity is {GRAVITY} m/s^2, not the file's"),
        (
            disabled,
            "engine",
            f"{ALONE} <flag>, which disables {disabled}, but for gravity and actuation",
        ),
        (
            option.density or option.viscosity,
            "engine",
            f"{ALONE} the medium (<option density= viscosity=>)",
        ),
        (model.nflex, "engine", f"{ALONE} flexible bodies"),
    ):
        if is_there:
            yield Finding(code, text, _ELSEWHERE)
    for joint, name in robot.joints.items():
        if stiffness := model.jnt_stiffness[joint]:
            text = f"{ALONE} the spring of the joint"
            detail = f"{stiffness:g} in units of N, m and rad"
            yield Finding("engine", text, _ELSEWHERE, name, detail=detail)
    for body in np.flatnonzero(model.body_gravcomp).tolist():
        if robot.is_of_robot(body):
            text = "gravity compensation of this body (gravcomp) is not simulated"
            remedy = "let the controller compensate"
            yield Finding("option", text, remedy, link=robot.bodies[body])
