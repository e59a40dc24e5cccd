"""MJCF of the simulated robot, with the law in MuJoCo's own PID actuators.

MuJoCo's ``pid`` actuator (3.15 and later), with the error e, inputs r, r' and ff, and the integral A::

    effort = min(max(kp e + ki A + kv (r' - q') + ff, low), high)
    A     <- A + dt e        while |A| < imax, or towards 0

That is this package's law with the measured velocity, output first, without anti-windup. Its output after a step was
compared with MuJoCo 4.0's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import ArrayLike, NDArray

from batchpid.checks.validate import choice
from batchpid.errors import InvalidArgumentError, RobotError
from batchpid.export.differences import strategies
from batchpid.export.exported import Exported
from batchpid.export.pd_drive import Drive
from batchpid.law.params import PIDParams
from batchpid.motors.actuators import Actuators
from batchpid.sim.engine.joint_friction import added_friction, own_friction
from batchpid.sim.engine.mujoco.model_builder import principal_inertia, robot_spec
from batchpid.sim.engine.mujoco.solver import SOLVERS
from batchpid.sim.engine.sapien.body_inertias import body_inertias
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.inertia import nearest_physical

INPUTS = 7
"""Inputs of each actuator, in its order in ``ctrl``: position, velocity, feedforward (bits of ``mjtCtrlInput``)."""


def to_mjcf(
    robot: RobotDescription,
    params: PIDParams,
    dt: float,
    *,
    actuators: Actuators | None = None,
    inertia: ArrayLike | None = None,
    physics: str = "accurate",
) -> Exported:
    """Return the MJCF of ``robot``, one ``pid`` actuator for each independent joint, and its differences.

    Bodies are the rigid bodies that are simulated here, with repaired inertias, convex shapes, pairs that do not
    collide, joint limits, damping, Coulomb friction and armature; followers are tied to their leaders by constraints.
    Each actuator has three inputs in ``ctrl``: position, velocity and feedforward.

    Parameters
    ----------
    params
        Of one env: (1, joints), all joints.
    dt
        Time step of the simulation, and so of the control [s].
    actuators
        Motors of one env: armature, friction and effort limit are written.
    inertia
        As in :func:`batchpid.export.to_ros2_control`, of all joints.
    physics
        "accurate", "fast" or "free": settings of the solver.

    Raises
    ------
    InvalidArgumentError
        Params or actuators for several envs, gains per inertia without ``inertia``, or unknown physics.
    RobotError
        MuJoCo cannot build the robot.
    """
    found = Drive(params, robot.joint_names, dt, inertia, actuators, implicit=False, whole=True)
    spec = SceneSpec(
        robot.urdf,
        robot.ignored_pairs,
        robot.joints,
        found.dt,
        SOLVERS[choice("physics", physics, SOLVERS)],
        dissipation=robot.dissipation,
        ground=robot.has_ground,
        fixed_base=robot.fixed_base,
        merge_fixed=robot.merge_fixed,
        engine="mujoco",
    )
    inertias = body_inertias(spec)
    scene, names = robot_spec(spec, inertias)
    scene.modelname, scene.option.disableflags = robot.name, 0
    for link, name in names.items():
        found += _set_inertia(scene.body(name), inertias[link], link)
    friction = added_friction(own_friction(spec), found.actuators)
    _set_joints(scene, robot, found, friction)
    _set_actuators(scene, robot, found)
    try:
        scene.compile()
    except ValueError as error:
        raise RobotError(f"MuJoCo cannot build the robot: {error}; correct the URDF") from error
    _compare(found, robot, friction)
    head = "".join(f"<!-- differs: {' '.join(each.split()).replace('--', '- -')} -->\n" for each in found)
    return Exported(f"{head}{_exact(scene)}", tuple(found))


def _set_inertia(body: Any, inertia: Any, link: str) -> Iterable[str]:
    """Set the inertia of a body; yield the change of a tensor that no body has, which MuJoCo refuses."""
    given = inertia.tensor
    low, middle, high = np.linalg.eigvalsh(given)
    possible = low > 0 and low + middle >= high
    used = given if possible else nearest_physical(given * (1 + 1e-9))
    moments, wxyz = principal_inertia(inertia._replace(tensor=used))
    body.inertia, body.iquat = moments, wxyz
    if not possible:
        figures = [" ".join(f"{each:.4g}" for each in np.linalg.eigvalsh(tensor)) for tensor in (given, used)]
        yield f"inertia: link {link!r}: MuJoCo needs moments of a body: {figures[1]} instead of {figures[0]} kg m^2"


def _set_joints(scene: Any, robot: RobotDescription, found: Drive, friction: Any) -> None:
    """Set damping, friction and armature of the joints, and tie the followers."""
    rows = {"damping": friction.viscous, "frictionloss": friction.coulomb}
    for at, name in enumerate(robot.joint_names):
        joint = scene.joint(name)
        joint.armature = found.motor("armature")[at]
        for field, leaf in rows.items():
            if leaf is not None:
                value = float(np.broadcast_to(leaf, (1, robot.dof))[0, at])
                setattr(joint, field, [value, 0, 0] if np.ndim(getattr(joint, field)) else value)
    if (coupling := robot.coupling) is None:
        return
    for follower in np.flatnonzero(~coupling.independent):
        tie = scene.add_equality(type=mujoco.mjtEq.mjEQ_JOINT)
        tie.objtype = mujoco.mjtObj.mjOBJ_JOINT
        tie.name1, tie.name2 = robot.joint_names[follower], robot.joint_names[coupling.leader[follower]]
        figures = [coupling.offset[follower], coupling.multiplier[follower]]
        tie.data = np.pad(figures, (0, len(tie.data) - 2))


def _integral_limit(found: Drive) -> NDArray[np.float64]:
    """Return the symmetric limit of the integral (joints,) [N m or N]."""
    low, high = found.value("integral_min", -math.inf), found.value("integral_max", math.inf)
    return np.maximum(np.minimum(-low, high), 0.0)


def _set_actuators(scene: Any, robot: RobotDescription, found: Drive) -> None:
    kp, ki, kd, limit = found.value("kp"), found.value("ki"), found.value("kd"), _integral_limit(found)
    low, high = found.value("effort_min", -math.inf), found.value("effort_max", math.inf)
    motor = found.motor("effort_limit", math.inf)
    low, high = np.maximum(low, -motor), np.minimum(high, motor)
    for at in np.flatnonzero(robot.independent):
        name = robot.joint_names[at]
        actuator = scene.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        integrates = ki[at] > 0 and limit[at] > 0
        imax = limit[at] / ki[at] if integrates and math.isfinite(limit[at]) else -1.0
        actuator.set_to_pid(kp=kp[at], kv=kd[at], ki=ki[at] if integrates else 0.0, imax=imax, ctrlspec=INPUTS)
        if math.isfinite(low[at]) or math.isfinite(high[at]):
            if low[at] >= high[at]:
                problem = "must be below effort_max for MuJoCo"
                raise InvalidArgumentError("effort_min", problem, joint=name, value=low[at], remedy="widen the limits")
            actuator.forcelimited = True
            actuator.forcerange = np.clip([low[at], high[at]], -1e10, 1e10)


def _compare(found: Drive, robot: RobotDescription, friction: Any) -> None:
    """Add the differences of MuJoCo's PID, friction and constraints."""
    ki, used = found.value("ki"), np.array(strategies(found.params))
    limited = np.isfinite(found.value("effort_min", -math.inf)) | np.isfinite(found.value("effort_max", math.inf))
    if (winds := (ki > 0) & limited & np.isin(used, ("conditional", "back_calculation"))).any():
        limit = found.listed(_integral_limit(found), winds)
        found.append(f"anti_windup: the integral goes on while the effort is at its limit, up to {limit} N m or N")
    low, high = found.value("integral_min", -math.inf), found.value("integral_max", math.inf)
    if (ki > 0).any() and (np.isfinite(low) | np.isfinite(high)).any():
        limits = found.listed(_integral_limit(found), ki > 0)
        found.append(f"integral_limit: {limits} N m or N, passed by up to one step, ki dt |e|")
    if found.params.integration is not None and ki.any():
        phase = found.phase(found.params._replace(integration=None))
        found.append(f"integration: the present error enters the integral after the output, a step later{phase}")
    found.lack_motor("saturation_effort", "no torque-speed line", "N m or N", math.inf)
    found.lack_motor("command_delay", "none in the target", "s")
    if friction.coulomb is not None and np.any(friction.coulomb):
        found.append("friction: a soft constraint in MuJoCo, in which a joint creeps below its friction")
    found.lack_motor("static", "friction at rest is that of motion", "N m or N")
    if robot.coupling is not None:
        names = [name for name, own in zip(robot.joint_names, robot.independent, strict=True) if not own]
        found.append(f"followers: soft constraints in MuJoCo: {', '.join(names)}")


def _exact(scene: Any) -> str:
    """Return the XML of a compiled scene with all digits, of which MuJoCo writes six."""
    root = etree.fromstring(scene.to_xml().encode())
    _write(root.find("option"), {"timestep": scene.option.timestep, "gravity": scene.option.gravity})
    for element in root.iterfind("worldbody//body"):
        body = scene.body(element.get("name"))
        _write(element, {"pos": body.pos, "quat": body.quat})
        figures = {"pos": body.ipos, "quat": body.iquat, "mass": body.mass, "diaginertia": body.inertia}
        _write(element.find("inertial"), figures)
        for geom, given in zip(element.findall("geom"), body.geoms, strict=True):
            _write(geom, {"size": given.size, "pos": given.pos, "quat": given.quat})
    for element in root.iterfind("worldbody//joint[@name]"):
        joint = scene.joint(element.get("name"))
        fields = ("axis", "range", "armature", "damping", "frictionloss")
        _write(element, {field: getattr(joint, field) for field in fields})
    for element in root.iterfind("actuator/*"):
        actuator = scene.actuator(element.get("name"))
        _write(element, {field: getattr(actuator, field) for field in ("gainprm", "biasprm", "dynprm", "forcerange")})
    for element, given in zip(root.findall("equality/joint"), scene.equalities, strict=True):
        _write(element, {"polycoef": given.data})
    for element in root.iterfind("asset/mesh"):
        _write(element, {"vertex": scene.mesh(element.get("name")).uservert})
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def _write(element: Any, figures: dict[str, Any]) -> None:
    """Replace the numbers of the attributes that an element has."""
    for key, values in figures.items():
        if element is not None and key in element.attrib:
            numbers = np.atleast_1d(values)[: len(element.get(key).split())]
            element.set(key, " ".join(repr(float(each)) for each in numbers))
